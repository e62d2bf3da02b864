"""The process that reads untrusted files, confined to their folder; `reading_apart` starts it.

One is started for each upload, so this module loads little: what reads, and nothing of HTTP.
"""

import codecs
import json
import os
import sys
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from fewview.calibration import FORMATS as CALIBRATIONS
from fewview.errors import FormatError, in_part
from fewview.readers.budget import unpacking
from fewview.reading_options import ReadingOptions

from service.wire.children import limit
from service.wire.confinement import confine
from worker.process import die_with_parent

# What readers load, and encodings: those of texts, of names in zip files, of JSON.
READERS = (
    "h5py",
    "numpy.ma",
    "yaml",
    "fewview.readers.reading",
    *(f"fewview.calibration.{known.module}" for known in CALIBRATIONS),
)
ENCODINGS = ("ascii", "latin-1", "cp437", "cp1252", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be",
             "utf-32", "utf-32-le", "utf-32-be")  # fmt: skip
MEMORY = 3 * 2**30  # bytes of addresses, what Python and its libraries take among them
SECONDS = 120
LARGEST_FILE = 2**30  # bytes that it writes: of an archive's file, of an array
# What the child writes into the folder: the capture and what describes it, or the error, and a log.
FOLDERS = "folders"  # within OUT: where folders are laid out
OUT, CAPTURE, OTHERS, ERROR, LOG = "out", "capture.npz", "others.json", "error.json", "log"
LONGEST_OTHERS = 2**24  # bytes
# What is sent of notes and of names of views.
MOST_NOTES, LONGEST_NOTE, LONGEST_NAME = 100, 1000, 100


class Unpacking(NamedTuple):
    """How many bytes files may unpack to, together, and what sets that bound, in words."""

    most: int
    bound: str


def main() -> None:
    """Read the files that standard input names into the folder ``out``.

    Exit status 1: it holds the error instead, as data.
    """
    asked = json.loads(sys.stdin.buffer.read())
    die_with_parent(asked.pop("parent"))
    limit(MEMORY, SECONDS, LARGEST_FILE)
    out = os.open(OUT, os.O_RDONLY | os.O_DIRECTORY)  # wherever this process then works
    try:
        if "views" in asked:
            _read_cameras(**asked)
        else:
            options, unpack = ReadingOptions(**asked.pop("options")), asked.pop("unpack")
            _read(options, Unpacking(*unpack), **asked)
    except FormatError as error:
        _fail(error, out)
    except MemoryError:
        place = ", ".join(asked["names"])
        _fail(FormatError("need more memory than there is; part them", place=place), out)


def _fail(error: FormatError, out: int) -> NoReturn:
    found = {name: getattr(error, name) for name in ("problem", "place", "option", "remedy")}
    with os.fdopen(os.open(ERROR, os.O_WRONLY | os.O_CREAT, 0o600, dir_fd=out), "w") as file:
        json.dump(found, file)
    sys.exit(1)


def _load_readers() -> None:
    """Load what is needed, within the limits, and before no module can be opened any more."""
    for name in READERS:
        import_module(name)
    for encoding in ENCODINGS:
        codecs.lookup(encoding)


def _read_cameras(names: list[str], views: list[str]) -> None:
    _load_readers()
    from fewview.readers.calibrations import calibrations_at, of_views  # noqa: PLC0415

    confine(Path())
    notes: list[str] = []
    _, found = of_views(calibrations_at(map(Path, names), notes), views, None, notes)
    if found is None:
        known = "TOML of Anipose, Pose2Sim, FreeMoCap or caliscope, YAML or JSON of OpenCV"
        reason = "; ".join(notes) or f"no calibration that is known: {known}"
        raise FormatError(reason, place=", ".join(names))
    _write_others(Path(OUT), {"calibration": asdict(found), "notes": notes})


def _read(
    options: ReadingOptions,
    unpack: Unpacking,
    names: list[str],
    max_bytes: int,
    *,
    holds_folders: bool,
    with_people: bool,
) -> None:
    _load_readers()
    from fewview.readers.archives import laid_out  # noqa: PLC0415
    from fewview.readers.reading import read_with  # noqa: PLC0415

    confine(Path())
    out = Path(OUT).absolute()
    with unpacking(*unpack):
        if holds_folders:
            (zipped,), inside = names, out / FOLDERS
            inside.mkdir()
            os.chdir(inside)  # so that messages have the names that files have for who sent them
            names = laid_out(out.parent / zipped, Path())
        capture = read_with(names, replace(options, untrusted=True), with_people=with_people)
    arrays = {
        name: array
        for name in ("keypoints", "confidence", "points3d", "times")
        if (array := getattr(capture, name)) is not None
    }
    size = sum(array.nbytes for array in arrays.values())
    if size > max_bytes:
        raise FormatError(
            f"make {capture.frames:,} frames of {capture.views} views, {size:,} bytes, more than "
            f"the {max_bytes:,} that are taken at a time; send them in parts",
            place=", ".join(names),
        )
    np.savez(out / CAPTURE, allow_pickle=False, **arrays)
    others = {
        "keypoint_names": capture.keypoint_names,
        "edges": capture.edges,
        "view_names": [in_part(name, LONGEST_NAME) for name in capture.view_names or ()] or None,
        "image_sizes": capture.image_sizes,
        "fps": capture.fps,
        "notes": capture.notes,
        "calibration": capture.calibration and asdict(capture.calibration),
        "people": capture.people and [asdict(view) for view in capture.people],
    }
    _write_others(out, others)


def _write_others(out: Path, others: dict[str, Any]) -> None:
    """Write what describes arrays; of notes, so many and so much as anybody reads."""
    notes = [in_part(note, LONGEST_NOTE) for note in others["notes"][:MOST_NOTES]]
    text = json.dumps({**others, "notes": notes}, default=np.ndarray.tolist)
    (out / OTHERS).write_text(text)
