"""The convention of given poses: direction, axes and order of the cameras, found from keypoints.

Calibrations may have poses from camera to room instead of from room to camera, the axes of graphics
(y up, z backwards), or cameras in another order than the views. Each of these conventions predicts
the epipolar lines of every two views. So keypoints decide among them without any structure, before
anything is learnt with wrong poses.
"""

import math
from collections.abc import Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig
from models.calibrating.problem import Pose, poses_of, with_given_lenses
from models.epipolar.fundamental import sampson_distances
from models.epipolar.view_pairs import seen_keypoints
from models.findings.finding import Finding
from models.optics.lenses.projection import Lenses, project
from models.settings.calibration import Camera

Float64 = NDArray[np.float64]
Calibration = Sequence[Camera | None]

FITTING = 0.05  # of a view's radius: if distances from epipolar lines are less, poses fit
BETTER = 4.0  # times: the distances of another convention must be so much less
AMBIGUOUS = 1.5  # times the distances of the best convention: one with less is as good
MOST_ORDERED = 6  # cameras whose order is tried: 720 orders
POINTS, LEAST_POINTS = 1500, 60  # of a pair of views
STEPS, WIDEST = 25, 4.0  # of straightening pixels; tangent of the widest angle
GRAPHICS = np.diag([1.0, -1.0, -1.0])


class PoseConvention(NamedTuple):
    """A convention of poses and their order.

    Attributes
    ----------
    inverted
        From camera to room, instead of from room to camera.
    graphics
        With y up and z backwards, instead of OpenCV's axes.
    order
        (K,) which camera of the calibration is that of each view.
    """

    inverted: bool
    graphics: bool
    order: tuple[int, ...]

    def pose(self, given: Pose) -> Pose:
        """Return a pose from room to camera, in OpenCV's axes."""
        rotation, translation = given
        if self.inverted:
            rotation, translation = rotation.T, -rotation.T @ translation
        if self.graphics:
            rotation, translation = GRAPHICS @ rotation, GRAPHICS @ translation
        return Pose(rotation, translation)


def as_meant(
    keypoints: Float64, weights: Float64, usual: Rig, calibration: Calibration
) -> tuple[Calibration, tuple[Finding, ...]]:
    """Return a calibration in OpenCV's convention, and a finding if it was given in another.

    Parameters
    ----------
    keypoints, weights
        (N, K, P, 2) pixels and (N, K, P), 0 where not observed.
    usual
        Cameras with usual lenses, for those that are not given.
    """
    poses = poses_of(calibration)
    posed = [view for view, pose in enumerate(poses) if pose is not None]
    if len(posed) < 2:
        return calibration, ()
    table = _Table(keypoints, weights, with_given_lenses(usual, calibration)[0].lenses, poses)
    given = PoseConvention(inverted=False, graphics=False, order=tuple(range(len(poses))))
    off = table.off(given)
    if not off > FITTING * table.radius:
        return calibration, ()
    orders = [given.order]
    if len(posed) == len(poses) <= MOST_ORDERED:
        orders = list(permutations(given.order))
    readings = [
        PoseConvention(inverted, graphics, order)
        for inverted in (False, True)
        for graphics in (False, True)
        for order in orders
    ]
    found = sorted(
        ((table.off(convention), convention) for convention in readings), key=lambda r: r[0]
    )
    (least, best), rivals = found[0], found[1:]
    as_good = [convention for left, convention in rivals if left < AMBIGUOUS * least]
    if least > min(off / BETTER, FITTING * table.radius) or as_good:
        return calibration, ()
    evidence = {
        "inverted": float(best.inverted),
        "graphics_axes": float(best.graphics),
        "off_as_given_px": off,
        "off_px": least,
    }
    if best.order != given.order:
        evidence |= {f"camera_of_view_{v}": float(camera) for v, camera in enumerate(best.order)}
    finding = Finding.of("calibration_read_otherwise", views=posed).with_evidence(evidence)
    meant = [_read(calibration[camera], poses[camera], best) for camera in best.order]
    return tuple(meant), (finding,)


def _read(camera: Camera | None, given: Pose | None, convention: PoseConvention) -> Camera | None:
    if camera is None or given is None:
        return camera
    pose = convention.pose(given)
    rotation = tuple(tuple(row) for row in pose.rotation.tolist())
    translation = tuple(pose.translation.tolist())
    return camera.model_copy(update={"rotation": rotation, "translation": translation})


class _Table:
    """Distances of keypoints from epipolar lines, for any choice of cameras for two views."""

    def __init__(
        self,
        keypoints: Float64,
        weights: Float64,
        lenses: Lenses,
        poses: Sequence[Pose | None],
    ) -> None:
        self.seen = seen_keypoints(keypoints, weights)
        self.radius = self.seen.radius
        self.lenses, self.poses = lenses, poses
        self.focals = lenses.focals.mean(1)
        self.known: dict[tuple[bool, bool, int, int, int, int], float] = {}
        self.straight: dict[tuple[int, int], Float64] = {}

    def off(self, convention: PoseConvention) -> float:
        """Return the mean over pairs of views of the median distance in pixels; inf without any."""
        pairs = [
            self._pair(convention, *pair)
            for pair in combinations(range(len(self.poses)), 2)
            if all(self.poses[convention.order[view]] is not None for view in pair)
        ]
        known = [off for off in pairs if math.isfinite(off)]
        return float(np.mean(known)) if known else math.nan

    def _pair(self, convention: PoseConvention, v: int, w: int) -> float:
        a, b = convention.order[v], convention.order[w]
        key = (convention.inverted, convention.graphics, v, w, a, b)
        if key not in self.known:
            self.known[key] = self._measured(convention, v, w, a, b)
        return self.known[key]

    def _measured(self, convention: PoseConvention, v: int, w: int, a: int, b: int) -> float:
        given = self.poses[a], self.poses[b]
        if given[0] is None or given[1] is None:
            return math.nan
        both = np.flatnonzero(self.seen.there[:, v] & self.seen.there[:, w])
        both = both[:: max(1, len(both) // POINTS)]
        if len(both) < LEAST_POINTS:
            return math.nan
        one, other = convention.pose(given[0]), convention.pose(given[1])
        turn = other.rotation @ one.rotation.T
        essential = np.cross(np.eye(3), other.translation - turn @ one.translation) @ turn
        to_x, to_y = (np.diag([1 / self.focals[c], 1 / self.focals[c], 1.0]) for c in (a, b))
        x, y = (self._straightened(*each)[both] for each in ((v, a), (w, b)))
        return float(np.median(np.abs(sampson_distances(to_y @ essential @ to_x, x, y))))

    def _straightened(self, view: int, camera: int) -> Float64:
        """Return a view's pixels (M, 2) from the middle, with a camera's distortion undone."""
        if (view, camera) not in self.straight:
            pixels = self.seen.pixels[:, view].reshape(1, 1, -1, 2)
            lens = self.lenses.of(np.array([camera]))
            flat = (pixels - lens.centres) / lens.focals
            for _ in range(STEPS):
                points = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
                flat = flat + (pixels - project(points, lens)) / lens.focals
                flat = np.clip(flat, -WIDEST, WIDEST)
            self.straight[view, camera] = flat[0, 0] * self.focals[camera]
        return self.straight[view, camera]
