"""Files as detectors write them, one for each camera, as the arrays of a capture."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, NamedTuple

from fewview.errors import FormatError
from fewview.readers.registry import NAMES
from fewview.readers.skeletons import NAMED
from fewview.reading_options import ReadingOptions
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from service.http.errors import ApiError, from_validation, invalid
from service.http.uploads import Upload
from service.http.zips import ZIP_FAULTS, ZIP_MAGIC, TooManyMembersError, members_of
from service.settings import Settings
from service.wire.arrays import Arrays
from service.wire.calibrations import CaptureCalibration, checked_calibration
from service.wire.people import ViewPeoplePreview
from service.wire.reading_apart import Unpacking, cameras_apart, read_apart

LONGEST_NAME = 100  # bytes of a file's name, characters of a camera's that is named after it
# What files may unpack to: so many times their size, or this. Tables and JSON shrink to a tenth in
# a zip, tracks in HDF5 that are mostly gaps to a fiftieth.
UNPACKED_TIMES, UNPACKED_SMALL = 64, 64 * 1024 * 1024
LONGEST_TEXT = 1000  # characters of a field
# Options that have another name in the form, or take another remedy there.
FIELDS = {"image_size": "image_sizes", "columns": "table_columns"}
OF_FORM = {"image_size": "image_sizes for each view, such as [[1920, 1080], [1280, 720]]"}
_ODD = re.compile(r"[^\w.() +-]")  # in a file's name


def _one_of(*known: str) -> AfterValidator:
    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"expected one of {', '.join(known)}, got {name[:LONGEST_NAME]!r}")
        return name

    return AfterValidator(check)


class DetectorReading(BaseModel):
    """How detectors' files are to be read."""

    model_config = ConfigDict(extra="forbid")

    format: Annotated[str, _one_of(*NAMES)] = Field(
        "", description="Of `files`: the name of their format; found out if not given."
    )
    person: str = Field(
        "auto",
        description="Of `files` with several people: `auto`, a number (0 is seen most), the name "
        "of a track, or one for each camera, such as `0,1,0`.",
    )
    min_confidence: float = Field(
        0.0, ge=0, le=1, description="Of `files`: detections that are less sure are gaps."
    )
    align: Literal["auto", "index", "time"] = Field(
        "auto",
        description="Of `files`: whether frames of the same number (`index`) or of the nearest "
        "`time` belong together; `auto`: by time where the cameras' rates or times differ.",
    )
    table_columns: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="Of `files`: the contents of a table's columns, if their names are unusual, "
        "such as `x={}_x,y={}_y,frame=No`.",
    )
    cameras: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="Of `files`: which views are wanted, in their order, such as `cam1,cam2`.",
    )
    trial: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="The trial or detector to read, where `files` are of several.",
    )
    y: Literal["down", "up"] = Field(
        "down", description="Of `files`: `up` where y counts from the lower edge of the image."
    )
    mirror: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="Of `files`: which views show mirror images, such as `cam2`; `none` if none"
        " does. Not given: those whose names are a mirror's.",
    )
    offset: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="Of `files`: the corner of a crop in the whole image, from which keypoints"
        " count, such as `cam2=560,180`, or `560,180` of all views.",
    )
    offset_seconds: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="Of `files`: by how much views show every moment later than the others, such"
        " as `cam2=4.2`; negative where earlier. Files without times need `fps`.",
    )
    views_in_names: str = Field(
        "",
        max_length=LONGEST_TEXT,
        description="Of `files`: words of the cameras that keypoints' names begin or end with, such"
        " as `real,mirror`; found out if not given, `none` if there are none.",
    )
    skeleton_name: str = Field(
        "", description=f"Of `files`: names the keypoints: {', '.join(NAMED)}."
    )


class ReadFiles(NamedTuple):
    """The result of reading files: arrays, fields that describe them, and notes for the user.

    `people` are those whom each view shows, if it was asked for and any shows several.
    """

    arrays: Arrays
    fields: dict[str, Any]
    notes: list[str]
    people: list[ViewPeoplePreview] | None = None


def asked_of(upload: Upload) -> tuple[dict[str, str], Upload]:
    """Part a form's text fields into those on reading, and the upload with the others."""
    others = dict(upload.fields)
    asked = {name: others.pop(name) for name in DetectorReading.model_fields if name in others}
    if not others.get("skeleton", "{").lstrip().startswith("{"):  # a name, and no skeleton in JSON
        asked.setdefault("skeleton_name", others.pop("skeleton"))
    return asked, replace(upload, fields=others)


def holds_arrays(upload: Upload) -> bool:
    """Whether a form's one file is of arrays, or should be: safetensors, or a zip of arrays."""
    if len(upload.files) > 1 or any(file.holds_folders for file in upload.files):
        return False
    data = upload.data
    if not data.startswith(ZIP_MAGIC):
        return data[8:9] == b"{" and int.from_bytes(data[:8], "little") < len(data)
    try:
        return all(member.filename.endswith(".npy") for member in members_of(data))
    except TooManyMembersError:
        return False
    except ZIP_FAULTS:
        return True


def read_files(
    upload: Upload,
    asked: dict[str, str],
    settings: Settings,
    *,
    fps: float | None,
    image_sizes: Sequence[Sequence[int] | None] | None,
    with_people: bool = False,
    may_keep: int | None = None,
) -> ReadFiles:
    """Read the uploaded files in a separate process.

    Parameters
    ----------
    asked
        Fields of `DetectorReading`, as text.
    fps
        Frames per second, if the files have no times.
    image_sizes
        (width, height) in pixels of each view, None where unknown.
    with_people
        Whether to look whom each view shows.
    may_keep
        Bytes that who sends them may still keep, if that is bounded: they unpack to no more.

    Raises
    ------
    ApiError
        422 if an option is invalid, a file cannot be read, or files do not fit together.
    """
    try:
        form = DetectorReading.model_validate(asked)
    except ValidationError as error:
        raise from_validation(error, DetectorReading) from error
    try:
        options = ReadingOptions(
            format=form.format or None,
            person=form.person,
            min_confidence=form.min_confidence,
            skeleton=form.skeleton_name or None,
            align=form.align,
            fps=fps,
            image_size=[None if s is None else (s[0], s[1]) for s in image_sizes or ()] or None,
            columns=form.table_columns or None,
            cameras=form.cameras or None,
            trial=form.trial or None,
            y=form.y,
            mirror=form.mirror or None,
            offset=form.offset or None,
            offset_seconds=form.offset_seconds or None,
            views_in_names=form.views_in_names or None,
        )
        with TemporaryDirectory(prefix="fewview-") as folder:
            found = read_apart(
                Path(folder),
                _written(upload, Path(folder)),
                options,
                max_bytes=settings.max_body_bytes,
                holds_folders=upload.files[0].holds_folders,
                with_people=with_people,
                unpack=_unpacking(upload, settings, may_keep),
            )
    except FormatError as error:
        raise _at_field(error) from error
    arrays = {
        name: array
        for name in ("keypoints", "confidence", "points3d", "times")
        if (array := getattr(found, name)) is not None
    }
    fields: dict[str, Any] = {
        "fps": found.fps,
        "view_names": list(found.view_names or ()),
    }
    if found.keypoint_names is not None or found.edges is not None:
        fields["skeleton"] = {"keypoint_names": found.keypoint_names, "edges": found.edges or ()}
    if found.image_sizes is not None:
        fields["image_sizes"] = found.image_sizes
    notes = list(found.notes)
    if found.calibration is not None:
        fields["calibration"] = checked_calibration(found.calibration, notes)
    people = [ViewPeoplePreview.of(view) for view in found.people or ()]
    return ReadFiles(arrays, fields, notes, people or None)


def read_calibration(upload: Upload, views: Sequence[str]) -> tuple[CaptureCalibration, list[str]]:
    """Read a calibration, of one file or of one for each camera, in a separate process.

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
    ApiError
        422 if it cannot be read, or does not fit the views.
    """
    try:
        with TemporaryDirectory(prefix="fewview-") as folder:
            found, notes = cameras_apart(Path(folder), _written(upload, Path(folder)), views)
    except FormatError as error:
        raise _at_field(error) from error
    known = checked_calibration(found, notes)
    if known is None:
        raise invalid("/files", notes[-1])
    return CaptureCalibration.model_validate(known), notes


def _written(upload: Upload, folder: Path) -> list[str]:
    """Write an upload's files into a folder; return their names there."""
    names: list[str] = []
    for file in upload.files:
        names.append(_name(file.name, names))
        (folder / names[-1]).write_bytes(file.data)
    return names


def _unpacking(upload: Upload, settings: Settings, may_keep: int | None) -> Unpacking:
    """Return what the files of a request may unpack to, together."""
    sent = sum(len(file.data) for file in upload.files)
    by_size = max(UNPACKED_SMALL, UNPACKED_TIMES * sent)
    most, name = settings.max_unpacked_bytes, "FEWVIEW_MAX_UNPACKED_BYTES"
    bounds = [
        Unpacking(most, f"the {most:,} bytes of {name}"),
        Unpacking(
            by_size, f"{by_size:,} bytes, which files of this size may ({name} bounds the largest)"
        ),
    ]
    if may_keep is not None:
        bounds.append(Unpacking(may_keep, f"the {may_keep:,} bytes that this key may still keep"))
    return min(bounds)


def _at_field(error: FormatError) -> ApiError:
    """Return the error with the form's field that is wrong, and the remedy as the form has it."""
    option = error.option or "files"
    field = FIELDS.get(option, option)
    given = OF_FORM.get(option, f"{field}={error.remedy!r}")
    return invalid(f"/{field}", error.worded("", given))


def _name(given: str, taken: list[str]) -> str:
    """Return a file's name without a folder, and without what a name should not have."""
    last = given.replace("\\", "/").rpartition("/")[2][-LONGEST_NAME:]
    plain = _ODD.sub("_", last).lstrip(". ")
    plain = plain.encode()[-LONGEST_NAME:].decode(errors="ignore") or "file"
    numbered = (f"{number}_{plain}" for number in count(1))
    return next(name for name in chain([plain], numbered) if name not in taken)
