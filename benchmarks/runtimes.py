"""The feed-forward arithmetic of one model under several runtimes, one thread, and its roofline.

    python benchmarks/runtimes.py [--model FILE] [--batches 1 32 1000] [--seconds 5] [--json FILE]

A runtime that is not installed is left out: `pip install onnx onnxruntime onnxscript` for ONNX.
README.md says what each row is.
"""

import argparse
import importlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

# All before the libraries are loaded: one thread for NumPy, and compilers that start from nothing.
os.environ |= {
    "OPENBLAS_NUM_THREADS": "1",
    "TORCHINDUCTOR_FORCE_DISABLE_CACHES": "1",
    "NUMBA_CACHE_DIR": tempfile.mkdtemp(prefix="fewview-"),
}

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load
from torch import Tensor, nn

from benchmarks import arithmetic
from benchmarks.arithmetic import NUMPY, TORCH, Constants, feed_forward, fold
from benchmarks.captures import add_options, from_options, model_from_options
from benchmarks.figures import Results, Row, command, console, spread, take_turns
from models.capture.observations import Observations, as_observations
from models.network.answers import make_answers, nothing_unusual
from models.network.feed_forward import feed_forward as run_compiled
from models.network.priors.hierarchical import HierarchicalPrior
from models.network.settling import SETTLE_NONE
from models.numerics.threads import use_threads

PRODUCTS = "matrix products alone"
MEBIBYTE = 1024 * 1024
PEAK_SIZE = 1024  # of the square matrices whose product shows what a core can do
STREAM_NUMBERS = 64 * MEBIBYTE  # floats: far beyond any cache
PEAK_SECONDS = 3

Float32 = NDArray[np.float32]
Lifts = Callable[[Float32, Float32], Float32]  # keypoints, weights -> points


@dataclass(frozen=True)
class Model:
    """A model's weights, and frames as its network sees them."""

    weights: dict[str, Float32]
    sizes: tuple[int, ...]
    keypoints: Float32  # (N, K, P, 2) normalised
    given: Float32  # (N, K, P) weights of the keypoints

    def batch(self, size: int) -> tuple[Float32, Float32]:
        """Return so many frames."""
        which = np.arange(size) % len(self.keypoints)
        return self.keypoints[which], self.given[which]


@dataclass(frozen=True)
class Runtime:
    """A way to compute, made ready."""

    name: str
    lift: Lifts
    seconds: float  # to make it ready, the first call included
    packages: tuple[str, ...]  # that it needs beyond NumPy


class Straight(nn.Module):
    """The arithmetic as a module, to be compiled or exported."""

    def __init__(self, constants: Constants) -> None:
        super().__init__()
        self.constants = constants

    def forward(self, keypoints: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        """See `benchmarks.arithmetic.feed_forward`."""
        return feed_forward(TORCH, self.constants, keypoints, weights)


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)
    model = prepare(arguments)
    runtimes = make_ready(model, arguments.only)
    views, keypoints = model.keypoints.shape[1:3]
    flops = arithmetic.flops(views, keypoints, model.sizes)
    peak, bandwidth = measure_peak(), measure_bandwidth()
    tables = {
        "One core at best": [
            {
                "sgemm GFLOP/s": peak / 1e9,
                "copy GB/s": bandwidth / 1e9,
                "FLOP per frame": flops,
                "bytes per frame": arithmetic.frame_bytes(views, keypoints),
                "bytes of weights": arithmetic.weight_bytes(keypoints, model.sizes),
                "frames/s by FLOPs": peak / flops,
                "frames/s by bytes": bandwidth / arithmetic.frame_bytes(views, keypoints),
            }
        ],
        "Feed-forward arithmetic, one thread": compare(model, runtimes, arguments, flops / peak),
    }
    shutil.rmtree(os.environ["NUMBA_CACHE_DIR"], ignore_errors=True)
    Results("runtimes", vars(arguments) | {"sizes": model.sizes}, tables).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Compare runtimes for the network of a model.")
    add_options(parser)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 32, 1000], help="frames")
    parser.add_argument("--seconds", type=float, default=10, help="for each batch size: 10")
    parser.add_argument("--only", nargs="+", choices=list(MAKERS), default=list(MAKERS))
    return parser.parse_args()


def prepare(arguments: argparse.Namespace) -> Model:
    """Read a model and the frames that show everything."""
    capture = from_options(arguments)
    prior = model_from_options(arguments, capture)
    if prior.config.prior != "hierarchical":
        sys.exit(
            f"--model: the arithmetic is that of a hierarchical prior, got {prior.config.prior}"
        )
    seen = as_observations(capture.keypoints, capture.confidence)
    whole = np.all(seen.weights > 0, axis=(1, 2))
    names = HierarchicalPrior(prior.keypoints_per_frame, prior.config.dictionary_sizes)
    found = load(prior.to_bytes())
    weights = {name: found[name] for name, _ in names.named_parameters()}
    return Model(weights, prior.config.dictionary_sizes, seen.keypoints[whole], seen.weights[whole])


def make_ready(model: Model, names: list[str]) -> list[Runtime]:
    """Make runtimes ready, leaving out what is not installed."""
    ready = []
    for name in names:
        make, packages = MAKERS[name]
        started = time.perf_counter()
        try:
            lift = make(model)
            lift(*model.batch(2))
        except ImportError as error:
            console.print(f"{name}: left out, {error}")
            continue
        ready.append(Runtime(name, lift, time.perf_counter() - started, packages))
    return ready


def compare(
    model: Model, runtimes: list[Runtime], arguments: argparse.Namespace, best: float
) -> list[Row]:
    """Return a row for each runtime and batch; `best` is the least seconds of a frame."""
    rows = []
    for size in arguments.batches:
        batch = model.batch(size)
        ways = {runtime.name: _bind(runtime.lift, batch) for runtime in runtimes}
        ways[PRODUCTS] = _products(model, size)
        truth = runtimes[0].lift(*batch)
        times = take_turns(ways, arguments.seconds)
        for name, seconds in times.items():
            runtime = next((r for r in runtimes if r.name == name), None)
            median = float(np.median(seconds))
            rows.append(
                {
                    "runtime": name,
                    "frames": size,
                    **spread(seconds),
                    "frames/s": size / median,
                    "% of the core": 100 * best * size / median,
                    "off by": runtime and float(np.abs(runtime.lift(*batch) - truth).max()),
                    "ready s": runtime and runtime.seconds,
                    "MiB installed": runtime and installed(runtime.packages),
                }
            )
    return rows


def _bind(lift: Lifts, batch: tuple[Float32, Float32]) -> Callable[[], object]:
    return lambda: lift(*batch)


def _products(model: Model, size: int) -> Callable[[], object]:
    """Return what computes products of the shapes that there are, and nothing else."""
    views, keypoints = model.keypoints.shape[1:3]
    shapes = arithmetic.products(views, keypoints, model.sizes)
    work = [
        (torch.rand(size * m, k), torch.rand(k, n), torch.empty(size * m, n)) for m, k, n in shapes
    ]
    return lambda: [torch.mm(left, right, out=out) for left, right, out in work]


def measure_peak() -> float:
    """Return the FLOP/s of large matrix products on one core."""
    left, right = torch.rand(2, PEAK_SIZE, PEAK_SIZE)
    out = torch.empty(PEAK_SIZE, PEAK_SIZE)
    times = take_turns({0: lambda: torch.mm(left, right, out=out)}, PEAK_SECONDS)[0]
    return float(2 * PEAK_SIZE**3 / min(times))


def measure_bandwidth() -> float:
    """Return the bytes/s that one core reads and writes as it copies what no cache holds."""
    source, target = torch.ones(2, STREAM_NUMBERS)
    times = take_turns({0: lambda: target.copy_(source)}, PEAK_SECONDS)[0]
    return 2 * arithmetic.FLOAT_BYTES * STREAM_NUMBERS / min(times)


def installed(packages: tuple[str, ...]) -> float:
    """Return the size of packages on disk, MiB."""
    total = 0
    for package in packages:
        try:
            found = files(package) or []
        except PackageNotFoundError:
            continue
        paths = (Path(str(file.locate())) for file in found)
        total += sum(path.stat().st_size for path in paths if path.is_file())
    return total / MEBIBYTE


def as_trained(model: Model) -> Lifts:
    """Make the module that fits train, as it stands."""
    network = HierarchicalPrior(model.keypoints.shape[2], model.sizes)
    network.load_state_dict({name: torch.from_numpy(v) for name, v in model.weights.items()})
    return _in_torch(network)


def straight(model: Model) -> Lifts:
    """Make the arithmetic in torch, operation by operation."""
    return _in_torch(_module(model))


def compiled(model: Model) -> Lifts:
    """Make `torch.compile` of it, a program for each batch size."""
    return _in_torch(torch.compile(_module(model), dynamic=False))


def ahead_of_time(model: Model) -> Lifts:
    """Make AOTInductor's library of it, for any batch size."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "lift.pt2"))
        torch._inductor.aoti_compile_and_package(_exported(model), package_path=path)
        return _in_torch(torch._inductor.aoti_load_package(path))


def onnx(model: Model) -> Lifts:
    """Make a session of ONNX Runtime."""
    runtime = importlib.import_module("onnxruntime")
    importlib.import_module("onnxscript")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "lift.onnx"))
        torch.onnx.export(
            _exported(model), (), path, dynamo=True, external_data=False, verbose=False
        )
        session = runtime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    inputs = [given.name for given in session.get_inputs()]

    def lift(keypoints: Float32, weights: Float32) -> Float32:
        points: Float32 = session.run(None, dict(zip(inputs, (keypoints, weights), strict=True)))[0]
        return points

    return lift


def in_numpy(model: Model) -> Lifts:
    """Make the arithmetic in NumPy."""
    constants = fold(model.weights, len(model.sizes), np.concatenate)
    return lambda keypoints, weights: feed_forward(NUMPY, constants, keypoints, weights)[0]


def in_numba(model: Model) -> Lifts:
    """Make what lifts are made with; it also measures the errors, frame by frame."""
    tensors = {name: torch.from_numpy(value) for name, value in model.weights.items()}
    network = HierarchicalPrior.lay_out(tensors, model.sizes)

    def lift(keypoints: Float32, weights: Float32) -> Float32:
        frames, views, count, _ = keypoints.shape
        pairs = (frames, views)
        seen = Observations(
            keypoints,
            weights,
            centres=np.zeros((*pairs, 2), np.float32),
            sizes=np.ones(pairs, np.float32),
            usable=np.ones(pairs, np.bool_),
        )
        answers = make_answers(frames, views, count)
        run_compiled(network, seen, 0.0, SETTLE_NONE, nothing_unusual(), 0, frames, answers)
        return answers.points3d

    return lift


def _module(model: Model) -> Straight:
    tensors = {name: torch.from_numpy(value) for name, value in model.weights.items()}
    return Straight(fold(tensors, len(model.sizes), torch.cat))


def _exported(model: Model) -> Any:
    keypoints, weights = map(torch.from_numpy, model.batch(2))
    frames = torch.export.Dim("frames", min=1, max=1 << 20)
    shapes = {"keypoints": {0: frames}, "weights": {0: frames}}
    return torch.export.export(_module(model), (keypoints, weights), dynamic_shapes=shapes)


def _in_torch(call: Callable[[Tensor, Tensor], Any]) -> Lifts:
    def lift(keypoints: Float32, weights: Float32) -> Float32:
        with torch.inference_mode():
            points: Float32 = call(torch.from_numpy(keypoints), torch.from_numpy(weights))[
                0
            ].numpy()
        return points

    return lift


MAKERS: dict[str, tuple[Callable[[Model], Lifts], tuple[str, ...]]] = {
    "torch, as trained": (as_trained, ("torch",)),
    "torch, straight": (straight, ("torch",)),
    "torch.compile": (compiled, ("torch",)),
    "AOTInductor": (ahead_of_time, ("torch",)),
    "ONNX Runtime": (onnx, ("onnxruntime",)),
    "NumPy": (in_numpy, ()),
    "Numba": (in_numba, ("numba", "llvmlite")),
}

if __name__ == "__main__":
    main()
