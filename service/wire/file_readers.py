"""Reading untrusted files in a process of `sandbox`, confined to their folder.

`reading_apart` asks for it. This module loads what reads, and nothing of HTTP, before a file is
seen: behind a root of its own there are no modules.
"""

import codecs
import gc
import os
import tempfile
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from fewview.calibration import FORMATS as CALIBRATIONS
from fewview.errors import FormatError, in_part
from fewview.readers.archives import laid_out
from fewview.readers.budget import unpacking
from fewview.readers.calibrations import calibrations_at, of_views
from fewview.readers.reading import read_with
from fewview.reading_options import ReadingOptions

from service.wire.arrays import Arrays

Answer = tuple[dict[str, Any], Arrays]

# What readers load, and encodings: those of texts, of names in zip files, of JSON.
READERS = (
    "h5py",
    "numpy.ma",
    "yaml",
    *(f"fewview.calibration.{known.module}" for known in CALIBRATIONS),
)
ENCODINGS = ("ascii", "latin-1", "cp437", "cp1252", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be",
             "utf-32", "utf-32-le", "utf-32-be")  # fmt: skip
for _name in READERS:
    import_module(_name)
for _name in ENCODINGS:
    codecs.lookup(_name)
# What is sent of notes and of names of views.
MOST_NOTES, LONGEST_NOTE, LONGEST_NAME = 100, 1000, 100


def work(asked: dict[str, Any], _data: bytearray) -> Answer:
    """Read files in the working directory, as `reading_apart` asks.

    Returns
    -------
    tuple
        What describes the arrays, and these; or an ``error`` as data.
    """
    gc.enable()
    try:
        return _read_cameras(**asked) if "views" in asked else _read(**asked)
    except FormatError as error:
        found = error
    except MemoryError:
        place = ", ".join(asked["names"])
        found = FormatError("need more memory than there is; part them", place=place)
    parts = ("problem", "place", "option", "remedy")
    return {"error": {part: getattr(found, part) for part in parts}}, {}


def _read_cameras(names: list[str], views: list[str]) -> Answer:
    notes: list[str] = []
    _, found = of_views(calibrations_at(map(Path, names), notes), views, None, notes)
    if found is None:
        known = "TOML of Anipose, Pose2Sim, FreeMoCap or caliscope, YAML or JSON of OpenCV"
        reason = "; ".join(notes) or f"no calibration that is known: {known}"
        raise FormatError(reason, place=", ".join(names))
    return {"calibration": asdict(found), "notes": _in_part(notes)}, {}


def _read(
    options: dict[str, Any],
    unpack: tuple[int, str],
    names: list[str],
    max_bytes: int,
    *,
    holds_folders: bool,
    with_people: bool,
) -> Answer:
    with unpacking(*unpack):
        if holds_folders:
            zipped = Path(names[0]).absolute()
            os.chdir(tempfile.mkdtemp())  # so that messages have the names that the sender gave
            names = laid_out(zipped, Path())
        reading = replace(ReadingOptions(**options), untrusted=True)
        capture = read_with(names, reading, with_people=with_people)
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
    others = {
        "keypoint_names": capture.keypoint_names,
        "edges": capture.edges,
        "view_names": [in_part(name, LONGEST_NAME) for name in capture.view_names or ()] or None,
        "image_sizes": capture.image_sizes,
        "fps": capture.fps,
        "notes": _in_part(capture.notes),
        "calibration": capture.calibration and asdict(capture.calibration),
        "people": capture.people and [asdict(view) for view in capture.people],
    }
    return others, {name: np.asarray(array) for name, array in arrays.items()}


def _in_part(notes: "list[str] | tuple[str, ...]") -> list[str]:
    """Return so many notes, and so much of each, as anybody reads."""
    return [in_part(note, LONGEST_NOTE) for note in notes[:MOST_NOTES]]
