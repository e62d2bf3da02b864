"""The CAM_*.pkl of the MV-NRSfM authors: of each frame `W_GT` (P, 2), often `S_GT` (P, 3)."""

from typing import Any

import numpy as np

from fewview.errors import FormatError
from fewview.readers import pickles
from fewview.readers.sources import Source, check_size
from fewview.readers.views import View

MAX_PICKLE = 2**30  # bytes


def fits(source: Source) -> bool:
    """Whether this is a pickle that names `W_GT`."""
    return not source.frames and source.head[:1] in (b"\x80", b"(", b"]") and b"W_GT" in source.head


def read(source: Source) -> list[View]:
    """Return the view of a file, without running anything that is in it.

    Raises
    ------
    FormatError
        If it holds anything but arrays and plain containers, or does not fit together.
    """
    check_size(source.path, MAX_PICKLE)
    content: Any = pickles.load(source.path.read_bytes(), str(source))
    if isinstance(content, dict):
        content = [content[key] for key in sorted(content)]
    try:
        keypoints = np.stack([np.asarray(frame["W_GT"], np.float32) for frame in content])
        _, points, axes = keypoints.shape
        if axes != 2:
            raise ValueError(f"`W_GT` has the shape {keypoints.shape[1:]}")
        for frame, one in zip(content, keypoints, strict=True):
            # In some of the files, False means that the frame does not show the subject.
            shown = np.broadcast_to(np.asarray(frame.get("confidence", True), float) > 0, (points,))
            one[~shown] = np.nan
        truth = None
        if all("S_GT" in frame for frame in content):
            truth = np.stack([np.asarray(frame["S_GT"], np.float32) for frame in content])
            truth = truth if truth.shape == (len(content), points, 3) else None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(
            f"frames without a `W_GT` of one shape ({error})", place=source
        ) from error
    return [
        View(
            source.name,
            keypoints[:, None],
            np.arange(len(keypoints)),
            people=("",),
            points3d=truth,
        )
    ]
