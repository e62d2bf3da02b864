"""How long first lifts of models take: after a start, once an alias was moved, once a model came.

    python -m benchmarks.first_lift [--models 20] [--wait 3]

A fit that ends stores its model as an import does, so models are imported. Prints the slowest and
the median of first lifts of a frame, each of another model, over HTTP. After a start, models that
aliases name are lifted with `--wait` seconds later; after a change at once.
"""

import argparse
import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import orjson

from benchmarks.captures import Capture, Float32, fitted, studio
from benchmarks.service_rig import Service, service
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig


def first_lift(running: Service, model: str, frame: Float32) -> float:
    """Return the seconds that a lift of a frame (1, K, P, 2) takes."""
    body = orjson.dumps({"model": model, "frames": frame.tolist()})
    running.client.get("/health/live")  # a connection is open
    started = time.perf_counter()
    answer = running.client.post("/lift", content=body, headers={"Content-Type": JSON})
    answer.raise_for_status()
    return time.perf_counter() - started


JSON = "application/json"


def measure(prior: FittedPrior, capture: Capture, models: int, wait: float) -> None:
    """Measure with so many models, in a service of its own that is started again."""
    frame = capture.keypoints[:1]
    with TemporaryDirectory() as folder:
        data = Path(folder, "data")
        with service(data=data) as running:
            known = [running.import_model(prior) for _ in range(models)]
            for number, model in enumerate(known):
                point(running, f"m{number}@live", model)
        with service(data=data) as running:
            time.sleep(wait)
            show("start", [first_lift(running, f"m{n}@live", frame) for n in range(models)])
            moved, came = [], []
            for _ in range(models):
                point(running, "moving@live", running.import_model(prior))
                moved.append(first_lift(running, "moving@live", frame))
                came.append(first_lift(running, running.import_model(prior), frame))
            show("alias moved", moved)
            show("model came", came)


def point(running: Service, alias: str, model: str) -> None:
    """Have an alias point to a model."""
    running.client.put(f"/models/{alias}", json={"model_id": model}).raise_for_status()


def show(name: str, seconds: list[float]) -> None:
    """Print the slowest and the median."""
    slowest, median = 1000 * max(seconds), 1000 * statistics.median(seconds)
    print(f"{name:<12} slowest {slowest:5.0f} ms, median {median:5.0f} ms")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=int, default=20)
    parser.add_argument("--wait", type=float, default=3, help="seconds after a start")
    asked = parser.parse_args()
    shown = studio(3, frames=80)
    made = fitted(shown, FitConfig(steps=150, cameras="static"))
    measure(made, shown, asked.models, asked.wait)
