"""Many clients that lift single frames: each after its last answer, or whenever chance has it."""

import argparse
import asyncio
import random
import time
from collections import Counter
from collections.abc import AsyncIterator, Hashable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import cycle
from typing import NamedTuple, TypeVar

import orjson

from benchmarks.captures import Float32
from benchmarks.figures import Bar, Row, spread
from benchmarks.service_rig import Service
from benchmarks.wire import Connection, post

JSON = "application/json"
DIFFERENT = 200  # frames that the requests go through
ROUNDS = 3  # numbers of clients take turns so many times
WARM_UP_SECONDS = 0.5
SHARES = (0.25, 0.5, 0.75, 0.9, 1.1)  # of the most that clients got, as rates of arrival
CONNECTIONS = 64  # that arrivals share
Tables = dict[str, list[Row]]
Key = TypeVar("Key", bound=Hashable)


@dataclass
class Tally:
    """Answers of one number of clients, or of one rate."""

    seconds: list[float] = field(default_factory=list)  # of each answer
    statuses: Counter[int] = field(default_factory=Counter)
    elapsed: float = 0.0
    own: float = 0.0  # processor seconds of this process

    def row(self) -> Row:
        """Return the figures as columns."""
        count = sum(self.statuses.values())
        return {
            "answers/s": self.statuses[200] / self.elapsed,
            **spread(self.seconds),
            "refused (503)": self.statuses[503],
            "other errors": count - self.statuses[200] - self.statuses[503],
            "generator µs each": 1e6 * self.own / max(count, 1),
        }

    @property
    def throughput(self) -> float:
        """Lifted frames per second."""
        return self.statuses[200] / self.elapsed


class Load(NamedTuple):
    """So many clients of a service, and what they ask for."""

    running: Service
    requests: list[bytes]
    clients: int


async def measure_requests(
    running: Service, model: str, keypoints: Float32, arguments: argparse.Namespace
) -> tuple[Tables, list[Bar]]:
    """Measure single frames over HTTP as JSON, closed loop, then open loop."""
    requests = single_frames(model, keypoints)
    cases = {count: Load(running, requests, count) for count in arguments.clients}
    closed = await closed_loop(cases, arguments.seconds)
    most = max(tally.throughput for tally in closed.values())
    rates = arguments.rates or [round(share * most) for share in SHARES]
    opened = {rate: await open_loop(running, requests, rate, arguments.seconds) for rate in rates}
    tables = {
        "Closed loop: each client sends when it has its answer": [
            {"clients": clients, **tally.row()} for clients, tally in closed.items()
        ],
        "Open loop: arrivals by chance, timed from when they were due": [
            {"arrivals/s": rate, **tally.row()} for rate, tally in opened.items()
        ],
    }
    bars = []
    if {1, 32} <= closed.keys():
        ratio = closed[32].throughput / closed[1].throughput
        p99 = spread(closed[32].seconds)["p99 ms"]
        bars = [
            Bar("32 clients, throughput of one client", 5, ratio, "x", least=True),
            Bar("32 clients, p99", 60, p99, "ms"),
        ]
    return tables, bars


def single_frames(model: str, keypoints: Float32) -> list[bytes]:
    """Return requests of one frame each, as JSON both ways."""
    return [
        post(
            "/lift",
            orjson.dumps(
                {"model": model, "frames": [frame], "refine": "off"},
                option=orjson.OPT_SERIALIZE_NUMPY,
            ),
            content=JSON,
            accept=JSON,
        )
        for frame in keypoints[:DIFFERENT]
    ]


async def closed_loop(cases: dict[Key, Load], seconds: float) -> dict[Key, Tally]:
    """Let clients each send one request after the other; the cases take turns."""
    tallies = {key: Tally() for key in cases}
    for _ in range(ROUNDS):
        for key, load in cases.items():
            async with connections(load.running, load.clients) as open_ones:
                bodies = cycle(load.requests)
                await all_busy(open_ones, bodies, Tally(), WARM_UP_SECONDS)
                await all_busy(open_ones, bodies, tallies[key], seconds / ROUNDS)
    return tallies


async def all_busy(
    open_ones: list[Connection], requests: Iterator[bytes], tally: Tally, seconds: float
) -> None:
    """Have each connection send one request after the other for so long."""
    started, own = time.perf_counter(), time.process_time()

    async def client(connection: Connection) -> None:
        while (sent := time.perf_counter()) - started < seconds:
            await _ask(connection, next(requests), sent, tally)

    await asyncio.gather(*map(client, open_ones))
    tally.elapsed += time.perf_counter() - started
    tally.own += time.process_time() - own


async def open_loop(running: Service, requests: list[bytes], rate: float, seconds: float) -> Tally:
    """Send requests as a Poisson process has it, whatever became of those before.

    An answer's time counts from when its request was due, waiting for a connection included: a
    service that falls behind cannot hide it by having the clients wait.
    """
    tally, chance, bodies = Tally(), random.Random(0), cycle(requests)  # noqa: S311
    async with connections(running, CONNECTIONS) as open_ones:
        await all_busy(open_ones[:4], bodies, Tally(), WARM_UP_SECONDS)
        free: asyncio.LifoQueue[Connection] = asyncio.LifoQueue()
        for connection in open_ones:
            free.put_nowait(connection)

        async def one(due: float) -> None:
            connection = await free.get()
            await _ask(connection, next(bodies), due, tally)
            free.put_nowait(connection)

        started, own = time.perf_counter(), time.process_time()
        due = started
        async with asyncio.TaskGroup() as group:
            while (due := due + chance.expovariate(rate)) - started < seconds:
                await asyncio.sleep(due - time.perf_counter())
                group.create_task(one(due))
        tally.elapsed = time.perf_counter() - started
        tally.own = time.process_time() - own
    return tally


async def _ask(connection: Connection, request: bytes, since: float, tally: Tally) -> None:
    answer = await connection.ask(request)
    tally.statuses[answer.status] += 1
    if answer.status == 200:
        tally.seconds.append(time.perf_counter() - since)


@asynccontextmanager
async def connections(running: Service, count: int) -> AsyncIterator[list[Connection]]:
    """Hold so many connections open."""
    found = [await Connection.open(running.host, running.port) for _ in range(count)]
    try:
        yield found
    finally:
        for connection in found:
            connection.close()
