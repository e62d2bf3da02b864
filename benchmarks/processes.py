"""Several processes of the API against one: the same clients, in turns."""

import argparse
from contextlib import ExitStack

from benchmarks.captures import Float32
from benchmarks.clients import Load, Tables, closed_loop, single_frames
from benchmarks.figures import Bar, spread
from benchmarks.service_rig import (
    Service,
    api_processes,
    copy_model,
    proportional_bytes,
    resident_bytes,
    service,
)

CLIENTS = (1, 8, 32)
MEBIBYTE = 1024 * 1024


async def measure_processes(
    running: Service, model: str, keypoints: Float32, arguments: argparse.Namespace
) -> tuple[Tables, list[Bar]]:
    """Let clients lift single frames with services of one process and of several."""
    several = arguments.processes
    loads: dict[tuple[int, int], Load] = {}
    memory: dict[int, list[int]] = {}
    with ExitStack() as services:
        for count in (1, several):
            before = set(api_processes())
            one = services.enter_context(service(f"--api-processes={count}", "--workers=0"))
            requests = single_frames(copy_model(model, running, one), keypoints)
            loads |= {(count, clients): Load(one, requests, clients) for clients in CLIENTS}
            memory[count] = [process for process in api_processes() if process not in before]
        found = await closed_loop(loads, arguments.seconds)
        sizes = [
            {
                "processes of the API": count,
                "process": number,
                "resident MiB": resident_bytes(process) / MEBIBYTE,
                "its share of them MiB": proportional_bytes(process) / MEBIBYTE,
            }
            for count, processes in memory.items()
            for number, process in enumerate(processes, 1)
        ]
    rows = [
        {
            "processes of the API": count,
            "clients": clients,
            **tally.row(),
            "of one process": tally.throughput / found[1, clients].throughput,
        }
        for (count, clients), tally in found.items()
    ]
    alone = {count: spread(found[count, 1].seconds) for count in (1, several)}
    what = f"{several} API processes"
    bars = [
        Bar(
            f"{what}, 32 clients, throughput of one process",
            1,
            found[several, 32].throughput / found[1, 32].throughput,
            "x",
            least=True,
        ),
        Bar(
            f"{what}, a lone client, p50 of one process",
            1.1,
            alone[several]["p50 ms"] / alone[1]["p50 ms"],
            "x",
        ),
        Bar(
            f"{what}, a lone client, p99 / p50",
            4,
            alone[several]["p99 ms"] / alone[several]["p50 ms"],
            "x",
        ),
    ]
    return {"Processes of the API": rows, "Memory of each process": sizes}, bars
