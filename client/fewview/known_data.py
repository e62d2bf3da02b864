"""Data sets of the literature as captures with their truth, from the files that are published.

The pickles of the MV-NRSfM authors (`CAM_*.pkl`), which hold such data, too, are read by
:func:`fewview.read`.
"""

import json
import re
import zipfile
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from fewview.capture import Capture
from fewview.errors import FormatError
from fewview.readers import pickles
from fewview.readers.skeletons import NAMED, SKELETONS

MAX_BYTES = 2**31  # of what is read into memory at once

# Of the 32 joints in `data_3d_h36m.npz`, the 17 that move; VideoPose3D, `common/h36m_dataset.py`.
H36M_JOINTS = (0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 17, 18, 19, 25, 26, 27)
H36M_CAMERAS = ("54138969", "55011271", "58860488", "60457274")
H36M_FPS = 50.0

MACAQUE = NAMED["openmonkeystudio-13"]
MACAQUE_POINTS = len(MACAQUE.names)
OMS_IMAGE = re.compile(r"\Abatch(\w+?)_(\d+)_(\d+)\.jpg")  # batch, frame, camera

File = str | PathLike[str]


def human36m(keypoints: File, truth: File, *, subject: str, action: str) -> Capture:
    """Return an action of Human3.6M: four cameras, 17 keypoints, the truth in metres.

    The layout is that of VideoPose3D (`data/prepare_data_h36m.py` in
    https://github.com/facebookresearch/VideoPose3D): `data_2d_h36m_*.npz` holds `positions_2d`, of
    each subject and action a list of an array (N, 17, 2) of pixels for each camera (or (N, 32, 2));
    `data_3d_h36m.npz` holds `positions_3d`, arrays (N, 32, 3). Detections of some cameras go on
    longer than the truth: all end with the shortest, as there. The pickles in them are not
    executed.

    Raises
    ------
    FormatError
        The files have another layout, or no such subject or action; the message lists them.
    """
    views = _chosen(Path(keypoints), "positions_2d", subject, action)
    points = np.asarray(_chosen(Path(truth), "positions_3d", subject, action), np.float32)
    try:
        seen = [_moving(np.asarray(view, np.float32)[..., :2]) for view in views]
        points = _moving(points)
        length = min(map(len, (*seen, points)))
        stacked = np.stack([view[:length] for view in seen], 1)
        if stacked.shape[2:] != (17, 2) or points.shape[1:] != (17, 3):
            raise ValueError(f"got {stacked.shape[2:]} and {points.shape[1:]}")
    except (ValueError, TypeError, IndexError) as error:
        raise FormatError(
            f"{keypoints}, {truth}: expected 17 or 32 keypoints of each view and 3D ({error})"
        ) from error
    skeleton = SKELETONS["h36m-17"]
    return Capture(
        stacked,
        points3d=points[:length],
        times=np.arange(length) / H36M_FPS,
        keypoint_names=skeleton.names,
        edges=skeleton.edges,
        view_names=H36M_CAMERAS if len(seen) == len(H36M_CAMERAS) else None,
    )


def freihand(folder: File, *, part: str = "training") -> Capture:
    """Return the hands of FreiHAND: a view each, 21 keypoints, the truth in metres.

    The layout is that of `FreiHAND_pub_v2`, as `utils/fh_utils.py` in
    https://github.com/lmb-freiburg/freihand reads it: `training_K.json` and `training_xyz.json`
    are lists of a matrix (3, 3) and of points (21, 3) in the camera's axes for each sample. The
    keypoints are these points, projected, as there. Every sample is seen by one camera: several
    views of it are made by turning it, as the paper did.

    Raises
    ------
    FormatError
        The files have another layout.
    """
    lenses, points = (_listed(Path(folder) / f"{part}_{what}.json") for what in ("K", "xyz"))
    if lenses.shape[1:] != (3, 3) or points.shape != (len(lenses), 21, 3):
        raise FormatError(
            f"expected matrices (N, 3, 3) and points (N, 21, 3), got {lenses.shape} and "
            f"{points.shape}",
            place=folder,
        )
    shown = points @ lenses.mT
    skeleton = SKELETONS["hands-21"]
    return Capture(
        np.asarray(shown[:, None, :, :2] / shown[:, None, :, 2:], np.float32),
        points3d=np.asarray(points, np.float32),
        keypoint_names=skeleton.names,
        edges=skeleton.edges,
    )


def openmonkeystudio(folder: File, *, batch: str) -> Capture:
    """Return a batch of OpenMonkeyStudio: a macaque, a view for each camera, 13 keypoints, truth.

    The layout is that of the README of https://github.com/OpenMonkeyStudio/OMS_Data: `Data.mat`
    has the labels of each image, (y, x) from the corner of the crop that the image is.
    `Batch7/crop_para.mat` has the places of the crops in the cameras' images, and
    `Batch7/coords_3D.mat` the keypoints in space. Frames are those that have 3D. A view is named by
    its camera. Most cameras show few frames, so one usually fits a part of the up to 62 views.
    Needs SciPy (`pip install 'fewview[mat]'`).

    Raises
    ------
    FormatError
        The files have another layout, there is no such batch, or SciPy is not installed.
    """
    place = Path(folder) / f"Batch{batch}"
    try:
        points = _of_mat(place / "coords_3D.mat", "coords").reshape(-1, MACAQUE_POINTS, 4)
        crops = _of_mat(place / "crop_para.mat", "crop").reshape(-1, 6)
        labelled = _of_mat(Path(folder) / "Data.mat", "T")
        images = [OMS_IMAGE.fullmatch(str(name)) for name in np.atleast_1d(labelled["name"])]
        labels = np.asarray(labelled["data"], np.float64).reshape(
            len(images), 4 + 2 * MACAQUE_POINTS
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise FormatError(f"expected the files of OMS_Data ({error})", place=folder) from error
    if (points[..., :1] != points[:, :1, :1]).any():
        raise FormatError(
            f"expected {MACAQUE_POINTS} rows of coordinates for each frame", place=place
        )
    frames = {int(number): index for index, number in enumerate(points[:, 0, 0])}
    cameras = {int(number): index for index, number in enumerate(np.unique(crops[:, 1]))}
    corners = {(int(crop[0]), int(crop[1])): crop[2:4] for crop in crops}
    keypoints = np.full((len(frames), len(cameras), MACAQUE_POINTS, 2), np.nan, np.float32)
    for image, label in zip(images, labels, strict=True):
        if image is None or image[1] != batch:
            continue
        frame, camera = int(image[2]), int(image[3])
        if frame in frames and (frame, camera) in corners:
            shown = label[4:].reshape(-1, 2)[:, ::-1] + corners[frame, camera]
            keypoints[frames[frame], cameras[camera]] = shown
    return Capture(
        keypoints,
        points3d=points[..., 1:].astype(np.float32),
        keypoint_names=MACAQUE.names,
        edges=MACAQUE.edges,
        view_names=tuple(map(str, cameras)),
    )


def _of_mat(file: Path, name: str) -> Any:
    try:
        from scipy.io import loadmat  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise FormatError(
            ".mat files need SciPy, which is not installed: pip install 'fewview[mat]'"
        ) from error
    if not file.is_file():
        raise FormatError("there is no such file", place=file)
    return loadmat(file, variable_names=[name], simplify_cells=True)[name]


def _moving(positions: Any) -> Any:
    return positions[:, H36M_JOINTS] if positions.shape[1] == 32 else positions


def _chosen(file: Path, name: str, subject: str, action: str) -> Any:
    """Return an action in an npz: one object array, which is a pickle."""
    try:
        with zipfile.ZipFile(file) as archive:
            if archive.getinfo(f"{name}.npy").file_size > MAX_BYTES:
                raise FormatError(f"{name} has more than {MAX_BYTES} bytes", place=file)
            with archive.open(f"{name}.npy") as stream:
                version = np.lib.format.read_magic(stream)
                if version == (1, 0):
                    np.lib.format.read_array_header_1_0(stream)
                else:
                    np.lib.format.read_array_header_2_0(stream)
                content = pickles.load(stream.read(), str(file))
    except FormatError:
        raise
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise FormatError(f"expected an npz with {name!r} of VideoPose3D", place=file) from error
    found: Any = content.item() if isinstance(content, np.ndarray) else content
    for key in (subject, action):
        if not isinstance(found, dict) or key not in found:
            known = ", ".join(map(str, found)) if isinstance(found, dict) else "none"
            raise FormatError(f"there is no {key!r}, but {known}", place=file)
        found = found[key]
    return found


def _listed(file: Path) -> Any:
    if file.stat().st_size > MAX_BYTES:
        raise FormatError(f"has more than {MAX_BYTES} bytes", place=file)
    try:
        return np.array(json.loads(file.read_bytes()), np.float64)
    except (ValueError, TypeError, RecursionError) as error:
        raise FormatError(f"expected a list of lists of numbers ({error})", place=file) from error
