"""Captures with a truth, made worse in several ways, with cameras that are given or found."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import fields_beside, read_capture
from benchmarks.drawn_captures import HEIGHT, radius
from benchmarks.motions import EXAMPLE
from benchmarks.rig import add_noise, find_lenses, hide
from models.settings.config import FitConfig

Float64 = NDArray[np.float64]

CAPTURES = ("human36m", "cmu_mocap_virtual6", "dannce_mouse1", "three_actors")
SIZES = {"human36m": (1000, 1000)}  # of images, where neither file nor JSON has them
MOST_FRAMES = 200  # of a capture, evenly
# Noise as a share of the subject's height in the image, and what else is done.
TAILS, GAPS = "tails", "gaps"
SPOILT: dict[str, tuple[float, str]] = {
    "clean": (0.0, ""),
    "0.5 %": (0.005, ""),
    "2 %": (0.02, ""),
    "5 %": (0.05, ""),
    TAILS: (0.02, TAILS),  # Student's t of 4 degrees of freedom
    GAPS: (0.02, GAPS),
}
FREEDOM = 4
HIDDEN = 0.3  # of the keypoints where there are gaps


class Cell(NamedTuple):
    """A capture, how it is spoilt, and whether its cameras are given."""

    name: str
    spoilt: str
    given: bool

    @property
    def words(self) -> str:
        """What was done with the capture."""
        return f"{self.spoilt}, cameras {'given' if self.given else 'found'}"


class Loaded(NamedTuple):
    """What a cell fits, and what is true."""

    keypoints: Float64  # (N, K, P, 2)
    truth: Float64  # (N, P, 3)
    sizes: list[tuple[int, int]] | None
    config: FitConfig


def cells() -> list[Cell]:
    """Return all cells."""
    return [
        Cell(name, spoilt, given)
        for spoilt in SPOILT
        for given in (False, True)
        for name in CAPTURES
    ]


def load(cell: Cell, data: Path | None) -> Loaded | None:
    """Read and spoil a capture of the folder `data`; None if it is not there.

    Given cameras are those that the truth's reprojections give before anything is spoilt, as a
    calibration would be.
    """
    path = EXAMPLE if cell.name == EXAMPLE.stem else (data or Path()) / f"{cell.name}.npz"
    if not path.exists():
        return None
    capture = read_capture(path)
    truth = np.asarray(capture.points3d, np.float64)
    exact = capture.keypoints.astype(np.float64)
    config = FitConfig()
    if cell.given:
        cameras = find_lenses(exact, truth)
        if cameras is None:
            raise ValueError(f"{cell.name}: not all cameras are static")
        config = FitConfig.model_validate({"calibration": cameras.calibration})
    count = min(len(exact), MOST_FRAMES)
    some = np.linspace(0, len(exact) - 1, count).astype(int)
    views = exact.shape[1]
    sizes = capture.image_sizes
    if sizes is None:
        sizes = fields_beside(path).get("image_sizes", [SIZES.get(cell.name)] * views)
    return Loaded(
        spoil(exact[some], cell.spoilt),
        truth[some],
        None if sizes[0] is None else [(int(width), int(height)) for width, height in sizes],
        config,
    )


def spoil(keypoints: Float64, how: str) -> Float64:
    """Return keypoints (N, K, P, 2) as one of `SPOILT` has them."""
    share, more = SPOILT[how]
    heights = [HEIGHT * radius(keypoints[:, k]) for k in range(keypoints.shape[1])]
    sigma = share * float(np.median(heights))
    if more == TAILS:
        unit = np.random.default_rng(FREEDOM).standard_t(FREEDOM, keypoints.shape) / np.sqrt(2)
        return np.asarray(keypoints + sigma * unit)
    noisy = add_noise(keypoints, sigma, 0)
    return hide(noisy, HIDDEN, 0) if more == GAPS else noisy
