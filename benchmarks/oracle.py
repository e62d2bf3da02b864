"""Another program's answers, as a yardstick."""

import importlib.util
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.drawn_captures import Draw

Float64 = NDArray[np.float64]


def by_oracle(draw: Draw, file: Path) -> Float64:
    """Return points (N, P, 3) of a module with `find` and `structure`; NaN where it finds none."""
    spec = importlib.util.spec_from_file_location("oracle", file)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{file} is no module")
    spec.loader.exec_module(module := importlib.util.module_from_spec(spec))
    weights = np.isfinite(draw.keypoints).all(-1).astype(float)
    if (found := module.find(draw.keypoints, weights, draw.sizes)) is None:
        return np.full(draw.points3d.shape, np.nan)
    return np.asarray(module.structure(draw.keypoints, weights, found["cams"], found["sig"]))
