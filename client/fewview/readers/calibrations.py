"""Calibrations among files of keypoints: which files they are, and whose cameras they have."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fewview.calibration import Camera, as_config, for_views, read_cameras
from fewview.capture import CameraCalibration
from fewview.errors import FormatError
from fewview.readers.views import View

DEPTH = 4  # of folders in folders
MAX_BYTES = 2**22  # of a file that may be a calibration
SUFFIXES = (".toml", ".yml", ".yaml")
# JSON is read as a calibration if it is called so, for there may be thousands of frames.
CALLED_SO = re.compile(r"calib|extrinsic|intrinsic|^cameras?(_?(params?|data))?$", re.IGNORECASE)
QUALISYS = re.compile(r"\.qca(\.txt)?$", re.IGNORECASE)
COLMAP = ("cameras.txt", "images.txt")


@dataclass(frozen=True)
class FoundCalibration:
    """What there is of calibrations at some paths.

    Attributes
    ----------
    paths
        Files, and folders of COLMAP's, that hold no keypoints.
    cameras
        Those of the one calibration that there is; none if there is none, or no one.
    name
        Of the file, or of the folder that has a file for each camera.
    """

    paths: frozenset[Path]
    cameras: tuple[Camera, ...] = ()
    name: str = ""


def calibrations_at(paths: Iterable[Path], notes: list[str]) -> FoundCalibration:
    """Return the calibration at the paths of keypoints, in their folders too.

    It is one file, or files of one camera each. Of several nothing is taken.

    Parameters
    ----------
    notes
        Gets what looks like a calibration and is not taken, and why.
    """
    read: dict[Path, list[Camera]] = {}
    left: list[Path] = []
    for path in dict.fromkeys(each for given in paths for each in _candidates(given, DEPTH)):
        try:
            read[path] = _cameras_in(path)
        except (FormatError, OSError, ImportError, RecursionError) as error:
            if QUALISYS.search(path.name) or CALLED_SO.search(path.stem):
                left.append(path)
                notes.append(f"{path.name}: a calibration, which was left out: {_reason(error)}")
    mine = frozenset((*read, *left))
    if not read:
        return FoundCalibration(mine)
    if len(read) == 1:
        ((path, cameras),) = read.items()
        return FoundCalibration(mine, tuple(cameras), path.name)
    of_one = [camera for cameras in read.values() for camera in cameras]
    if len(of_one) == len(read) == len({camera.name for camera in of_one}):
        names = ", ".join(path.name for path in read)
        return FoundCalibration(mine, tuple(of_one), names)
    listed = ", ".join(f"{path.parent.name}/{path.name}" for path in read)
    notes.append(f"there are several calibrations ({listed}), of which none was taken: leave one")
    return FoundCalibration(mine)


def calibrations_within(found: FoundCalibration, views: Sequence[View]) -> FoundCalibration:
    """Return the calibration beside the files, or else that of all views within them."""
    within = [replace(view.camera, name=view.name) for view in views if view.camera is not None]
    if found.cameras or len(within) < len(views):
        return found
    return FoundCalibration(found.paths, tuple(within), "the file of the keypoints")


def of_views(
    found: FoundCalibration, names: Sequence[str], wanted: Sequence[int] | None, notes: list[str]
) -> tuple[list[Camera] | None, CameraCalibration | None]:
    """Return the cameras of the views that are wanted, in two forms; None if they do not fit.

    Parameters
    ----------
    names
        Of all views.
    wanted
        Indices of those that are wanted; None for all.
    notes
        Gets which cameras they are, or why there are none.
    """
    if not found.cameras:
        return None, None
    mine = list(range(len(names))) if wanted is None else list(wanted)
    try:
        try:
            all_views, how = for_views(found.cameras, names)
            cameras = [all_views[index] for index in mine]
        except FormatError:
            if wanted is None:
                raise
            cameras, how = for_views(found.cameras, [names[index] for index in mine])
        given = CameraCalibration(
            found.name,
            tuple(camera.name for camera in cameras),
            tuple(as_config(camera) for camera in cameras),
        )
    except FormatError as error:
        notes.append(f"{found.name}: a calibration, which was left out: {error}")
        return None, None
    notes.append(f"{found.name} is a calibration: {how}")
    return cameras, given


def _candidates(path: Path, depth: int) -> Iterator[Path]:
    """Yield what may be a calibration, by its name."""
    if path.is_dir():
        if all((path / name).is_file() for name in COLMAP):
            yield path
        elif depth:
            for inside in sorted(path.iterdir()):
                if not inside.name.startswith("."):
                    yield from _candidates(inside, depth - 1)
    elif path.is_file():
        suffix = path.suffix.lower()
        called_so = suffix == ".json" and CALLED_SO.search(path.stem)
        if suffix in SUFFIXES or called_so or QUALISYS.search(path.name):
            yield path


def _cameras_in(path: Path) -> list[Camera]:
    if QUALISYS.search(path.name):
        raise FormatError("of Qualisys; convert it, as Pose2Sim does into a calibration.toml")
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        raise FormatError(f"it has more than {MAX_BYTES / 2**20:.0f} MiB")
    return read_cameras(path)


def _reason(error: Exception) -> str:
    if isinstance(error, ImportError):
        return "YAML is read where PyYAML is installed"
    return " ".join((error.problem if isinstance(error, FormatError) else str(error)).split())
