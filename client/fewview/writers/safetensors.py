"""safetensors: `points` (N, P, 3) float64, NaN where missing, and what else is known.

That is `points_sd` (N, P), `times` (N,), `edges` (E, 2), `frame_numbers` (N,). What are no arrays
is in the metadata, as JSON where it is no text: `unit`, `fps`, `keypoint_names`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation
from fewview.api.arrays import to_safetensors


def write(path: Path, animation: Animation) -> None:
    """Write an animation as arrays."""
    arrays: dict[str, NDArray[Any]] = {"points": animation.points}
    if animation.points_sd is not None:
        arrays["points_sd"] = animation.points_sd
    if animation.times is not None:
        arrays["times"] = animation.times
    if animation.numbers is not None:
        arrays["frame_numbers"] = animation.numbers
    if animation.edges:
        arrays["edges"] = np.array(animation.edges)
    about = {} if animation.unit is None else {"unit": str(animation.unit)}
    if animation.fps is not None:
        about["fps"] = json.dumps(float(animation.fps))
    if animation.keypoint_names is not None:
        about["keypoint_names"] = json.dumps(animation.keypoint_names)
    path.write_bytes(to_safetensors(arrays, about))
