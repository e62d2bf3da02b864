"""Errors of structures against a ground truth, without what weak perspective cannot determine."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.numerics.rotations import nearest_rotations

Float64 = NDArray[np.float64]
Reflection = Literal["either", "never"]


class Accuracy(NamedTuple):
    """Distances after alignment."""

    errors: Float64  # (N, P) distance per keypoint, in the unit of the truth; NaN where unknown
    per_frame: Float64  # (N,) mean over the known keypoints, NaN where nothing is known
    mean: float  # over frames
    reflected: bool  # whether all the structures were mirrored


def procrustes_by_size(points: ArrayLike, truth: ArrayLike) -> Float64:
    """Align structures (N, P, 3) with the truth (N, P, 3), each frame alone, never reflected.

    As the paper words it: both are centred, the structure is scaled to the truth's size (root sum
    of squares), then rotated as near to it as a rotation can bring it (Kabsch, 1978). Least squares
    would take another scale: smaller by the mean cosine, with an error that is never larger.

    Keypoints with a NaN in either array are not used to align; where the structure has them, they
    are moved with the others. A frame that shares fewer than 3 keypoints comes out as NaN.

    Raises
    ------
    ValueError
        When the shapes differ or are not (N, P, 3).
    """
    x, y, known = _paired(points, truth)
    weight = known[..., None].astype(np.float64)
    count = np.maximum(weight.sum(1, keepdims=True), 1)
    seen_x, seen_y = np.where(known[..., None], x, 0), np.where(known[..., None], y, 0)
    mean_x, mean_y = (seen_x.sum(1, keepdims=True) / count, seen_y.sum(1, keepdims=True) / count)
    centred_x, centred_y = (seen_x - mean_x) * weight, (seen_y - mean_y) * weight
    size_x = np.sqrt(np.square(centred_x).sum((1, 2), keepdims=True))
    size_y = np.sqrt(np.square(centred_y).sum((1, 2), keepdims=True))

    rotations = nearest_rotations(centred_y.mT @ centred_x)  # (N, 3, 3)
    scales = size_y / np.where(size_x > 0, size_x, 1)  # (N, 1, 1)
    moved: Float64 = scales * (x - mean_x) @ rotations.mT + mean_y
    moved[known.sum(1) < 3] = np.nan
    return moved


def pa_mpjpe(points: ArrayLike, truth: ArrayLike, *, reflection: Reflection = "either") -> Accuracy:
    """Procrustes-aligned mean per-joint position error (paper, "Evaluation metrics").

    Weak perspective sees a structure and its mirror image alike. With `reflection="either"`, the
    default, all frames together are mirrored if that lowers the mean. This decides the handedness
    once for a whole fit, and is a convention, not a measurement. A single frame of the wrong
    handedness is never forgiven. `reflection="never"` takes the structures as they are.

    Parameters
    ----------
    points, truth
        (N, P, 3); NaN keypoints in either do not count.
    """
    results = [
        _errors(np.asarray(points, np.float64) * sign, truth)
        for sign in ((1, -1) if reflection == "either" else (1,))
    ]
    means = [_mean(per_frame) for _, per_frame in results]
    best = int(len(means) == 2 and means[1] < means[0])
    errors, per_frame = results[best]
    return Accuracy(errors, per_frame, means[best], reflected=bool(best))


def pck(accuracy: Accuracy, threshold: float) -> float:
    """Share of the known keypoints in [0, 1] that lie closer to the truth than `threshold`."""
    known = np.isfinite(accuracy.errors)
    return float((accuracy.errors[known] < threshold).mean()) if known.any() else float("nan")


def _errors(points: Float64, truth: ArrayLike) -> tuple[Float64, Float64]:
    errors = np.linalg.norm(
        procrustes_by_size(points, truth) - np.asarray(truth, np.float64), axis=-1
    )
    known = np.isfinite(errors)
    count = known.sum(1)
    total = np.where(known, errors, 0).sum(1)
    return errors, np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _mean(per_frame: Float64) -> float:
    known = per_frame[np.isfinite(per_frame)]
    return float(known.mean()) if known.size else float("nan")


def _paired(points: ArrayLike, truth: ArrayLike) -> tuple[Float64, Float64, NDArray[np.bool_]]:
    x, y = np.asarray(points, np.float64), np.asarray(truth, np.float64)
    if x.shape != y.shape or x.ndim != 3 or x.shape[-1] != 3:
        raise ValueError(
            f"points and truth must have one shape (frames, keypoints, 3),"
            f" got {x.shape} and {y.shape}"
        )
    known: NDArray[np.bool_] = np.all(np.isfinite(x + y), axis=-1)
    return x, y, known
