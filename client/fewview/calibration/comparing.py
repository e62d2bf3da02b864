"""How far cameras are from a calibration, once both rigs are brought together by a similarity."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fewview.calibration.camera import Camera, Float64, rotation_vector


@dataclass(frozen=True)
class CameraError:
    """How far one camera is from that of the calibration; None where a pose is unknown.

    Attributes
    ----------
    name
        Of the camera in the calibration.
    rotation
        Degrees between the two directions of view, axes and all.
    centre
        Distance of the two centres, in the unit of the calibration.
    direction
        Degrees between the two directions from the middle of all cameras to this one.
    focal
        Per cent that the focal lengths along x and y are too long.
    principal_point
        Distance in pixels.
    """

    name: str
    rotation: float | None
    centre: float | None
    direction: float | None
    focal: tuple[float, float]
    principal_point: float

    def plain(self) -> dict[str, Any]:
        """Return it as it goes into JSON."""
        return asdict(self)


def compare_cameras(found: Sequence[Camera], calibration: Sequence[Camera]) -> list[CameraError]:
    """Compare cameras with those of a calibration, one by one.

    Of both rigs, the cameras whose poses are known are brought together by the similarity that
    suits their orientations best (the rotation nearest to all, in the sense of Frobenius), then
    their centres (scale and place, least squares). One such camera alone has no error of its pose.

    Raises
    ------
    ValueError
        If there are more of the one than of the other.
    """
    if len(found) != len(calibration):
        raise ValueError(f"expected {len(calibration)} cameras as calibrated, got {len(found)}")
    pairs = list(zip(found, calibration, strict=True))
    posed = [k for k, pair in enumerate(pairs) if all(c.rotation is not None for c in pair)]
    poses: dict[int, tuple[float, float, float]] = {}
    if len(posed) > 1:
        poses = dict(zip(posed, _pose_errors([pairs[k] for k in posed]), strict=True))
    errors = []
    for k, (mine, true) in enumerate(pairs):
        rotation, centre, direction = poses.get(k, (None, None, None))
        focals, expected = np.diag(mine.matrix)[:2], np.diag(true.matrix)[:2]
        longer = 100 * (focals / expected - 1)
        off = float(np.linalg.norm(mine.matrix[:2, 2] - true.matrix[:2, 2]))
        focal = (float(longer[0]), float(longer[1]))
        errors.append(CameraError(true.name, rotation, centre, direction, focal, off))
    return errors


def _pose_errors(pairs: Sequence[tuple[Camera, Camera]]) -> list[tuple[float, float, float]]:
    """Return degrees, distance and degrees of each pair, as :class:`CameraError` names them."""
    mine, true = (np.stack([_rotation(pair[i]) for pair in pairs]) for i in (0, 1))
    at, place = (np.stack([_centre(pair[i]) for pair in pairs]) for i in (0, 1))
    u, _, vt = np.linalg.svd((true.mT @ mine).sum(0))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt  # estimated room to true one
    ways, expected = (at - at.mean(0)) @ turn.T, place - place.mean(0)
    power = float(np.square(ways).sum())
    scale = max(0.0, float((ways * expected).sum()) / power) if power > 0 else 0.0
    return [
        (
            float(np.degrees(np.linalg.norm(rotation_vector(mine[k] @ (true[k] @ turn).T)))),
            float(np.linalg.norm(scale * ways[k] - expected[k])),
            _angle(ways[k], expected[k]),
        )
        for k in range(len(pairs))
    ]


def _rotation(camera: Camera) -> Float64:
    assert camera.rotation is not None  # noqa: S101 (only such are compared)
    return camera.rotation


def _centre(camera: Camera) -> Float64:
    assert camera.translation is not None  # noqa: S101
    return np.asarray(-_rotation(camera).T @ camera.translation, np.float64)


def _angle(first: Float64, second: Float64) -> float:
    """Return degrees between two directions, exact for small angles, too."""
    across = float(np.linalg.norm(np.cross(first, second)))
    return float(np.degrees(np.arctan2(across, float(first @ second))))
