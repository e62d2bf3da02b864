"""The results of a fit as files: the animation in one room, the cameras, the weights, figures."""

import numpy as np

from fewview.animation import Animation, Unit
from fewview.api.forms import Cameras
from fewview.api.lifting import Lift
from fewview.calibration import Camera
from fewview.capture import Capture
from fewview.room import Room, to_room


def room_of(lift: Lift, cameras: Cameras, capture: Capture) -> tuple[Room | None, list[str]]:
    """Place all frames in one room: y up if up can be estimated, else the first view's axes.

    Returns
    -------
    tuple
        The room, None if no frame has a perspective pose; and notes about it.
    """
    static = [view.index for view in cameras.views if view.static]
    reference = static[0] if static else 0
    reasons: list[str] = []
    for up in ("auto", None):
        try:
            room = to_room(
                lift.points3d,
                lift.rotations,
                lift.translations,
                lift.camera_models,
                reference=reference,
                up=up,
                keypoint_names=capture.keypoint_names,
            )
        except ValueError as error:
            reasons.append(str(error))
        else:
            return room, [*reasons, *room.notes]
    return None, [*reasons[-1:], "structures stay canonical: every frame has its own axes"]


def animation_of(
    lift: Lift, room: Room | None, capture: Capture, *, unit: Unit | None
) -> Animation:
    """Return the frames as an animation, in the room if there is one."""
    times = capture.times
    if times is not None:
        times = times[: len(lift)]  # frames may have been added to the dataset since
        times = np.nanmedian(times, axis=1) if times.ndim == 2 else times
    sds = None if lift.points3d_sd is None else lift.points3d_sd.astype(np.float64)
    if sds is not None and room is not None:
        sds *= room.scales[:, None]
    return Animation(
        points=np.asarray(lift.points3d if room is None else room.points, np.float64),
        unit=unit,
        fps=capture.fps,
        times=times,
        keypoint_names=capture.keypoint_names,
        edges=capture.edges or (),
        numbers=capture.numbers,
        points_sd=sds,
        cameras=_cameras_of(lift, room, capture),
    )


def _cameras_of(lift: Lift, room: Room | None, capture: Capture) -> tuple[Camera, ...]:
    """Return the cameras of the room; none if one of them is of no kind that files describe."""
    try:
        found = [] if room is None else room.cameras(lift, capture.view_names, capture.image_sizes)
    except ValueError:
        found = []
    return tuple(found)
