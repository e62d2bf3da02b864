"""What is written to files of labels: keypoints of images, with weights."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

FOLDER = "labeled-data"  # of images, as DeepLabCut has them
FEWEST_DIGITS = 4  # of frame numbers in the names of images
_UNUSUAL = re.compile(r"[^\w.-]+")
_SCORER = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")


@dataclass(frozen=True)
class ViewLabels:
    """M labelled images of a view.

    Attributes
    ----------
    name
        The view's.
    frames
        (M,) numbers of the frames in the view's film, rising.
    keypoints
        (M, P, 2) pixels, NaN where there is no label.
    weights
        (M, P) in [0, 1], 0 where there is no label.
    detected
        (M, P) whether the view itself showed the keypoint to the detector.
    size
        (width, height) of the images, None if unknown.
    """

    name: str
    frames: Int64
    keypoints: Float64
    weights: Float64
    detected: Bool
    size: tuple[int, int] | None = None

    @property
    def labelled(self) -> Bool:
        """Which keypoints (M, P) have a label."""
        return np.asarray(np.isfinite(self.keypoints).all(-1))


@dataclass(frozen=True)
class Labels:
    """Labelled images of all views of a film.

    Attributes
    ----------
    views
        The labels of each view.
    keypoint_names
        P different names.
    edges
        (first, second) keypoints that are joined, counted from 0.
    scorer
        Who labelled, as projects of DeepLabCut name it.
    length
        Frames of the film: frame numbers in names of images have as many digits as it needs.

    Raises
    ------
    ValueError
        If these do not fit together.
    """

    views: tuple[ViewLabels, ...]
    keypoint_names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...] = ()
    scorer: str = "fewview"
    length: int = 0

    def __post_init__(self) -> None:
        """Check what is there."""
        if not _SCORER.fullmatch(self.scorer):
            raise ValueError(
                f"scorer must be letters, digits, - and _, 40 at most, not {self.scorer!r}"
            )
        count = len(self.keypoint_names)
        for view in self.views:
            shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
                "keypoints": (view.keypoints, (len(view.frames), count, 2)),
                "weights": (view.weights, (len(view.frames), count)),
                "detected": (view.detected, (len(view.frames), count)),
            }
            for name, (array, shape) in shapes.items():
                if array.shape != shape:
                    raise ValueError(f"{name} of {view.name} must be {shape}, not {array.shape}")

    @cached_property
    def folders(self) -> tuple[str, ...]:
        """What the folder of each view is called: its name, as file systems take it."""
        names: list[str] = []
        for view in self.views:
            name = _UNUSUAL.sub("_", view.name).strip("._") or "view"
            taken = [other for other in names if other == name or other.startswith(f"{name}-")]
            names.append(f"{name}-{len(taken) + 1}" if name in names else name)
        return tuple(names)

    def image(self, folder: str, frame: int) -> tuple[str, str, str]:
        """Return the parts of the path of an image: `labeled-data`, `cam1`, `img0123.png`."""
        digits = max(FEWEST_DIGITS, len(str(max(self.length - 1, 0))))
        return FOLDER, folder, f"img{frame:0{digits}}.png"
