"""How long lifts take: in this process, over HTTP as JSON and as safetensors, and in a stream.

    python benchmarks/lift.py [--capture FILE.npz | --views 4 --keypoints 17] [--model FILE]
                              [--batches 1 32 1000] [--seconds 15] [--json FILE]

The ways take turns, one call each, so that a machine that gets slower gets slower for all.
README.md says what each row is.
"""

import argparse
import gc
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, get_args

from benchmarks.captures import (  # first: it says how many threads the libraries may take
    Float32,
    add_options,
    from_options,
    model_from_options,
)

import numpy as np  # isort: skip
import orjson
import uvloop
from safetensors.numpy import save

from benchmarks.figures import Bar, Results, Row, command, spread
from benchmarks.service_rig import BYTES, Service, service
from benchmarks.streams import Stream, as_bytes, as_text
from benchmarks.wire import Connection, post
from models.lifting.fitted_prior import FittedPrior
from models.numerics.threads import use_cores, use_threads
from models.settings.config import Refine

JSON = "application/json"
IN_PROCESS, HTTP_JSON, HTTP_BINARY = "in process", "HTTP, JSON", "HTTP, binary"
STREAM_JSON, STREAM_BINARY = "stream, JSON", "stream, binary"
PARSING = "parsing the JSON"  # orjson.loads and numpy.asarray of the body
FEWEST, MOST = 5, 2000  # turns
DIFFERENT = 2000  # frames that a row's calls go through
REFINES: tuple[Refine, ...] = ("off", "auto")
NAMES = {"off": "feed-forward", "auto": "refined", "full": "refined, always"}

Way = Callable[[int], Awaitable[object]]  # lifts the i-th batch


@dataclass(frozen=True)
class Timing:
    """What the turns of one way took."""

    refine: Refine
    batch: int
    way: str
    seconds: list[float]

    @property
    def p50(self) -> float:
        """Median, milliseconds."""
        return spread(self.seconds)["p50 ms"]

    @property
    def p99(self) -> float:
        """99th percentile, milliseconds."""
        return spread(self.seconds)["p99 ms"]

    @property
    def frames_per_second(self) -> float:
        """Throughput over all turns."""
        return self.batch * len(self.seconds) / sum(self.seconds)


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)
    use_cores(len(os.sched_getaffinity(0)))  # as many as lift in the service
    capture = from_options(arguments)
    prior = model_from_options(arguments, capture)
    with service() as running:
        timings = uvloop.run(measure(running, prior, capture.keypoints, arguments))
    Results("lift", vars(arguments), {"Lifts": rows(timings)}, bars(timings)).publish(
        arguments.json
    )


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Time lifts in this process and through the service.")
    add_options(parser)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 32, 1000], help="frames")
    parser.add_argument(
        "--refine", nargs="+", choices=get_args(Refine.__value__), default=list(REFINES)
    )
    parser.add_argument("--seconds", type=float, default=15, help="for each batch size: 15")
    return parser.parse_args()


async def measure(
    running: Service, prior: FittedPrior, keypoints: Float32, arguments: argparse.Namespace
) -> list[Timing]:
    """Time every way for every size of batch."""
    model = running.import_model(prior)
    connection = await Connection.open(running.host, running.port)
    timings = []
    for refine in arguments.refine:
        for size in arguments.batches:
            batches = cut(keypoints, size)
            stream = await Stream.open(running, model=model, refine=refine)
            ways = ways_to_lift(connection, stream, model, prior, batches, refine)
            await take_turns(ways, len(batches), 0)  # warms up
            gc.collect()
            gc.freeze()  # JSON makes so many lists that all else would be searched again and again
            seconds = await take_turns(ways, len(batches), arguments.seconds)
            await stream.close()
            timings += [Timing(refine, size, way, times) for way, times in seconds.items()]
    connection.close()
    return timings


def cut(keypoints: Float32, size: int) -> list[Float32]:
    """Return different batches (size, K, P, 2) of a capture's frames."""
    count = max(1, min(len(keypoints), DIFFERENT) // size)
    return np.split(keypoints[np.arange(count * size) % len(keypoints)], count)


def ways_to_lift(
    connection: Connection,
    stream: Stream,
    model: str,
    prior: FittedPrior,
    batches: list[Float32],
    refine: Refine,
) -> dict[str, Way]:
    """Return functions that lift a batch; what a client makes of arrays is made before."""
    texts = [
        orjson.dumps(
            {"model": model, "frames": frames, "refine": refine},
            option=orjson.OPT_SERIALIZE_NUMPY,
        )
        for frames in batches
    ]
    lists = [orjson.dumps(frames, option=orjson.OPT_SERIALIZE_NUMPY) for frames in batches]
    in_json = [post("/lift", text, content=JSON, accept=JSON) for text in texts]
    path = f"/lift?model={model}&refine={refine}"
    in_bytes = [
        post(path, save({"frames": frames}), content=BYTES, accept=BYTES) for frames in batches
    ]

    texts_of_frames = [[as_text(n, f) for n, f in enumerate(frames)] for frames in batches]
    bytes_of_frames = [[as_bytes(n, f) for n, f in enumerate(frames)] for frames in batches]

    async def in_process(turn: int) -> object:
        return prior.lift(batches[turn], refine=refine)

    async def http_json(turn: int) -> object:
        return await ask(connection, in_json[turn])

    async def http_binary(turn: int) -> object:
        return await ask(connection, in_bytes[turn])

    async def stream_json(turn: int) -> None:
        await stream.lift(texts_of_frames[turn])

    async def stream_binary(turn: int) -> None:
        await stream.lift(bytes_of_frames[turn])

    async def parsing(turn: int) -> object:
        return np.asarray(orjson.loads(lists[turn]), np.float32)

    return {
        IN_PROCESS: in_process,
        HTTP_JSON: http_json,
        HTTP_BINARY: http_binary,
        STREAM_JSON: stream_json,
        STREAM_BINARY: stream_binary,
        PARSING: parsing,
    }


async def ask(connection: Connection, request: bytes) -> bytes:
    """Return the body of an answer that must be 200."""
    answer = await connection.ask(request)
    if answer.status != 200:
        raise RuntimeError(f"POST /lift answered {answer.status}: {answer.body[:500]!r}")
    return answer.body


async def take_turns(
    ways: dict[str, Way], batches: int, seconds_in_all: float
) -> dict[str, list[float]]:
    """Call the ways in turns until the time is up; return the seconds that each call took."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    ends = time.perf_counter() + seconds_in_all
    turn = 0
    while turn < FEWEST or (turn < MOST and time.perf_counter() < ends):
        for name, way in ways.items():
            started = time.perf_counter()
            await way(turn % batches)
            seconds[name].append(time.perf_counter() - started)
        turn += 1
    return seconds


def rows(timings: list[Timing]) -> list[Row]:
    """Return a row for each timing."""
    answer = []
    for timing in timings:
        lifts = timing.way != PARSING
        base = find(timings, timing.refine, timing.batch, IN_PROCESS)
        rate = timing.frames_per_second
        answer.append(
            {
                "lift": NAMES[timing.refine],
                "frames": timing.batch,
                "way": timing.way,
                "p50 ms": timing.p50,
                "p99 ms": timing.p99,
                "frames/s": rate if lifts else None,
                "% of in process": 100 * rate / base.frames_per_second if lifts else None,
                "turns": len(timing.seconds),
            }
        )
    return answer


def find(timings: list[Timing], refine: str, batch: int, way: str) -> Timing:
    """Return the timing of one row."""
    return next(t for t in timings if (t.refine, t.batch, t.way) == (refine, batch, way))


def bars(timings: list[Timing]) -> list[Bar]:
    """Return the bars that the measured sizes allow to judge."""
    answer: list[Bar] = []

    def at(refine: Refine, batch: int, way: str) -> Any:
        return find(timings, refine, batch, way)

    have = {(timing.refine, timing.batch) for timing in timings}
    if ("off", 1) in have:
        ours, http = at("off", 1, IN_PROCESS), at("off", 1, HTTP_JSON)
        answer += [
            Bar("in process, feed-forward, one frame, p50", 0.3, ours.p50, "ms"),
            Bar("HTTP, one frame, p50 beyond in process", 2, http.p50 - ours.p50, "ms"),
            Bar("HTTP, one frame, p99 / p50", 4, http.p99 / http.p50, "x"),
        ]
    if ("off", 1000) in have:
        ours = at("off", 1000, IN_PROCESS)
        share = 100 * at("off", 1000, HTTP_BINARY).frames_per_second / ours.frames_per_second
        beyond = at("off", 1000, HTTP_JSON).p50 - ours.p50
        answer += [
            Bar(
                "in process, feed-forward, batches of 1000",
                50_000,
                ours.frames_per_second,
                "frames/s",
                least=True,
            ),
            Bar("HTTP binary, batches of 1000, of in process", 60, share, "%", least=True),
            Bar(
                "HTTP JSON, batches of 1000, p50 beyond in process / parsing",
                2,
                beyond / at("off", 1000, PARSING).p50,
                "x",
            ),
        ]
    if ("auto", 1) in have:
        answer.append(Bar("HTTP, refined, one frame, p50", 8, at("auto", 1, HTTP_JSON).p50, "ms"))
    if ("auto", 1000) in have:
        rate = at("auto", 1000, HTTP_BINARY).frames_per_second
        answer.append(
            Bar("HTTP binary, refined, batches of 1000", 1000, rate, "frames/s", least=True)
        )
    return answer


if __name__ == "__main__":
    main()
