"""How long one lift takes: over HTTP as JSON and as safetensors, and in this process.

    python benchmarks/lift.py [--model-keypoints 17] [--views 4] [--lifts 1000] [--json FILE]

The three take turns, one lift each, so that a machine that gets slower gets slower for all.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from safetensors.numpy import load, save

from models.fitted import FittedPrior
from models.synthetic import synthetic_capture

sys.path.append(str(Path(__file__).parents[1] / "examples"))  # where `embedded` lies
from embedded import running_service

FRAMES = 200
FIT_STEPS = 200  # a lift takes the same time however good the fit is
WARM_UP = 50
BAR_MS = 10.0  # the median of HTTP JSON should not be above it
BYTES = "application/octet-stream"

Float32 = NDArray[np.float32]


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    torch.set_num_threads(1)  # as in the service
    keypoints = make_keypoints(arguments.model_keypoints, arguments.views)
    with (
        running_service() as address,
        httpx2.Client(base_url=address, timeout=120, trust_env=False) as client,
    ):
        model = fit(client, keypoints)
        ways = ways_to_lift(client, model, keypoints[:1])
        milliseconds = take_turns(ways, arguments.lifts)
    figures = summarise(milliseconds) | {
        "views": arguments.views,
        "keypoints": arguments.model_keypoints,
        "lifts": arguments.lifts,
    }
    show(figures)
    line = json.dumps(figures)
    if arguments.json is not None:
        arguments.json.write_text(line + "\n")
    print(line)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Time the lift of one frame.")
    parser.add_argument("--model-keypoints", type=int, default=17, help="default: %(default)s")
    parser.add_argument("--views", type=int, default=4, help="default: %(default)s")
    parser.add_argument("--lifts", type=int, default=1000, help="of each kind: %(default)s")
    parser.add_argument("--json", type=Path, help="also write the last line to this file")
    return parser.parse_args()


def make_keypoints(count: int, views: int) -> Float32:
    """Return frames (N, K, count, 2) of a synthetic figure.

    Beyond the figure's own keypoints, there are as many means of some of them as are asked for.
    """
    keypoints = synthetic_capture(frames=FRAMES, views=views, noise=1.0).keypoints
    extra = max(0, count - keypoints.shape[2])
    shares = np.random.default_rng(0).dirichlet(np.full(keypoints.shape[2], 0.3), extra)
    means = np.einsum("ep,nkpc->nkec", shares, keypoints)
    return np.concatenate((keypoints, means), axis=2)[:, :, :count].astype(np.float32)


def fit(client: httpx2.Client, keypoints: Float32) -> str:
    """Fit a model over HTTP and return its identifier."""
    dataset = client.post(
        "/datasets", content=save({"keypoints": keypoints}), headers={"Content-Type": BYTES}
    )
    job = client.post(
        "/fits",
        json={
            "dataset_id": dataset.raise_for_status().json()["id"],
            "config": {"steps": FIT_STEPS},
        },
    )
    path = f"/fits/{job.raise_for_status().json()['id']}"
    while (found := client.get(path).json())["status"] in ("queued", "running"):
        time.sleep(0.2)
    if found["status"] != "succeeded":
        sys.exit(f"The fit {found['status']}: {found['error']}")
    return str(found["model_id"])


def ways_to_lift(
    client: httpx2.Client, model: str, frame: Float32
) -> dict[str, Callable[[], object]]:
    """Return functions that lift the frame (1, K, P, 2), all from the array to the answer."""
    weights = client.get(f"/models/{model}/weights").raise_for_status().content
    prior = FittedPrior.from_bytes(weights)

    def http_json() -> Any:
        body = {"model": model, "frames": frame.tolist()}
        return client.post("/lift", json=body).raise_for_status().json()

    def http_safetensors() -> dict[str, NDArray[Any]]:
        answer = client.post(
            "/lift",
            params={"model": model},
            content=save({"frames": frame}),
            headers={"Content-Type": BYTES, "Accept": BYTES},
        )
        return load(answer.raise_for_status().content)

    def in_process() -> object:
        return prior.lift(frame)

    return {
        "http_json": http_json,
        "http_safetensors": http_safetensors,
        "in_process": in_process,
    }


def take_turns(ways: dict[str, Callable[[], object]], lifts: int) -> dict[str, list[float]]:
    """Return the milliseconds of each lift, the first few of each kind left out."""
    milliseconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(WARM_UP + lifts):
        for name, way in ways.items():
            started = time.perf_counter()
            way()
            milliseconds[name].append(1000 * (time.perf_counter() - started))
    return {name: times[WARM_UP:] for name, times in milliseconds.items()}


def summarise(milliseconds: dict[str, list[float]]) -> dict[str, Any]:
    """Return percentiles and means, how many times as long HTTP takes, and whether that will do."""
    figures: dict[str, Any] = {}
    for name, times in milliseconds.items():
        for share in (50, 90, 99):
            figures[f"{name}_ms_p{share}"] = round(float(np.percentile(times, share)), 3)
        figures[f"{name}_ms_mean"] = round(float(np.mean(times)), 3)
    for name in ("http_json", "http_safetensors"):
        ratio = figures[f"{name}_ms_p50"] / figures["in_process_ms_p50"]
        figures[f"{name}_ratio"] = round(ratio, 3)
    figures["bar_ms"] = BAR_MS
    figures["within_bar"] = figures["http_json_ms_p50"] <= BAR_MS
    return figures


def show(figures: dict[str, Any]) -> None:
    """Print the figures as a table."""
    title = f"One frame of {figures['views']} views x {figures['keypoints']} keypoints, ms"
    columns = ("p50", "p90", "p99", "mean")
    table = Table("", *columns, "p50 / in process", title=title)
    for name, label in (
        ("http_json", "HTTP, JSON"),
        ("http_safetensors", "HTTP, safetensors"),
        ("in_process", "in process"),
    ):
        times = [f"{figures[f'{name}_ms_{column}']:.2f}" for column in columns]
        table.add_row(label, *times, f"{figures.get(f'{name}_ratio', 1):.2f}")
    console = Console(highlight=False)
    console.print(table)
    verdict = "within" if figures["within_bar"] else "above"
    console.print(f"The median of HTTP, JSON is {verdict} the bar of {BAR_MS:g} ms.")


if __name__ == "__main__":
    main()
