"""Single frames while nobody can write the records, and more requests wait for that than may."""

import argparse
import asyncio
import sqlite3
from contextlib import closing
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from safetensors.numpy import save

from benchmarks.captures import Float32
from benchmarks.clients import JSON, Tables, Tally, all_busy, connections, single_frames
from benchmarks.figures import Bar, spread
from benchmarks.service_rig import BYTES, Service, copy_model, service
from benchmarks.wire import post

WAITING = 60  # requests: more than there are threads for them
SETTLE_SECONDS = 1.0


async def measure_outage(
    running: Service, model: str, keypoints: Float32, arguments: argparse.Namespace
) -> tuple[Tables, list[Bar]]:
    """Let a lone client lift before, while and after the records are locked."""
    seconds = arguments.locked_seconds
    free, locked = Tally(), Tally()
    with TemporaryDirectory() as folder:
        data = Path(folder, "data")
        with service("--api-processes=1", "--workers=0", data=data) as one:
            bodies = cycle(single_frames(copy_model(model, running, one), keypoints))
            upload = post(
                "/datasets",
                save({"keypoints": np.ascontiguousarray(keypoints[:1])}),
                content=BYTES,
                accept=JSON,
            )
            async with connections(one, 1) as client, connections(one, WAITING) as others:
                await all_busy(client, bodies, Tally(), SETTLE_SECONDS)
                await all_busy(client, bodies, free, seconds / 2)
                with closing(sqlite3.connect(data / "records.db", isolation_level=None)) as records:
                    records.execute("BEGIN EXCLUSIVE")
                    waiting = [asyncio.create_task(other.ask(upload)) for other in others]
                    await all_busy(client, bodies, locked, seconds)
                    records.execute("ROLLBACK")
                answers = await asyncio.gather(*waiting)
                await all_busy(client, bodies, Tally(), SETTLE_SECONDS)
                await all_busy(client, bodies, free, seconds / 2)
    rows = [
        {"records": name, **tally.row(), "most ms": 1000 * max(tally.seconds)}
        for name, tally in (("as always", free), ("locked", locked))
    ]
    done = sum(answer.status == 201 for answer in answers)
    title = (
        f"A lone client while the records are locked for {seconds:g} s and {WAITING} uploads wait "
        f"({done} were stored in the end, the others got 503)"
    )
    ratio = spread(locked.seconds)["p99 ms"] / spread(free.seconds)["p99 ms"]
    return {title: rows}, [Bar("records locked, one frame, p99 of that without", 1.2, ratio, "x")]
