"""npz: `points` (N, P, 3), NaN where missing, and what else is known under its own name.

`points_sd` (N, P), `unit`, `fps`, `times` (N,), `keypoint_names` (P,), `edges` (E, 2),
`frame_numbers` (N,); no pickled objects.
"""

from pathlib import Path
from typing import Any

import numpy as np

from fewview.animation import Animation


def write(path: Path, animation: Animation) -> None:
    """Write an animation as arrays."""
    known: dict[str, Any] = {
        "points": animation.points,
        "points_sd": animation.points_sd,
        "unit": animation.unit,
        "fps": animation.fps,
        "times": animation.times,
        "keypoint_names": animation.keypoint_names,
        "edges": animation.edges or None,
        "frame_numbers": animation.numbers,
    }
    arrays: dict[str, Any] = {
        name: np.asarray(value) for name, value in known.items() if value is not None
    }
    with path.open("wb") as file:  # a name without .npz stays as it is
        np.savez_compressed(file, **arrays)
