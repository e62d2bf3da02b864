"""How far structures are from a ground truth: the measures of the field, per frame and keypoint."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEAST_KEYPOINTS = 3  # that a frame must share with the truth
THRESHOLDS = 41  # of the curve, from 0 to `reach`


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors in the unit of the truth; NaN where nothing is known.

    Attributes
    ----------
    pa_mpjpe
        Mean error after every frame was aligned alone: centred, scaled to the truth's size and
        rotated (Dabhi et al., 3DV 2021, "Evaluation metrics").
    mpjpe
        Mean error after one similarity, by least squares (Umeyama, 1991), aligned all frames
        together, so it includes the motion of a walking subject. NaN if frames share no room.
    pck, thresholds
        (T,) share of keypoints, each frame aligned alone, that lie within each of the (T,)
        thresholds.
    auc
        Area under that curve, as a share of the whole.
    per_keypoint, per_frame
        (P,) and (N,): `pa_mpjpe` of each.
    frames
        How many frames were compared.
    mirrored
        Whether all structures were mirrored, which is only tried when asked for.
    """

    pa_mpjpe: float
    mpjpe: float
    pck: Float64
    thresholds: Float64
    auc: float
    per_keypoint: Float64
    per_frame: Float64
    frames: int
    mirrored: bool

    def plain(self) -> dict[str, Any]:
        """Return the figures as they go into JSON: lists, and None for what is not known."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def evaluate(
    points: ArrayLike, truth: ArrayLike, *, reach: float | None = None, mirrored_too: bool = False
) -> Evaluation:
    """Compare structures with a ground truth.

    Parameters
    ----------
    points, truth
        (N, P, 3); NaN keypoints of either do not count.
    reach
        Largest threshold of the curve, in the unit of the truth; None: a third of the truth's
        usual radius, which is about 150 mm of a person.
    mirrored_too
        Allow a mirror image: mirror all structures if they are then nearer to the truth. A single
        frame of the other handedness is never allowed.

    Raises
    ------
    ValueError
        If the shapes differ, or no frame has three keypoints that are known in both.
    """
    x, y = (np.asarray(array, np.float64) for array in (points, truth))
    if x.shape != y.shape or x.ndim != 3 or x.shape[2] != 3:
        raise ValueError(
            "points and truth must have one shape (frames, keypoints, 3), got "
            f"{x.shape} and {y.shape}"
        )
    known: Bool = np.all(np.isfinite(x + y), axis=-1)
    known[known.sum(1) < LEAST_KEYPOINTS] = False
    if not known.any():
        raise ValueError("no frame has three keypoints that both the points and the truth know")
    found = [_measure(x * sign, y, known) for sign in ((1, -1) if mirrored_too else (1,))]
    best = int(np.argmin([_mean(errors, known) for errors, _ in found]))
    errors, together = found[best]
    thresholds = np.linspace(0, _radius(y, known) / 3 if reach is None else reach, THRESHOLDS)
    pck = (errors[known] <= thresholds[:, None]).mean(1)
    return Evaluation(
        pa_mpjpe=_mean(errors, known),
        mpjpe=_mean(together, known),
        pck=pck,
        thresholds=thresholds,
        auc=float(np.trapezoid(pck) / (THRESHOLDS - 1)),
        per_keypoint=_means(errors, known, 0),
        per_frame=_means(errors, known, 1),
        frames=int(known.any(1).sum()),
        mirrored=bool(best),
    )


def _measure(x: Float64, y: Float64, known: Bool) -> tuple[Float64, Float64]:
    """Return errors (N, P) with each frame aligned alone, and with all aligned together."""
    alone = _aligned(x, y, known, by_size=True)
    one = (1, -1, 3)
    together = _aligned(x.reshape(one), y.reshape(one), known.reshape(1, -1), by_size=False)
    both = (np.linalg.norm(moved.reshape(y.shape) - y, axis=-1) for moved in (alone, together))
    first, second = (np.where(known, errors, np.nan) for errors in both)
    return first, second


def _aligned(x: Float64, y: Float64, known: Bool, *, by_size: bool) -> Float64:
    """Align each frame of x (N, P, 3) to y (N, P, 3) by a similarity without reflection."""
    seen = known[..., None]
    count = np.maximum(seen.sum(1, keepdims=True), 1)
    mean_x, mean_y = (np.where(seen, z, 0).sum(1, keepdims=True) / count for z in (x, y))
    x, y = np.where(seen, x - mean_x, 0), np.where(seen, y - mean_y, 0)
    u, stretches, vt = np.linalg.svd(y.mT @ x)
    signs = np.ones_like(stretches)
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    power = np.square(x).sum((1, 2))
    size = np.sqrt(np.square(y).sum((1, 2)) * power) if by_size else (stretches * signs).sum(1)
    scale = np.divide(size, power, out=np.ones_like(power), where=power > 0)
    turned = x @ (u * signs[:, None] @ vt).mT
    return np.asarray(scale[:, None, None] * turned + mean_y, np.float64)


def _mean(errors: Float64, known: Bool) -> float:
    """Return the mean over frames of each frame's mean."""
    per_frame = _means(errors, known, 1)
    return float(per_frame[np.isfinite(per_frame)].mean())


def _means(errors: Float64, known: Bool, axis: int) -> Float64:
    counts = known.sum(axis)
    sums = np.where(known, errors, 0).sum(axis)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _radius(y: Float64, known: Bool) -> float:
    """Return the median over frames of the root-mean-square distance from a frame's middle."""
    radii = [
        np.sqrt(np.square(y[n, known[n]] - y[n, known[n]].mean(0)).sum(-1).mean())
        for n in np.flatnonzero(known.any(1))
    ]
    return float(np.median(radii))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(float(item)) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
