"""What each view is worth, and where one more would help: expected errors with other cameras."""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig
from models.optics.lenses.projection import COEFFICIENTS, LENSES, Lenses
from models.posterior.frames import Frames, LearntShapes, covariances_of

Float64 = NDArray[np.float64]

MOST_SUBSETS = 64
AZIMUTHS, ELEVATIONS = tuple(range(0, 360, 30)), (0, 30, 60)  # degrees
PINHOLE = [lens.LIFTED_AS for lens in LENSES].index("perspective")


class Direction(NamedTuple):
    """Where a camera is, seen from the middle of the subject's paths; degrees."""

    azimuth_deg: float  # about the mean up axis of the cameras, 0 at the first, to its left
    elevation_deg: float


class Place(NamedTuple):
    """A place for one more camera, and the error to expect with it."""

    direction: Direction
    expected_error: float


class ViewsWorth(NamedTuple):
    """The expected error with some of the views."""

    views: tuple[int, ...]
    expected_error: float


def subsets_of(views: int) -> list[tuple[int, ...]]:
    """Return all choices of views, or if these are many the small ones and the large ones."""
    sizes = sorted(range(1, views + 1), key=lambda size: min(size, views + 1 - size))
    found: list[tuple[int, ...]] = []
    for size in sizes:
        some = list(combinations(range(views), size))
        if len(found) + len(some) > MOST_SUBSETS:
            break
        found += some
    return found


def expected_error(
    frames: Frames, shapes: LearntShapes, factor: Float64, corrections: Float64
) -> float:
    """Return the root-mean-square deviation of all points, units of the structure; NaN if unknown.

    `corrections` (K + 1,) are by how many views show a point.
    """
    showing = (frames.weights > 0).sum(1)
    corrected = frames._replace(corrections=corrections[showing])
    blocks = covariances_of(corrected, shapes, factor, modes=False).blocks
    variances = blocks.trace(axis1=2, axis2=3)
    known = np.isfinite(variances)
    return float(np.sqrt(variances[known].mean())) if known.any() else np.nan


def worth_of_views(
    frames: Frames, shapes: LearntShapes, factor: Float64, corrections: Float64
) -> list[ViewsWorth]:
    """Return the expected error of each choice of the views, the best first.

    Answers are those of all views, and cameras are known as well as all frames determine them.
    """
    found = []
    for chosen in subsets_of(frames.weights.shape[1]):
        shown = np.zeros(frames.weights.shape[1])
        shown[list(chosen)] = 1.0
        some = frames._replace(weights=frames.weights * shown[:, None])
        found.append(ViewsWorth(chosen, expected_error(some, shapes, factor, corrections)))
    return sorted(
        found, key=lambda worth: (np.nan_to_num(worth.expected_error, nan=np.inf), worth.views)
    )


def worth_of_places(
    frames: Frames,
    rig: Rig,
    shapes: LearntShapes,
    factor: Float64,
    corrections: Float64,
    noise: float,
) -> list[Place]:
    """Return the expected error with one more camera at places around the subject.

    It is a static pinhole whose pose is known, as far away and with as long a lens as the others
    are by the median, and sees all keypoints with `noise` (pixels). Only for frames all of whose
    cameras are of one static rig; else there are no places.
    """
    whole: NDArray[np.bool_] = np.all(frames.joined, axis=1)
    if not whole.any() or rig.group_count != 1:
        return []
    frames = _some(frames, whole)
    to_rig, moves = _in_rig(frames, rig)
    middles = moves / frames.growth[:, None]  # (N, 3) of the subject, units of the rig
    middle = np.median(middles, 0)
    cameras = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)  # (K, 3)
    distance = float(np.median(np.linalg.norm(cameras - middle, axis=1)))
    axes = _axes(rig, cameras[0] - middle)
    more = np.append(corrections, corrections[-1])
    wider = np.concatenate((factor, np.zeros((1, *factor.shape[1:]))))
    found = []
    for elevation in ELEVATIONS:
        for azimuth in AZIMUTHS:
            towards = _direction(axes, np.radians(azimuth), np.radians(elevation))
            rotation = _looking(-towards, axes[2])
            translation = -rotation @ (middle + distance * towards)
            seen = _with_camera(frames, to_rig, moves, rotation, translation, noise)
            error = expected_error(seen, shapes, wider, more)
            found.append(Place(Direction(float(azimuth), float(elevation)), error))
    return found


def directions_of(rig: Rig, frames: Frames) -> list[Direction]:
    """Return where the cameras of one static rig are."""
    _, moves = _in_rig(frames, rig)
    middle = np.median(moves / frames.growth[:, None], 0)
    cameras = -np.einsum("kji,kj->ki", rig.rotations, rig.translations) - middle
    ahead, left, up = (cameras @ axis for axis in _axes(rig, cameras[0]))
    azimuths = np.degrees(np.arctan2(left, ahead)) % 360
    elevations = np.degrees(np.arctan2(up, np.hypot(ahead, left)))
    return [Direction(*pair) for pair in zip(azimuths.tolist(), elevations.tolist(), strict=True)]


def _some(frames: Frames, chosen: NDArray[np.bool_]) -> Frames:
    return Frames._make(
        array if name == "lenses" else array[chosen] for name, array in frames._asdict().items()
    )


def _in_rig(frames: Frames, rig: Rig) -> tuple[Float64, Float64]:
    """Return rotations (N, 3, 3) and translations (N, 3) from structures to their rig.

    In units of the structure, by the first camera.
    """
    to_rig = rig.rotations[0].T @ frames.rotations[:, 0]
    offsets = frames.translations[:, 0] - frames.growth[:, None] * rig.translations[0]
    return to_rig, offsets @ rig.rotations[0]


def _axes(rig: Rig, first: Float64) -> tuple[Float64, Float64, Float64]:
    """Return ahead, left and up (3,) of the rig: up is that of the cameras, ahead the first's."""
    up = -rig.rotations[:, 1].sum(0)
    up /= np.linalg.norm(up)
    ahead = first - up * (first @ up)
    ahead /= np.linalg.norm(ahead)
    return ahead, np.cross(up, ahead), up


def _direction(axes: tuple[Float64, Float64, Float64], azimuth: float, elevation: float) -> Float64:
    ahead, left, up = axes
    level = np.cos(azimuth) * ahead + np.sin(azimuth) * left
    return np.asarray(np.cos(elevation) * level + np.sin(elevation) * up)


def _looking(forward: Float64, up: Float64) -> Float64:
    """Return the rotation (3, 3) of a camera that looks along `forward`, x right and y down."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(forward, right), forward))


def _with_camera(
    frames: Frames,
    to_rig: Float64,
    moves: Float64,
    rotation: Float64,
    translation: Float64,
    noise: float,
) -> Frames:
    """Return frames with one more camera, given its pose in the rig."""
    count, _, points = frames.weights.shape
    rotations = (rotation @ to_rig)[:, None]
    offsets = (frames.growth[:, None] * translation)[:, None]  # (N, 1, 3)
    translations = (moves @ rotation.T)[:, None] + offsets
    lenses = frames.lenses
    focal = np.full((1, 2), np.median(lenses.focals))
    added = Lenses(
        np.concatenate((lenses.focals, focal)),
        np.concatenate((lenses.centres, np.zeros((1, 2)))),
        np.concatenate((lenses.distortion, np.zeros((1, COEFFICIENTS)))),
        np.append(lenses.models, np.int8(PINHOLE)).astype(np.int8),
    )

    def joined(old: Float64, new: Float64) -> Float64:
        return np.ascontiguousarray(np.concatenate((old, new), 1))

    ahead = (frames.points @ rotations[:, 0].mT + translations)[..., 2] > 0
    weights = np.where(ahead, noise**-2.0, 0.0)[:, None]
    return frames._replace(
        rotations=joined(frames.rotations, rotations),
        translations=joined(frames.translations, translations),
        lenses=added,
        joined=np.ones((count, frames.joined.shape[1] + 1), np.bool_),
        offsets=joined(frames.offsets, offsets),
        keypoints=joined(frames.keypoints, np.zeros((count, 1, points, 2))),
        weights=joined(frames.weights, weights),
    )
