"""Reading untrusted files in the sandbox, which they may crash, or fill in memory or time.

Readers trust no count in a file, and yet a small file may need gigabytes, and the libraries below
them are written in C. How many are read at a time is bounded in `app.py`: the process's
`large_at_a_time` and two more.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fewview.capture import CameraCalibration, Capture, SeenPerson, ViewPeople
from fewview.errors import FormatError
from fewview.reading_options import ReadingOptions
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from service.wire.arrays import Arrays
from service.wire.sandbox import EndedError, LateError, Limits, shared

READER = "service.wire.file_readers"  # which loads what reads: not for this process
MEMORY = 2 * 2**30  # bytes
SECONDS = 120
LARGEST_FILE = 2**30  # bytes that are written: of an archive's file, of an array
BROKEN = "broken, or too much: reading ended without an answer"


class Unpacking(NamedTuple):
    """How many bytes files may unpack to, together, and what sets that bound, in words."""

    most: int
    bound: str


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
    others, arrays = _apart(folder, names, asked, max_bytes)
    with _trusting_nothing(names):
        return _capture(others, arrays)


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
    found, _ = _apart(folder, names, {"views": list(views)}, 0)
    with _trusting_nothing(names):
        return _calibration(found["calibration"]), found["notes"]


@contextmanager
def _trusting_nothing(names: Sequence[str]) -> Iterator[None]:
    """Raise ``FormatError`` where an answer is none: a file may have taken its reader over."""
    try:
        yield
    except (LookupError, TypeError, ValueError) as fault:
        raise FormatError(BROKEN, place=", ".join(names)) from fault


def _apart(
    folder: Path, names: Sequence[str], asked: dict[str, Any], max_bytes: int
) -> tuple[dict[str, Any], Arrays]:
    """Have files of a folder read; return what describes the arrays, and these.

    Raises
    ------
    FormatError
        If the reader found a fault, takes too much memory or time, or ended.
    """
    place = ", ".join(names)
    limits = Limits(MEMORY, max_bytes, LARGEST_FILE, SECONDS)
    try:
        answer, arrays = shared.work(
            [READER], {"names": list(names), **asked}, limits=limits, folder=folder
        )
        if "error" not in answer:
            return answer, arrays
        error = _Error.model_validate(answer["error"])
    except LateError:
        raise FormatError(f"took more than {SECONDS} s to read", place=place) from None
    except (EndedError, ValidationError) as fault:
        raise FormatError(BROKEN, place=place) from fault
    raise FormatError(**error.model_dump())


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


def _capture(others: dict[str, Any], arrays: Arrays) -> Capture:
    found: dict[str, Any] = {**arrays}
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
