"""What a file that is of no known format looks like, and what to do with it."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from fewview.errors import FormatError, in_part
from fewview.readers.headers import plain
from fewview.readers.separated import cells, table_of
from fewview.readers.sources import HDF5, NUMPY, ZIP, Source

NUMERIC = frozenset("0123456789.eE+- \t,;|")
MOST_AXES = 4  # columns of a keypoint
FEWEST_COLUMNS = 3  # of a table of keypoints
LONGEST_LINE, LONGEST_CELL = 10_000, 100  # characters that are looked at, and that are shown
_WORDS = re.compile(r"\w+")
_NAME_FIRST = re.compile(r"(?P<name>.+)(?P<between>[._ :-])(?P<word>.+)")
_WORD_FIRST = re.compile(r"(?P<word>.+)(?P<between>[._ :-])(?P<name>.+)")
_DO = "Export the detections of each camera as one of the formats of docs/files.md, or as plain CSV"
_3D = "holds 3D points; Fewview makes 3D from the 2D keypoints of each camera: give those"
_VIDEO = "a video; run a detector on it first, and give what it writes"
_IMAGE = "an image; run a detector on it first, and give what it writes"

_BEGINNINGS = {
    ZIP: f"a zip file without `keypoints.npy`; an npz needs `keypoints`. {_DO}",
    NUMPY: "an .npy array of a shape that is no keypoints, (views, frames, keypoints, 2), or one "
    f"that {_3D}",
    b"CDF": 'netCDF 3; write netCDF 4: `dataset.to_netcdf(path, engine="h5netcdf")`',
    b"RIFF": _VIDEO,
    b"\x1aE\xdf\xa3": _VIDEO,
    b"\x89PNG": _IMAGE,
    b"\xff\xd8\xff": _IMAGE,
    b"\x80": f"a pickle; only the CAM_*.pkl of the MV-NRSfM authors are read. {_DO}",
    b"PathFileType": f"a TRC file: it {_3D}",
}


def unknown(source: Source, known: Mapping[str, str]) -> FormatError:
    """Return the error of a file of no known format: what it is taken for, what would be read.

    Parameters
    ----------
    known
        Titles of the formats that are text, and words that are in their files.
    """
    begins = (hint for magic, hint in _BEGINNINGS.items() if source.begins(magic))
    if (hint := next(begins, None)) is not None:
        return FormatError(hint, place=source)
    if not source.begins(HDF5) and source.json is None and source.lines:
        return _of_text(source, known)
    if source.begins(HDF5):
        hint = _of_hdf5(set(source.hdf5))
    elif source.json is not None:
        hint = _of_json(source.json) + _nearest(_keys(source.json), known)
    elif source.head[4:8] == b"ftyp":
        hint = _VIDEO
    else:
        hint = f"not a format that is known. {_DO}" if source.head else f"an empty file. {_DO}"
    return FormatError(hint, place=source)


def _of_text(source: Source, known: Mapping[str, str]) -> FormatError:
    if source.is_toml:
        return FormatError(
            f"a TOML file, such as of a calibration, without keypoints. {_DO}", place=source
        )
    first = source.lines[0][:LONGEST_LINE]
    if NUMERIC.issuperset(source.lines[0]):
        return FormatError(
            "a table of numbers without a header; write the names of its columns above it, such as "
            "nose_x,nose_y,tail_x,tail_y",
            place=source,
        )
    table = table_of(source)
    if table is None or table.width < FEWEST_COLUMNS:
        hint = f"text that begins with {first[:60]!r}, no table of keypoints. {_DO}"
        return FormatError(hint + _nearest(_WORDS.findall(first), known), place=source)
    header = cells(first, table.separator)
    shown = ", ".join(repr(in_part(cell, LONGEST_CELL)) for cell in header[:6])
    shown += ", ..." if len(header) > 6 else ""
    nearest = _nearest([word for cell in header for word in _WORDS.findall(cell)], known)
    x, y = _templates(header) or ("{}_x", "{}_y")
    return FormatError(
        f"a table whose columns {shown} name no x and y. {_DO}{nearest}. Or name the columns' "
        "contents, {} for the keypoint",
        place=source,
        option="columns",
        remedy=f"x={x},y={y}",
    )


def _templates(header: Sequence[str]) -> tuple[str, str] | None:
    """Return what the columns of x and y may be called, where each name is of two parts.

    The part that takes fewer values is the coordinate.
    """
    possible = []
    for split, whole in (
        (_NAME_FIRST, "{{}}{between}{word}"),
        (_WORD_FIRST, "{word}{between}{{}}"),
    ):
        found = [each for cell in header if (each := split.fullmatch(cell))]
        words = list(dict.fromkeys(each["word"] for each in found))
        names = {each["name"] for each in found}
        if 2 <= len(words) <= MOST_AXES and len(words) * len(names) == len(found):
            between = found[0]["between"]
            x, y = (whole.format(between=between, word=word) for word in words[:2])
            possible.append((len(words), (x, y)))
    return min(possible)[1] if possible else None


def _nearest(words: Iterable[str], known: Mapping[str, str]) -> str:
    """Return a sentence on the format whose files have most of these words; "" if none has any."""
    present = {plain(word) for word in words}
    shared = {title: len(present & set(there.split())) for title, there in known.items()}
    title = max(shared, key=lambda each: shared[each])
    return f". Of what is read, {title} is nearest" if shared[title] else ""


def _keys(content: Any, depth: int = 4) -> Iterator[str]:
    """Yield the keys of the first dictionaries in JSON."""
    if isinstance(content, dict):
        yield from map(str, content)
    inside = list(content.values()) if isinstance(content, dict) else content
    if isinstance(inside, list) and depth:
        for one in inside[:3]:
            yield from _keys(one, depth - 1)


def _of_hdf5(names: set[str]) -> str:
    if names == {"tracks"}:
        return f"HDF5 of SLEAP-Anipose: it {_3D}"
    shown = _shown(sorted(names))
    return f"HDF5 that holds {shown}, not of DeepLabCut, Anipose, SLEAP, NWB or movement. {_DO}"


def _shown(names: Sequence[str]) -> str:
    return ", ".join(in_part(str(name), LONGEST_CELL) for name in names[:6]) or "nothing"


def _of_json(content: Any) -> str:
    if isinstance(content, dict):
        return f"JSON with {_shown(list(content))}, no known layout of keypoints. {_DO}"
    if content and isinstance(content[0], dict) and "bbox" in content[0]:
        return "JSON of boxes without keypoints; a pose estimator must follow the detector"
    return f"a JSON list, no known layout of keypoints. {_DO}"
