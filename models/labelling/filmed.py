"""The answer of a fit, in the frames of each view's own film.

A reconstruction has the moments of the first view. A view that is late, or has times of its own,
shows a moment in another frame of its film, and a label belongs to the image of that film.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.calibrating.result import CameraReport
from models.causes.cause import Cause, unmended
from models.lifting.lift import CAMERA_MODELS
from models.network.answers import UNLIKE_FIT
from models.optics.lenses.projection import Lenses, project

Array = NDArray[Any]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


class Filmed(NamedTuple):
    """N frames of K views of P keypoints. Where nothing else is stated, frames are the views' own.

    A moment is a frame of the reconstruction.
    """

    keypoints: Float64  # (N, K, P, 2) pixels, NaN where not observed
    confidence: Float64  # (N, K, P) in [0, 1] of the detector, 1 where it gave none
    reprojections: Float64  # (N, K, P, 2) pixels, NaN without a camera or a point
    outlier_probability: Float64  # (N, K, P), NaN where not judged
    moments: Float64  # (N, K) which moment a frame shows, in fractions; NaN if none
    frames: Float64  # (N, K) which frame shows a moment, in fractions; NaN if none
    structures: Float64  # (N, P, 3) of the moments
    unlike: Bool  # (N,) moments with the finding `frame_unlike_fit`

    def at_moments(self, values: Array) -> Array:
        """Return values (N, K, ...) of the views' frames by the moments that these show."""
        return _gathered(values, self.frames)

    def of_moments(self, values: Array) -> Array:
        """Return values (N, K, ...) of moments by the frames that show them."""
        return _gathered(values, self.moments)


def as_filmed(
    keypoints: Array,
    confidence: Array | None,
    found: Mapping[str, Array],
    frames: Float64 | None = None,
    cameras: CameraReport | None = None,
    placed: Array | None = None,
    mends: tuple[Cause, ...] = (),
) -> Filmed:
    """Return what a fit found, beside what was detected.

    Parameters
    ----------
    keypoints, confidence
        (N, K, P, 2) and (N, K, P) as they were detected.
    found
        The arrays of the reconstruction, by their names.
    frames
        (N, K) which frame of each view shows a moment, in fractions
        (`models.capture.clocks.positions_in_step`); None: all views are in step.
    cameras, placed
        The cameras of the fit, and the structures (N, P, 3) in their room: they show where a static
        view sees what it did not detect at all.
    mends
        What the fit undid in the views' pixels: reprojections are in the pixels as they came.
    """
    count, views = keypoints.shape[:2]
    own = np.repeat(np.arange(count, dtype=np.float64)[:, None], views, axis=1)
    frames = own if frames is None else frames
    moments = np.stack([_inverted(frames[:, view]) for view in range(views)], axis=1)
    seen: Bool = np.asarray(np.isfinite(keypoints).all(-1))
    if confidence is not None:
        seen &= confidence > 0
    judged = found.get("outlier_probability")
    odd = found.get("findings", np.zeros(count, np.uint8))
    projected = unmended(reprojections(found, cameras, placed), mends)
    filmed = Filmed(
        keypoints=np.where(seen[..., None], keypoints, np.nan).astype(np.float64),
        confidence=np.ones(seen.shape) if confidence is None else confidence.astype(np.float64),
        reprojections=projected,
        outlier_probability=np.full(seen.shape, np.nan),
        moments=moments,
        frames=frames,
        structures=np.asarray(found["points3d"], np.float64),
        unlike=np.asarray((odd & UNLIKE_FIT) > 0),
    )
    if judged is not None:
        filmed = filmed._replace(outlier_probability=filmed.of_moments(judged.astype(np.float64)))
    if np.array_equal(moments, own):
        return filmed
    return filmed._replace(reprojections=_between(projected, moments))


def _inverted(frames: Float64) -> Float64:
    """Return which moment each frame of a view shows, from which frame shows each moment."""
    known = np.flatnonzero(np.isfinite(frames))
    every = np.arange(len(frames), dtype=np.float64)
    if not len(known):
        return np.full(len(frames), np.nan)
    return np.interp(every, frames[known], known.astype(np.float64), left=np.nan, right=np.nan)


def _gathered(values: Array, places: Float64) -> Array:
    """Return the values (N, K, ...) at the nearest of places (N, K); NaN, False or 0 at none."""
    known = np.isfinite(places)
    nearest = np.where(known, np.rint(places), 0).astype(np.int64)
    taken = values[nearest, np.arange(values.shape[1])]
    nothing = np.array(np.nan if values.dtype.kind == "f" else 0, values.dtype)
    return np.where(known.reshape(*known.shape, *[1] * (values.ndim - 2)), taken, nothing)


def _between(values: Float64, places: Float64) -> Float64:
    """Return values (N, K, P, 2) at places (N, K) in fractions, along the line between frames."""
    low = np.floor(places)
    share = (places - low)[..., None, None]
    first, last = _gathered(values, low), _gathered(values, np.ceil(places))
    return np.where(share > 0, first + share * (last - first), first)


def reprojections(
    found: Mapping[str, Array], cameras: CameraReport | None = None, placed: Array | None = None
) -> Float64:
    """Return where each camera shows the structures (N, K, P, 2), by moments; see `as_filmed`."""
    models = np.array(found["camera_models"])
    turns, shifts = (found[name].astype(np.float64) for name in ("rotations", "translations"))
    points = np.asarray(found["points3d"], np.float64)
    seen = np.einsum("nkij,npj->nkpi", turns, points)
    lenses = [
        found[name].astype(np.float64) for name in ("focals", "principal_points", "distortions")
    ]
    weak = found["scales"].astype(np.float64)[..., None, None] * seen[..., :2]
    weak += shifts[:, :, None, :2]
    seen += np.where(models > 0, 1.0, np.nan)[..., None, None] * shifts[:, :, None]
    if cameras is not None and placed is not None:
        room = (cameras.focals, cameras.principal_points, cameras.distortions)
        for view in np.flatnonzero(cameras.static):
            kind = CAMERA_MODELS.index(cameras.camera_models[view])
            blind = np.flatnonzero((models[:, view] < 0) & (kind > 0))
            seen[blind, view] = placed[blind] @ cameras.rotations[view].T
            seen[blind, view] += cameras.translations[view]
            models[blind, view] = kind
            for lens, known in zip(lenses, room, strict=True):
                lens[blind, view] = known[view]
    deep = models > 0
    shape = (1, seen.shape[0] * seen.shape[1])
    focals, centres, distortions = (
        np.nan_to_num(lens).reshape(-1, lens.shape[-1]) for lens in lenses
    )
    kinds = np.maximum(models - 1, 0).astype(np.int8).ravel()
    each = Lenses(focals, centres, distortions, kinds)
    pixels = project(np.nan_to_num(seen).reshape(*shape, *seen.shape[2:]), each)
    before = deep[..., None] & (seen[..., 2] > 0)
    shown = np.where(before[..., None], pixels.reshape(weak.shape), np.nan)
    return np.where((models == 0)[..., None, None], weak, shown)
