"""What a training step takes on a core of the processor and on a GPU, and where the GPU pays.

    python -m benchmarks.devices [--steps 30]

For priors of several sizes, the same batches are learnt from the same weights on both. Beside the
times stands whether workers take the GPU (`worker.needs.gpu_pays`), and how far the losses of the
two are apart. Without a GPU only the processor is measured.
"""

import argparse
import time
from itertools import product

import numpy as np
import torch

from benchmarks.figures import Bar, Results, Row, command
from models.network.losses import Batch
from models.network.priors.prior import Prior
from models.network.priors.registry import make_prior
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.training.learner import Learner
from worker.needs import gpu_pays

VIEWS = 3
KEYPOINTS = (17, 133)
DICTIONARIES = ([32, 8], [128, 64, 32, 16, 8], [512, 256, 128, 64, 32])
BATCHES = (64, 512)
WARM_STEPS = 5
RATE = 1e-3
APART = 1e-2  # of a loss: sums run in another order, over and over


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)
    rows = [
        measure(keypoints, sizes, frames, arguments.steps)
        for keypoints, sizes, frames in product(KEYPOINTS, DICTIONARIES, BATCHES)
    ]
    both = [row for row in rows if "GPU ms" in row]
    bars = []
    if both:
        bars = [
            Bar("losses of processor and GPU, apart", APART, max(r["apart"] for r in both), ""),
            Bar("time lost by the choice of device", 2.0, max(map(lost, both)), "x"),
        ]
    Results("devices", vars(arguments), {"A step of training": rows}, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure training steps on a processor core and on a GPU.")
    parser.add_argument("--steps", type=int, default=30, help="that are timed")
    return parser.parse_args()


def measure(keypoints: int, sizes: list[int], frames: int, steps: int) -> Row:
    """Return what steps with so many frames take."""
    config = FitConfig(dictionary_sizes=sizes, batch_size=frames)
    drawn = batch(frames, keypoints)
    seconds, loss = train(prior_of(config, keypoints), drawn, torch.device("cpu"), steps)
    pays = gpu_pays(config, frames, VIEWS, keypoints)
    row: Row = {
        "keypoints": keypoints,
        "dictionary": "-".join(map(str, sizes)),
        "frames": frames,
        "core ms": 1000 * seconds,
        "taken": "GPU" if pays else "core",
    }
    if torch.cuda.is_available():
        own, other = train(prior_of(config, keypoints), drawn, torch.device("cuda"), steps)
        row |= {"GPU ms": 1000 * own, "apart": abs(other - loss) / loss}
    return row


def lost(row: Row) -> float:
    """Return the time of the device that is taken over that of the faster one."""
    taken = row["GPU ms"] if row["taken"] == "GPU" else row["core ms"]
    return float(taken / min(row["GPU ms"], row["core ms"]))


def prior_of(config: FitConfig, keypoints: int) -> Prior:
    """Return a prior with drawn weights, the same for each call."""
    torch.manual_seed(0)
    prior = make_prior(config, keypoints)
    for weights in prior.parameters():
        torch.nn.init.normal_(weights, std=0.1)
    return prior


def batch(frames: int, keypoints: int) -> Batch:
    """Return frames of drawn keypoints."""
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(frames, VIEWS, keypoints, 2))
    ones = torch.ones(frames, VIEWS, keypoints)
    return Batch(
        torch.as_tensor(drawn, dtype=torch.float32),
        ones,
        100 * ones[..., 0],
        torch.ones(frames),
        torch.zeros(frames, keypoints, 3),
        torch.zeros(frames),
    )


def train(prior: Prior, frames: Batch, device: torch.device, steps: int) -> tuple[float, float]:
    """Return the seconds of a step and the loss after the last."""
    learner = Learner(prior, device)
    for count in range(1, WARM_STEPS + 1):
        learner.step(frames, count=count, rate=RATE)
    began, loss = time.perf_counter(), 0.0
    for count in range(WARM_STEPS + 1, WARM_STEPS + 1 + steps):
        loss, _ = learner.step(frames, count=count, rate=RATE)  # waits for the GPU
    return (time.perf_counter() - began) / steps, loss


if __name__ == "__main__":
    main()
