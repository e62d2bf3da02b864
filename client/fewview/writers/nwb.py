"""NWB with ndx-pose: the points as `MultiCameraPoseEstimation`, with confidences and the skeleton.

How far points may be off is a series of its own beside it, `points_sd` (N, P). Cameras are
calibrated devices, each with an estimate that has no series. pynwb writes the file, so that it
carries the schema of both, as archives ask for.

Source: the documentation of pynwb and of ndx-pose 0.4.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fewview.animation import Animation
from fewview.calibration import Camera
from fewview.errors import FormatError
from fewview.writers.confidences import confidences_of

UNITS = {"m": "meters", "mm": "millimeters", None: "unknown"}
FRAME = "one frame of reference of all frames, right-handed"
START = datetime(1970, 1, 1, tzinfo=UTC)  # of a session whose date nobody gave


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a session; the file has no date of it but 1970-01-01.

    Raises
    ------
    FormatError
        If pynwb or ndx-pose is not installed, or a name of a keypoint has a slash or a colon.
    """
    try:
        import ndx_pose  # noqa: PLC0415  # an extra
        import pynwb  # noqa: PLC0415
    except ImportError as error:
        raise FormatError(
            "NWB needs pynwb and ndx-pose, which are not installed: pip install 'fewview[nwb]'"
        ) from error
    if any(mark in name for name in animation.names for mark in "/:"):
        raise FormatError("names of keypoints in NWB can have no slash and no colon")
    session = pynwb.NWBFile("points in 3D, by Fewview", path.stem, START)
    behaviour = session.create_processing_module("behavior", "points in 3D")
    skeleton = ndx_pose.Skeleton(
        name="skeleton",
        nodes=list(animation.names),
        edges=np.array(animation.edges, np.uint8 if len(animation.names) < 256 else np.uint16)
        if animation.edges
        else None,
    )
    behaviour.add(ndx_pose.Skeletons(skeletons=[skeleton]))
    clock: dict[str, Any] = {"timestamps": animation.seconds}
    sure = confidences_of(animation)
    series: list[Any] = []
    for place, name in enumerate(animation.names):
        series.append(
            ndx_pose.PoseEstimationSeries(
                name=name,
                description=f"places of {name}",
                data=animation.points[:, place],
                unit=UNITS[animation.unit],
                reference_frame=FRAME,
                confidence=sure[:, place],
                confidence_definition="1 / (1 + (sd / (0.05 radius of the subject))^2)",
                **(clock if not series else {"timestamps": series[0]}),
            )
        )
    behaviour.add(
        ndx_pose.MultiCameraPoseEstimation(
            name="MultiCameraPoseEstimation",
            pose_estimation_series=series,
            pose_estimations=_views(ndx_pose, session, animation.cameras),
            description="points that several cameras determine",
            source_software="Fewview",
            skeleton=skeleton,
        )
    )
    if animation.points_sd is not None:
        behaviour.add(
            pynwb.TimeSeries(
                name="points_sd",
                description="standard deviations of the points, in the order of the skeleton",
                data=animation.points_sd,
                unit=UNITS[animation.unit],
                **clock,
            )
        )
    # Given open: pynwb warns of names without `.nwb`, and files may be named as one likes.
    with h5py.File(path, "w") as whole, pynwb.NWBHDF5IO(file=whole, mode="w") as file:
        file.write(session)


def _views(ndx_pose: Any, session: Any, cameras: tuple[Camera, ...]) -> list[Any]:
    """Add the cameras to a session; return an estimate without positions for each."""
    views = []
    for camera in cameras:
        known: dict[str, Any] = {}
        if camera.rotation is not None and camera.translation is not None:
            known["rotation_matrix"] = camera.rotation.astype(np.float32)
            known["translation_vector"] = camera.translation.astype(np.float32)
        if len(camera.distortion):
            known["distortion_coefficients"] = camera.distortion.astype(np.float32)
        name = camera.name.replace("/", "_").replace(":", "_")
        device = ndx_pose.CalibratedCamera(
            name=name,
            description=f"camera of OpenCV's {'fisheye' if camera.fisheye else 'usual'} model",
            intrinsic_matrix=camera.matrix.astype(np.float32),
            **known,
        )
        session.add_device(device)
        views.append(
            ndx_pose.PoseEstimation(
                name=f"view_{name}",
                pose_estimation_series=[],
                description=f"what {name} saw is not in this file",
                device=device,
            )
        )
    return views
