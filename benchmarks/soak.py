"""Whether the service stays as it is for long: single frames at half of what it can, and fits.

    python benchmarks/soak.py [--minutes 20] [--capture FILE.npz] [--model FILE] [--json FILE]

Two processes of the API, a worker that fits all the time. README.md says what each row is.
"""

import argparse
import asyncio
import gc
import os
from typing import Any

import uvloop

from benchmarks.captures import Capture, add_options, from_options, model_from_options
from benchmarks.clients import Load, closed_loop, open_loop, single_frames
from benchmarks.figures import Bar, Results, Row, command
from benchmarks.service_rig import Service, processes_below, resident_bytes, service
from models.lifting.fitted_prior import FittedPrior
from models.numerics.threads import use_threads

CLIENTS = 8  # that find out how much the service can
SHARE = 0.5  # of that
STEPS = 200  # of each fit
PEAK_SECONDS = 6.0
SEGMENTS = 20  # looks at answers and memory
SETTLED = 0.25  # share of the time after which memory should have settled
MEBIBYTE = 1024 * 1024
PARTS = {b"service.app": "API", b"worker": "worker", b"serve": "supervisor"}


def main() -> None:
    """Run the command line."""
    parser = command("Have the service lift and fit for long.")
    add_options(parser)
    parser.add_argument("--minutes", type=float, default=20, help="default: %(default)s")
    arguments = parser.parse_args()
    use_threads(1)
    capture = from_options(arguments)
    prior = model_from_options(arguments, capture)
    gc.collect()
    gc.freeze()  # the generator's own pauses would count as the service's
    with service("--api-processes=2", "--workers=1") as running:
        rows, bars = uvloop.run(_soak(running, prior, capture, arguments))
    Results("soak", vars(arguments), {"Lifts and fits, and memory": rows}, bars).publish(
        arguments.json
    )


async def _soak(
    running: Service, prior: FittedPrior, capture: Capture, arguments: argparse.Namespace
) -> tuple[list[Row], list[Bar]]:
    requests = single_frames(running.import_model(prior), capture.keypoints)
    peak = await closed_loop({0: Load(running, requests, CLIENTS)}, PEAK_SECONDS)
    rate = SHARE * peak[0].throughput
    dataset = running.upload(capture)
    fits: list[dict[str, Any]] = []
    fitting = asyncio.create_task(_fit_all_the_time(running, dataset, fits))
    parts = _parts()
    rows: list[Row] = []
    seconds = 60 * arguments.minutes / SEGMENTS
    try:
        for segment in range(1, SEGMENTS + 1):
            tally = await open_loop(running, requests, rate, seconds)
            sizes = {f"{name} MiB": resident_bytes(at) / MEBIBYTE for name, at in parts.items()}
            figures = tally.row() | {"fits": len(fits)}
            del figures["generator µs each"]
            rows.append({"minutes": segment * seconds / 60, "asked/s": rate, **figures, **sizes})
            if fitting.done():
                break  # it failed, and says so below
    finally:
        fitting.cancel()
    if fitting.done() and not fitting.cancelled():
        fitting.result()
    return rows, _bars(rows, list(parts))


async def _fit_all_the_time(running: Service, dataset: str, fits: list[dict[str, Any]]) -> None:
    """Fit, delete what came of it, fit again; the capture is the same, so memory may be too."""
    body = {"dataset_id": dataset, "config": {"steps": STEPS}}
    while True:
        fit, _ = await asyncio.to_thread(running.run, "/fits", body)
        for path in (f"/fits/{fit['id']}", f"/models/{fit['model_id']}"):
            (await asyncio.to_thread(running.client.delete, path)).raise_for_status()
        fits.append(fit)


def _parts() -> dict[str, int]:
    """Return the processes that live as long as the service, by name."""
    found: dict[str, int] = {}
    supervisor = next(at for at, _, words in processes_below() if b"serve" in words)
    for process, parent, words in processes_below():
        if parent not in (os.getpid(), supervisor):
            continue
        name = next((PARTS[word] for word in words if word in PARTS), None)
        if name is None and b"valkey-server" in words[0]:
            name = "Valkey"
        if name is not None:
            count = sum(known.startswith(name) for known in found)
            found[f"{name} {count + 1}" if name == "API" else name] = process
    return found


def _bars(rows: list[Row], parts: list[str]) -> list[Bar]:
    settled = rows[max(0, round(SETTLED * len(rows)) - 1)]
    errors = sum(row["refused (503)"] + row["other errors"] for row in rows)
    bars = [Bar("requests refused or failed", 0, errors, "")]
    for part in parts:
        growth = 100 * (rows[-1][f"{part} MiB"] / settled[f"{part} MiB"] - 1)
        what = f"memory of {part} at the end above that after {settled['minutes']:g} minutes"
        bars.append(Bar(what, 5, growth, "%"))
    return bars


if __name__ == "__main__":
    main()
