"""Reading untrusted files in a separate process, which may crash or run out of memory or time.

Readers trust no count in a file, and yet a small file may need gigabytes, and the libraries below
them are written in C. A crash ends the child, not its parent. The child is also confined, so that
no file can make it read anything outside the upload.

How many children there are at a time is bounded in `app.py`: the process's `large_at_a_time` and
two more, of `MEMORY` at most each. Should they fill the machine's memory all the same, the kernel
ends a child, and not the service. A child that takes long leaves the CPUs to others.
"""

import io
import json
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from fewview.calibration import FORMATS as CALIBRATIONS
from fewview.capture import CameraCalibration, Capture, SeenPerson, ViewPeople
from fewview.errors import FormatError
from fewview.reading_options import ReadingOptions

from service.wire.children import child_code, child_environment, limit
from service.wire.confinement import confine
from worker.process import die_with_parent, python

logger = logging.getLogger(__name__)

MEMORY = 3 * 2**30  # bytes of addresses, what Python and its libraries take among them
SECONDS = 120
QUICK_SECONDS, SLOW_NICENESS = 5, 10  # a child that takes longer gets this niceness
OUT, CAPTURE, OTHERS = "out", "capture.npz", "others.json"
FOLDERS = "folders"
READERS = (
    "h5py",
    "yaml",
    "fewview.readers.reading",
    *(f"fewview.calibration.{known.module}" for known in CALIBRATIONS),
)
LONGEST_LOG = 2000  # characters


def read_apart(
    folder: Path,
    names: Sequence[str],
    options: ReadingOptions,
    *,
    max_bytes: int,
    holds_folders: bool = False,
    with_people: bool = False,
) -> Capture:
    """Read untrusted files as `fewview.read` does, in a separate process.

    Parameters
    ----------
    folder
        The folder with the files, and nothing else; messages leave it out.
    names
        Of the files in it, one for each camera.
    max_bytes
        Largest capture that is taken, as float32 and float64.
    holds_folders
        Whether the one file is a zip whose files and folders are read as if they were named.
    with_people
        Whether to look whom each view shows.

    Raises
    ------
    FormatError
        As `fewview.read`, and if reading takes too much memory or time, or ends the process.
    """
    asked = {
        "options": asdict(options),
        "max_bytes": max_bytes,
        "holds_folders": holds_folders,
        "with_people": with_people,
    }
    return _capture(_apart(folder, names, asked))


def cameras_apart(
    folder: Path, names: Sequence[str], views: Sequence[str]
) -> tuple[CameraCalibration, list[str]]:
    """Read an untrusted calibration in a separate process, as `fewview.read` does beside keypoints.

    Parameters
    ----------
    views
        Names of the views whose cameras are sought.

    Returns
    -------
    tuple
        The cameras of the views, and how they were found, in sentences.

    Raises
    ------
    FormatError
        If there is no calibration, or it does not fit the views, and as for `read_apart`.
    """
    out = _apart(folder, names, {"views": list(views)})
    others = json.loads((out / OTHERS).read_bytes())
    return _calibration(others["calibration"]), others["notes"]


def _apart(folder: Path, names: Sequence[str], asked: dict[str, Any]) -> Path:
    """Have a child read files of a folder; return the folder of what it wrote.

    Raises
    ------
    FormatError
        If the child found a fault, takes too much memory or time, or ended.
    """
    out = folder / OUT
    out.mkdir()
    asked = {"names": list(names), "parent": os.getpid(), **asked}
    code = child_code(f"from {__name__} import main", "main()")
    try:
        # What the child unpacks goes with the folder, even if it is killed.
        environment = child_environment(TMPDIR=str(folder))
        done = _run(python("-c", code), json.dumps(asked).encode(), folder, environment)
    except subprocess.TimeoutExpired:
        raise FormatError(f"{', '.join(names)}: took more than {SECONDS} s to read") from None
    if done.returncode == 0:
        return out
    if done.returncode == 1 and done.stdout:
        option, _, message = done.stdout.decode(errors="replace").partition("\n")
        known = {field.name for field in fields(ReadingOptions)}
        raise FormatError(message, option=option if option in known else None)
    errors = done.stderr.decode(errors="replace")[-LONGEST_LOG:]
    logger.warning("Reading files ended with status %d: %s", done.returncode, errors)
    raise FormatError(
        f"{', '.join(names)}: broken, or too much: reading ended without an answer "
        f"(status {done.returncode})"
    )


def _run(
    command: list[str], given: bytes, folder: Path, environment: dict[str, str]
) -> subprocess.CompletedProcess[bytes]:
    """Do as ``subprocess.run`` does; a process that takes long gives way to others on the CPUs."""
    with subprocess.Popen(  # noqa: S603 (our own program; names come as data)
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=folder,
        env=environment,
    ) as process:
        quick = min(QUICK_SECONDS, SECONDS)
        try:
            try:
                out, errors = process.communicate(given, timeout=quick)
            except subprocess.TimeoutExpired:
                os.setpriority(os.PRIO_PROCESS, process.pid, SLOW_NICENESS)
                out, errors = process.communicate(timeout=SECONDS - quick)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, errors)


def _capture(out: Path) -> Capture:
    with np.load(io.BytesIO((out / CAPTURE).read_bytes()), allow_pickle=False) as arrays:
        found: dict[str, Any] = {
            name: arrays[name]
            for name in ("keypoints", "confidence", "points3d", "times")
            if name in arrays
        }
    others = json.loads((out / OTHERS).read_bytes())
    calibration, people = others.pop("calibration"), others.pop("people")
    if calibration is not None:
        found["calibration"] = _calibration(calibration)
    if people is not None:
        found["people"] = tuple(map(_people, people))
    return Capture(**found, **{name: _tuples(value) for name, value in others.items()})


def _calibration(found: dict[str, Any]) -> CameraCalibration:
    return CameraCalibration(found["file"], tuple(found["names"]), tuple(found["cameras"]))


def _people(view: dict[str, Any]) -> ViewPeople:
    people = [
        SeenPerson(**{**one, "keypoints": np.array(one["keypoints"], np.float32)})
        for one in view["people"]
    ]
    return ViewPeople(tuple(people), _tuples(view["edges"]))


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def main() -> None:
    """Read the files that standard input names into the folder ``out``.

    Exit status 1: the first line of standard output is the option that is wrong, or empty, and the
    error is below.
    """
    asked = json.loads(sys.stdin.buffer.read())
    die_with_parent(asked.pop("parent"))
    limit(MEMORY, SECONDS)
    try:
        if "views" in asked:
            _read_cameras(**asked)
        else:
            _read(ReadingOptions(**asked.pop("options")), **asked)
    except FormatError as error:
        sys.stdout.write(f"{error.option or ''}\n{error}")
        sys.exit(1)
    except MemoryError:
        sys.stdout.write(
            f"\n{', '.join(asked['names'])}: need more memory than there is; part them"
        )
        sys.exit(1)


def _read_cameras(names: list[str], views: list[str]) -> None:
    _load_readers()
    from fewview.readers.calibrations import calibrations_at, of_views  # noqa: PLC0415

    confine(Path())
    notes: list[str] = []
    _, found = of_views(calibrations_at(map(Path, names), notes), views, None, notes)
    if found is None:
        known = "TOML of Anipose, Pose2Sim, FreeMoCap or caliscope, YAML or JSON of OpenCV"
        reason = "; ".join(notes) or f"no calibration that is known: {known}"
        raise FormatError(f"{', '.join(names)}: {reason}")
    Path(OUT, OTHERS).write_text(json.dumps({"calibration": asdict(found), "notes": notes}))


def _load_readers() -> None:
    """Load what is needed, within the limits, and before no module can be opened any more."""
    for name in READERS:
        import_module(name)


def _read(
    options: ReadingOptions,
    names: list[str],
    max_bytes: int,
    *,
    holds_folders: bool,
    with_people: bool,
) -> None:
    _load_readers()
    from fewview.readers.archives import laid_out  # noqa: PLC0415
    from fewview.readers.reading import read_with  # noqa: PLC0415

    out = Path(OUT).absolute()
    confine(Path())
    if holds_folders:
        (zipped,), inside = names, out / FOLDERS
        inside.mkdir()
        os.chdir(inside)  # so that messages have the names that files have for who sent them
        names = laid_out(out.parent / zipped, Path())
    capture = read_with(names, replace(options, untrusted=True), with_people=with_people)
    arrays = capture.arrays()
    size = sum(array.nbytes for array in arrays.values())
    if size > max_bytes:
        raise FormatError(
            f"{', '.join(names)}: make {capture.frames:,} frames of {capture.views} views, "
            f"{size:,} bytes, more than the {max_bytes:,} that are taken at a time; send them in "
            "parts"
        )
    np.savez(out / CAPTURE, allow_pickle=False, **arrays)
    others = {
        "keypoint_names": capture.keypoint_names,
        "edges": capture.edges,
        "view_names": capture.view_names,
        "image_sizes": capture.image_sizes,
        "fps": capture.fps,
        "notes": capture.notes,
        "calibration": capture.calibration and asdict(capture.calibration),
        "people": capture.people and [asdict(view) for view in capture.people],
    }
    (out / OTHERS).write_text(json.dumps(others, default=np.ndarray.tolist))
