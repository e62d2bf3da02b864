"""Streams of frames: a lean client, and several of them at the pace of cameras."""

import argparse
import asyncio
import random
import struct
import time
from collections.abc import Coroutine, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import orjson
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from benchmarks.captures import Float32
from benchmarks.figures import Bar, Row, spread
from benchmarks.service_rig import Service

HEADER = struct.Struct("<BBHI")  # kind, flags, views, sequence: see docs/streaming.md
FRAME, ANSWER, CONTINUED = 1, 2, 2
CLIENTS = 4
GRACE_SECONDS = 5.0  # for answers, after the last frame


class Stream:
    """One stream, whose frames and answers the caller numbers and counts."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self.send = connection.send
        self.receive = connection.recv

    @classmethod
    async def open(cls, running: Service, **start: object) -> "Stream":
        """Connect, and say what will be sent.

        Raises
        ------
        RuntimeError
            If the service does not agree.
        """
        uri = f"ws://{running.host}:{running.port}/lift/stream"
        connection = await connect(uri, compression=None, proxy=None, ping_interval=None)
        await connection.send(orjson.dumps(start).decode())
        said = await connection.recv()
        if orjson.loads(said)["type"] != "ready":
            raise RuntimeError(f"the stream was refused: {said!r}")
        return cls(connection)

    async def lift(self, frames: Iterable[str | bytes]) -> None:
        """Send frames without waiting, and read as many answers.

        Raises
        ------
        RuntimeError
            If an answer is none.
        """
        frames = list(frames)
        sending = asyncio.create_task(self._send_all(frames))
        for _ in frames:
            answer = await self.receive()
            good = answer[0] == ANSWER if isinstance(answer, bytes) else '"answer"' in answer[:40]
            if not good:
                raise RuntimeError(f"the stream answered {answer!r}")
        await sending

    async def _send_all(self, frames: list[str | bytes]) -> None:
        for frame in frames:
            await self.send(frame)

    async def close(self) -> None:
        """Disconnect."""
        await self._connection.close()


def as_bytes(sequence: int, keypoints: Float32) -> bytes:
    """Return a frame (K, P, 2) as it goes over the wire."""
    header = HEADER.pack(FRAME, 0, len(keypoints), sequence)
    return header + keypoints.astype("<f4", copy=False).tobytes()


def as_text(sequence: int, keypoints: Float32) -> str:
    """Return a frame (K, P, 2) as JSON."""
    frame = {"sequence": sequence, "keypoints": np.ascontiguousarray(keypoints)}
    return orjson.dumps(frame, option=orjson.OPT_SERIALIZE_NUMPY).decode()


@dataclass
class Tally:
    """What became of the frames of all clients."""

    sent: int = 0
    seconds: list[float] = field(default_factory=list)  # of each answer, from when it was due
    dropped: int = 0
    continued: int = 0
    shown: int = 0  # to who watches

    def row(self) -> Row:
        """Return the figures as columns."""
        return {
            "sent": self.sent,
            "dropped": self.dropped,
            "unanswered": self.sent - self.dropped - len(self.seconds),
            **spread(self.seconds),
            "most ms": 1000 * max(self.seconds, default=np.nan),
            "continued %": 100 * self.continued / max(len(self.seconds), 1),
            "shown": self.shown,
        }


async def measure_streams(
    running: Service, model: str, keypoints: Float32, arguments: argparse.Namespace
) -> tuple[dict[str, list[Row]], list[Bar]]:
    """Let clients send at the pace of cameras: feed-forward, then refined with continuity.

    Each way also while all streams are watched. With `--stream-lag` also with frames that are
    smoothed in time.
    """
    rows, bars = [], []
    lags = [None] if arguments.stream_lag is None else [None, arguments.stream_lag]
    ways = ((120, "off", 20.0), (60, "auto", 30.0))
    for (rate, refine, most), lag, watched in product(ways, lags, (False, True)):
        start: dict[str, object] = {
            "model": model,
            "refine": refine,
            "on_overload": "latest",
            "continuity": refine != "off",
        }
        if lag is not None:
            start |= {"lag": lag, "fps": rate}
        await _run(running, start, keypoints, rate, 1, watched=watched)  # warms up
        own = time.process_time()
        seconds = arguments.stream_seconds
        tally = await _run(running, start, keypoints, rate, seconds, watched=watched)
        own = time.process_time() - own
        name = "feed-forward" if refine == "off" else "refined, continuity"
        name += "" if lag is None else f", lag {lag}"
        name += ", watched" if watched else ""
        what = f"{CLIENTS} streams x {rate} frames/s, {name}"
        rows.append(
            {
                "stream": what,
                **tally.row(),
                "generator % of a core": 100 * own / arguments.stream_seconds,
            }
        )
        lost = tally.sent - len(tally.seconds)
        bars += [
            Bar(f"{what}: frames without an answer", 0, lost, ""),
            Bar(f"{what}: p99", most, spread(tally.seconds)["p99 ms"], "ms"),
        ]
    title = f"Streams of {arguments.stream_seconds:g} s, timed from when frames were due"
    return {title: rows}, bars


async def _run(
    running: Service,
    start: dict[str, object],
    keypoints: Float32,
    rate: int,
    seconds: float,
    *,
    watched: bool,
) -> Tally:
    tally, chance = Tally(), random.Random(0)  # noqa: S311
    streams = [await Stream.open(running, **start) for _ in range(CLIENTS)]
    watching = [asyncio.create_task(w) for w in await _watchers(running)] if watched else []
    begin = time.perf_counter() + 0.1
    count, lag = round(rate * seconds), start.get("lag")
    frames = [keypoints[n % len(keypoints)] for n in range(count)]
    await asyncio.gather(
        *(
            # No two cameras' ticks coincide for long.
            _play(stream, frames, begin + chance.random() / rate, rate, tally, lag)
            for stream in streams
        )
    )
    for stream in streams:
        await stream.close()
    tally.shown = sum([await task for task in watching])
    return tally


async def _watchers(running: Service) -> list[Coroutine[None, None, int]]:
    """Return what watches each stream to its end, and returns how many frames came."""
    found: list[dict[str, str]] = []
    while len(found) < CLIENTS:  # they are listed a moment after they were opened
        await asyncio.sleep(0.1)
        found = running.client.get("/lift/streams").json()["items"]
    return [_watch(running, each["id"]) for each in found]


async def _watch(running: Service, identifier: str) -> int:
    uri = f"ws://{running.host}:{running.port}/lift/streams/{identifier}/watch"
    async with connect(uri, compression=None, proxy=None, ping_interval=None) as connection:
        return sum([isinstance(message, bytes) async for message in connection])


async def _play(
    stream: Stream, frames: list[Float32], begin: float, rate: int, tally: Tally, lag: object
) -> None:
    late = lag if isinstance(lag, int) else 0  # frames that an answer waits for

    async def listen() -> None:
        waiting = len(frames)
        while waiting:
            message = await stream.receive()
            if isinstance(message, bytes):
                _, flags, _, sequence = HEADER.unpack_from(message)
                due = begin + min(sequence + late, len(frames) - 1) / rate
                tally.seconds.append(time.perf_counter() - due)
                tally.continued += bool(flags & CONTINUED)
                waiting -= 1
                continue
            said = orjson.loads(message)
            if said["type"] != "dropped":
                raise RuntimeError(f"the stream answered {message}")
            tally.dropped += len(said["sequences"])
            waiting -= len(said["sequences"])

    listening = asyncio.create_task(listen())
    with suppress(ConnectionClosed):  # then the last message says why
        for sequence, frame in enumerate(frames):
            message = as_bytes(sequence, frame)
            await asyncio.sleep(begin + sequence / rate - time.perf_counter())
            await stream.send(message)
            tally.sent += 1
        if lag is not None:
            await stream.send('{"flush": true}')
    await asyncio.wait([listening], timeout=GRACE_SECONDS)
    if listening.done():
        listening.result()
    listening.cancel()
