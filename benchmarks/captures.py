"""Captures of any size and the models fitted to them, for benchmarks of speed."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import console
from models.capture.synthetic import FOCAL_LENGTH, IMAGE_SIZE, synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import fit

sys.path.append(str(Path(__file__).parents[1] / "examples"))  # where `capture` lies
from capture import Capture, CaptureError, read_capture

__all__ = [
    "Capture",
    "CaptureError",
    "Float32",
    "add_options",
    "fields_beside",
    "fitted",
    "from_options",
    "model_from_options",
    "read_capture",
    "studio",
]

Float32 = NDArray[np.float32]
FRAMES = 600
NOISE = 1.0  # pixels


def studio(views: int = 4, keypoints: int = 17, *, frames: int = FRAMES, seed: int = 0) -> Capture:
    """Make a capture of a figure that walks about before static cameras in a ring.

    Further keypoints are means of some of the figure's own.
    """
    rng = np.random.default_rng(seed)
    points = synthetic_capture(frames=frames, views=1, seed=seed).points3d.astype(np.float64)
    extra = max(0, keypoints - points.shape[1])
    shares = rng.dirichlet(np.full(points.shape[1], 0.3), extra)  # (extra, P)
    points = np.concatenate((points, np.einsum("ep,npc->nec", shares, points)), 1)[:, :keypoints]
    points += rng.uniform(-0.4, 0.4, (frames, 1, 3)) * [1, 0.2, 1]
    pixels = []
    for view in range(views):
        # Of the figure's axes (y up) the camera's y is down and its z looks at the figure.
        turn, tilt = 2 * np.pi * view / views + 0.3, np.radians(8 + 6 * (view % 3))
        forward = -np.array(
            [np.cos(tilt) * np.sin(turn), np.sin(tilt), np.cos(tilt) * np.cos(turn)]
        )
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        camera = points @ np.stack((right, np.cross(forward, right), forward)).T
        camera += [0, 0.1, 4 + 0.2 * (view % 4)]
        pixels.append(FOCAL_LENGTH * camera[..., :2] / camera[..., 2:] + np.array(IMAGE_SIZE) / 2)
    seen = np.stack(pixels, axis=1)
    seen += NOISE * rng.standard_normal(seen.shape)
    sizes = np.array([IMAGE_SIZE] * views)
    return Capture(seen.astype(np.float32), points3d=points.astype(np.float32), image_sizes=sizes)


def fields_beside(path: Path) -> dict[str, Any]:
    """Return the fields of CAPTURE.json beside CAPTURE.npz, such as `image_sizes` and `edges`."""
    beside = path.with_suffix(".json")
    fields: dict[str, Any] = json.loads(beside.read_text()) if beside.exists() else {}
    return fields


def fitted(capture: Capture, config: FitConfig | None = None) -> FittedPrior:
    """Fit with a configuration, the default one if there is none; the truth takes no part."""
    sizes = None
    if capture.image_sizes is not None:
        sizes = [(int(width), int(height)) for width, height in capture.image_sizes]
    return fit(
        capture.keypoints,
        config or FitConfig(),
        confidence=capture.confidence,
        image_sizes=sizes,
        edges=capture.edges,
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the capture and the model."""
    parser.add_argument("--capture", type=Path, help=".npz; default: a synthetic one")
    parser.add_argument("--views", type=int, default=4, help="if synthetic: %(default)s")
    parser.add_argument("--keypoints", type=int, default=17, help="if synthetic: %(default)s")
    parser.add_argument("--image-size", help="WxH of every view, if the file has no sizes")
    parser.add_argument("--model", type=Path, help="its weights; fitted and kept there if missing")
    parser.add_argument("--steps", type=int, help="of the fit; default: those of the configuration")


def from_options(arguments: argparse.Namespace) -> Capture:
    """Return the capture that the options name."""
    if arguments.capture is None:
        return studio(arguments.views, arguments.keypoints)
    try:
        capture = read_capture(arguments.capture)
    except CaptureError as error:
        sys.exit(f"{arguments.capture.name}: {error}")
    if capture.image_sizes is None and arguments.image_size is not None:
        size = tuple(map(int, arguments.image_size.split("x")))
        sizes = np.array([size] * capture.keypoints.shape[1])
        return Capture(capture.keypoints, capture.confidence, capture.points3d, image_sizes=sizes)
    return capture


def model_from_options(arguments: argparse.Namespace, capture: Capture) -> FittedPrior:
    """Read the model that the options name, or fit one to the capture."""
    if arguments.model is not None and arguments.model.exists():
        return FittedPrior.from_bytes(arguments.model.read_bytes())
    console.print("Fitting a model: --model FILE keeps it for the next run.")
    config = FitConfig() if arguments.steps is None else FitConfig(steps=arguments.steps)
    prior = fitted(capture, config)
    if arguments.model is not None:
        arguments.model.write_bytes(prior.to_bytes())
    return prior
