"""All frames of a lift in one room: that of static cameras, in which a walking subject walks.

A lift's structures are canonical: centred, and turning with the subject from frame to frame. Only
the cameras' poses, `x_cam = R X + t`, give the place of a frame's structure. Static cameras keep
their poses relative to each other, so all of them agree on one room.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview.calibration.camera import Camera
from fewview.geometry.rigs import Placed, in_rig, known_poses, nearest_rotation
from fewview.geometry.upright import Up

if TYPE_CHECKING:
    from fewview.api.lifting import Lift

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FISHEYE = 2  # among `camera_models`
AT_REST = np.radians(0.1)  # median scatter of a relative pose; lifts with a rig have 1e-5 of it


@dataclass(frozen=True)
class Room(Placed):
    """A lift in a room, and its cameras as files have them."""

    def cameras(
        self,
        lift: "Lift",
        names: Sequence[str] | None = None,
        sizes: Sequence[tuple[int, int] | None] | None = None,
    ) -> list[Camera]:
        """Return the K views of the lift as cameras of this room; those that move have no pose.

        A view's lens is the median over its perspective frames; names and image sizes (width,
        height) are for files.

        Raises
        ------
        ValueError
            If a view is perspective in no frame.
        """
        found = []
        for view in range(len(self.rotations)):
            name = names[view] if names else f"view{view}"
            models = np.asarray(lift.camera_models)[:, view]
            if not (models > 0).any():
                raise ValueError(
                    f"{name} is never perspective: no calibration can describe its camera"
                )
            fx, fy, cx, cy, *distortion = np.median(
                np.concatenate((lift.focals, lift.principal_points, lift.distortions), axis=-1)[
                    models > 0, view
                ].astype(np.float64),
                axis=0,
            )
            static = bool(np.isfinite(self.translations[view]).all())
            found.append(
                Camera(
                    name,
                    np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                    np.array(distortion),
                    self.rotations[view] if static else None,
                    self.translations[view] if static else None,
                    sizes[view] if sizes else None,
                    bool(models.max() == FISHEYE),
                )
            )
        return found


def to_room(
    points3d: ArrayLike,
    rotations: ArrayLike,
    translations: ArrayLike,
    camera_models: ArrayLike | None = None,
    cameras: Sequence[Camera] | None = None,
    reference: int | None = 0,
    up: Up = None,
    floor: bool | None = None,
    keypoint_names: Sequence[str] | None = None,
) -> Room:
    """Place the frames of a lift or a reconstruction in one room.

    Every static view gives a place of a frame's structure. Views that agree are averaged; if two
    contradict each other, the reference is used. A frame with another unit than the rig's (that of
    a moving camera) is scaled by its baselines.

    Parameters
    ----------
    points3d, rotations, translations, camera_models
        (N, P, 3), (N, K, 3, 3), (N, K, 3), (N, K), as lifts give them. Views of
        `camera_models` 0 or -1 and those whose pose is not finite are left out.
    cameras
        The K views as a fit estimated them or as they were calibrated; a view without a pose moves.
        The default are the relative poses that the frames have in common.
    reference
        The view whose axes the room has: x right, y down, z forward, its origin at the camera.
        None takes the frame of reference in which `cameras` are more.
    up
        A vector in the axes of the reference, 'auto' or None. If it is known the room is turned:
        y up, x level and to the right of the reference, z = x cross y.
    floor
        Whether y = 0 is to be the floor; None: if up is known and feet are named.
    keypoint_names
        P names, by which feet are found.

    Raises
    ------
    ValueError
        If shapes do not fit, no frame has a perspective pose of the reference or of `cameras`, or
        up or the floor was asked for and cannot be estimated.
    """
    turns, shifts = (np.asarray(array, np.float64) for array in (rotations, translations))
    known = known_poses(points3d, turns, shifts, camera_models)
    rig_turns, rig_shifts, notes = _rig(turns, shifts, known, cameras, reference)
    placed = in_rig(
        points3d,
        turns,
        shifts,
        camera_models,
        rig_turns,
        rig_shifts,
        believed=reference or 0,
        up=up,
        floor=floor,
        keypoint_names=keypoint_names,
    )
    return Room(**{**vars(placed), "notes": (*notes, *placed.notes)})


def _rig(
    turns: Float64,
    shifts: Float64,
    known: Bool,
    cameras: Sequence[Camera] | None,
    reference: int | None,
) -> tuple[Float64, Float64, list[str]]:
    """Return the poses (K, 3, 3), (K, 3) of static views, room to camera, NaN if they move."""
    views = turns.shape[1]
    if cameras is None:
        rig_turns, rig_shifts = _common_rig(turns, shifts, known, reference)
    else:
        if len(cameras) != views:
            raise ValueError(f"{len(cameras)} cameras were given for {views} views")
        rig_turns, rig_shifts = _given_rig(cameras, reference)
    are_static = np.isfinite(rig_shifts).all(1)
    if not known[:, are_static].any():
        raise ValueError("no frame has a perspective pose of a static camera")
    notes = []
    if are_static.sum() == 1 and views > 1:
        notes = [f"no other view is static with view {are_static.argmax()}: the room is its own"]
    return rig_turns, rig_shifts, notes


def _given_rig(cameras: Sequence[Camera], reference: int | None) -> tuple[Float64, Float64]:
    """Return the poses of given cameras towards the reference, or as they are without one."""
    turns, shifts = np.full((len(cameras), 3, 3), np.nan), np.full((len(cameras), 3), np.nan)
    for view, camera in enumerate(cameras):
        if camera.rotation is not None and camera.translation is not None:
            turns[view], shifts[view] = camera.rotation, camera.translation
    if reference is None:
        return turns, shifts
    if np.isnan(turns[reference]).any():
        raise ValueError(f"camera {reference} has no pose: take another reference")
    relative = turns @ turns[reference].T
    return relative, shifts - relative @ shifts[reference]


def _common_rig(
    turns: Float64, shifts: Float64, known: Bool, reference: int | None
) -> tuple[Float64, Float64]:
    """Return the poses towards the reference that the frames have in common."""
    if reference is None:
        raise ValueError("without cameras a view must be the reference")
    if not known[:, reference].any():
        raise ValueError(f"view {reference} has no perspective pose: take another reference")
    views = turns.shape[1]
    rig_turns, rig_shifts = np.full((views, 3, 3), np.nan), np.full((views, 3), np.nan)
    for view in range(views):
        found = _relative_pose(turns, shifts, known, view, reference)
        if found is not None:
            rig_turns[view], rig_shifts[view] = found
    return rig_turns, rig_shifts


def _relative_pose(
    turns: Float64, shifts: Float64, known: Bool, view: int, reference: int
) -> tuple[Float64, Float64] | None:
    """Return the pose R (3, 3), t (3,) that a view keeps towards another, None if it keeps none."""
    shared = known[:, view] & known[:, reference]
    if not shared.any():
        return None
    relative = turns[shared, view] @ turns[shared, reference].transpose(0, 2, 1)
    middle = nearest_rotation(np.median(relative, axis=0))
    steps = shifts[shared, view] - np.einsum("ij,nj->ni", middle, shifts[shared, reference])
    step = np.median(steps, axis=0)
    # Angles by their chord, which is exact for small ones where an arc cosine is not.
    scatter = np.linalg.norm(relative - middle, axis=(1, 2)) / np.sqrt(2)
    sideways = np.linalg.norm(np.cross(steps, step), axis=1) / max(step @ step, 1e-300)
    still = np.median(scatter) < AT_REST and (
        view == reference or np.median(sideways) < AT_REST or np.ptp(steps, axis=0).max() < 1e-9
    )
    return (middle, step) if still else None
