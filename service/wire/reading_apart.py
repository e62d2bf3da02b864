"""Reading untrusted files in a separate process, which may crash or run out of memory or time.

Readers trust no count in a file, and yet a small file may need gigabytes, and the libraries below
them are written in C. A crash ends the child, not its parent. The child is also confined, so that
no file can make it read anything outside the upload.

How many children there are at a time is bounded in `app.py`: the process's `large_at_a_time` and
two more, of `MEMORY` (`reading_child.py`) at most each. Should they fill the machine's memory all
the same, the kernel ends a child, and not the service. A child that takes long leaves the CPUs to
others.
"""

import json
import logging
import os
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from fewview.capture import CameraCalibration, Capture, SeenPerson, ViewPeople
from fewview.errors import FormatError
from fewview.reading_options import ReadingOptions
from pydantic import BaseModel, ConfigDict, field_validator

from service.http.errors import ApiError
from service.wire import reading_child
from service.wire.arrays import from_bytes
from service.wire.children import child_code, child_environment
from service.wire.reading_child import (
    CAPTURE,
    ERROR,
    LOG,
    LONGEST_OTHERS,
    OTHERS,
    OUT,
    SECONDS,
    Unpacking,
)
from worker.process import python

Made = TypeVar("Made")
logger = logging.getLogger(__name__)

QUICK_SECONDS, SLOW_NICENESS = 5, 10  # a child that takes longer gets this niceness
LONGEST_HEADERS, LONGEST_ERROR, LONGEST_LOG = 2**16, 2**16, 2000  # bytes


def read_apart(
    folder: Path,
    names: Sequence[str],
    options: ReadingOptions,
    *,
    max_bytes: int,
    unpack: Unpacking | None = None,
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
    unpack
        What the files may unpack to; `max_bytes` if not given.
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
        "unpack": unpack or Unpacking(max_bytes, f"{max_bytes:,} bytes"),
        "holds_folders": holds_folders,
        "with_people": with_people,
    }
    return _apart(folder, names, asked, partial(_capture, max_bytes=max_bytes))


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
    return _apart(folder, names, {"views": list(views)}, _cameras)


def _apart(
    folder: Path, names: Sequence[str], asked: dict[str, Any], made: Callable[[Path], Made]
) -> Made:
    """Have a child read files of a folder; return what it made, as a function reads it.

    Raises
    ------
    FormatError
        If the child found a fault, takes too much memory or time, or ended.
    """
    out = folder / OUT
    out.mkdir()
    asked = {"names": list(names), "parent": os.getpid(), **asked}
    code = child_code(f"from {reading_child.__name__} import main", "main()")
    place = ", ".join(names)
    try:
        # What the child unpacks goes with the folder, even if it is killed.
        environment = child_environment(TMPDIR=str(folder))
        status, log = _run(python("-c", code), json.dumps(asked).encode(), folder, environment)
    except subprocess.TimeoutExpired:
        raise FormatError(f"took more than {SECONDS} s to read", place=place) from None
    try:
        if status == 0:
            return made(out)
        if status == 1 and (out / ERROR).exists():
            found = _Error.model_validate_json(_made(out / ERROR, LONGEST_ERROR))
            raise FormatError(**found.model_dump())
    except (ApiError, LookupError, OSError, TypeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        logger.warning("Reading files left what cannot be read: %s", error)
    logger.warning("Reading files ended with status %d: %s", status, log)
    raise FormatError(
        f"broken, or too much: reading ended without an answer (status {status})", place=place
    )


def _run(
    command: list[str], given: bytes, folder: Path, environment: dict[str, str]
) -> tuple[int, str]:
    """Run a process, and return its status and the end of what it wrote.

    One that takes long gives way to others on the CPUs.
    """
    with (
        (folder / OUT / LOG).open("w+b") as log,
        subprocess.Popen(  # noqa: S603 (our own program; names come as data)
            command,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            cwd=folder,
            env=environment,
        ) as process,
    ):
        quick = min(QUICK_SECONDS, SECONDS)
        try:
            try:
                process.communicate(given, timeout=quick)
            except subprocess.TimeoutExpired:
                os.setpriority(os.PRIO_PROCESS, process.pid, SLOW_NICENESS)
                process.communicate(timeout=SECONDS - quick)
        except BaseException:
            process.kill()
            raise
        log.seek(max(0, log.seek(0, os.SEEK_END) - LONGEST_LOG))
        return process.returncode, log.read(LONGEST_LOG).decode(errors="replace")


class _Error(BaseModel):
    """A `FormatError`, as data."""

    model_config = ConfigDict(extra="forbid")

    problem: str
    place: str
    option: str | None
    remedy: str

    @field_validator("option")
    @classmethod
    def _known(cls, option: str | None) -> str | None:
        return option if option in {field.name for field in fields(ReadingOptions)} else None


def _made(path: Path, most: int) -> bytes:
    """Return a file that the child made, of bounded size; what a file made it do is not trusted."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"{path.name} has more than {most} bytes")
    return data


def _capture(out: Path, max_bytes: int) -> Capture:
    most = max_bytes + LONGEST_HEADERS
    found: dict[str, Any] = from_bytes(_made(out / CAPTURE, most), max_bytes=most)
    others = json.loads(_made(out / OTHERS, LONGEST_OTHERS))
    calibration, people = others.pop("calibration"), others.pop("people")
    if calibration is not None:
        found["calibration"] = _calibration(calibration)
    if people is not None:
        found["people"] = tuple(map(_people, people))
    return Capture(**found, **{name: _tuples(value) for name, value in others.items()})


def _cameras(out: Path) -> tuple[CameraCalibration, list[str]]:
    others = json.loads(_made(out / OTHERS, LONGEST_OTHERS))
    return _calibration(others["calibration"]), others["notes"]


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
