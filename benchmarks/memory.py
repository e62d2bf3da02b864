"""How much memory the API has in use after many lifts of mixed sizes."""

import argparse
import asyncio
import random

import numpy as np
import orjson
from safetensors.numpy import save

from benchmarks.captures import Float32
from benchmarks.clients import JSON, connections
from benchmarks.figures import Bar, Row
from benchmarks.service_rig import BYTES, Service, api_processes, resident_bytes
from benchmarks.wire import Connection, post

CLIENTS = 4
EARLY = 0.1  # share of the lifts after which memory should have settled
LOOKS = 20  # at the memory in all
LARGEST = 1000  # frames of a lift; sizes are equally spread over orders of magnitude
MEBIBYTE = 1024 * 1024


async def measure_memory(
    running: Service, model: str, keypoints: Float32, arguments: argparse.Namespace
) -> tuple[dict[str, list[Row]], list[Bar]]:
    """Look at the API's memory as it lifts one frame to many, few views to all, JSON and binary."""
    processes = api_processes()

    def mebibytes() -> float:
        return sum(map(resident_bytes, processes)) / MEBIBYTE

    chance = random.Random(0)  # noqa: S311
    rows: list[Row] = [{"lifts": 0, "resident MiB": mebibytes()}]
    steps = sorted({round(arguments.lifts * look / LOOKS) for look in range(1, LOOKS + 1)})
    done = 0
    async with connections(running, CLIENTS) as open_ones:
        for step in steps:
            await asyncio.gather(
                *(
                    _send(connection, model, keypoints, chance, share)
                    for connection, share in zip(
                        open_ones, _split(step - done, CLIENTS), strict=True
                    )
                )
            )
            done = step
            rows.append({"lifts": done, "resident MiB": mebibytes()})
    early = round(EARLY * arguments.lifts)
    first = next(row["resident MiB"] for row in rows if row["lifts"] >= early)
    growth = 100 * (rows[-1]["resident MiB"] / first - 1)
    what = f"resident memory after {done:,} lifts above that after {early:,}"
    return {"Memory of the API": rows}, [Bar(what, 5, growth, "%")]


def some_request(model: str, keypoints: Float32, chance: random.Random) -> bytes:
    """Return a lift of any size, views and form."""
    size = round(LARGEST ** chance.random())
    views = chance.randint(1, keypoints.shape[1])
    frames = np.ascontiguousarray(keypoints[:size, :views])
    if chance.random() < 0.5:
        body = {"model": model, "frames": frames, "refine": "off"}
        return post(
            "/lift",
            orjson.dumps(body, option=orjson.OPT_SERIALIZE_NUMPY),
            content=JSON,
            accept=JSON,
        )
    path = f"/lift?model={model}&refine=off"
    return post(path, save({"frames": frames}), content=BYTES, accept=BYTES)


async def _send(
    connection: Connection, model: str, keypoints: Float32, chance: random.Random, count: int
) -> None:
    for _ in range(count):
        answer = await connection.ask(some_request(model, keypoints, chance))
        if answer.status not in (200, 503):  # refused is fine: that too must not cost memory
            raise RuntimeError(f"POST /lift answered {answer.status}: {answer.body[:500]!r}")


def _split(count: int, parts: int) -> list[int]:
    return [count // parts + (part < count % parts) for part in range(parts)]
