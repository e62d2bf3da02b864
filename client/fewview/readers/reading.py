"""From paths to a capture."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from fewview.capture import Capture
from fewview.errors import FormatError
from fewview.readers.combining import Align, cleaned, combined
from fewview.readers.names import natural, told_apart
from fewview.readers.people import Person, pick
from fewview.readers.registry import FORMATS, Format, detect, find, views_of
from fewview.readers.sources import Source, frames_in
from fewview.readers.views import View

AnyPath = str | PathLike[str]
Size = tuple[int, int]
DEPTH = 3  # of folders in folders


def read(
    paths: AnyPath | Iterable[AnyPath],
    *,
    format: str | None = None,
    person: Person = "auto",
    min_confidence: float = 0.0,
    skeleton: str | None = None,
    align: Align = "index",
    fps: float | None = None,
    image_size: Size | Sequence[Size] | None = None,
) -> Capture:
    """Read the 2D keypoints of all cameras.

    Parameters
    ----------
    paths
        A file, a folder, or a file or folder for each camera.
    format
        Name of the format (`fewview.readers.registry.NAMES`); None to find out from the content.
    person
        Of several people or animals: "auto" for the one that is seen most, followed over time; a
        number for a place in the file's lists; a name for a track or individual.
    min_confidence
        Detections that are less sure are gaps.
    skeleton
        Name of a skeleton (`fewview.readers.skeletons.SKELETONS`) that gives the keypoints their
        names and edges; None for what the file says, or its count of keypoints.
    align
        "index": frames of the same number belong together. "time": frames of the nearest time.
    fps
        Frames per second, where a file tells no times.
    image_size
        (width, height) in pixels of all views, or of each.

    Returns
    -------
    Capture
        Its `notes` say what was understood, left out and changed.

    Raises
    ------
    FormatError
        If a file is of no known format, or the files do not fit together; the message says what
        it looks like and what to do.
    """
    if not 0 <= min_confidence <= 1:
        raise FormatError(f"min_confidence is {min_confidence}, not in [0, 1]")
    if align not in ("index", "time"):
        raise FormatError(f"align is {align!r}, neither 'index' nor 'time'")
    if fps is not None and not 0 < fps < np.inf:
        raise FormatError(f"fps is {fps}, not above 0")
    notes: list[str] = []
    views: list[View] = []
    kinds: Counter[str] = Counter()
    for source, kind in _sources(paths, format, notes):
        found = views_of(source, kind)
        views += found
        kinds[kind.title] += len(found)
    titles = ", ".join(f"{title} ({count} cameras)" for title, count in kinds.items())
    notes.insert(0, f"read as {titles}" if len(kinds) > 1 else f"read as {next(iter(kinds))}")
    names = told_apart([view.name for view in views])
    views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
    views = _sized(views, image_size)
    clean: list[View] = []
    for view in views:
        one, said = cleaned(view, min_confidence)
        clean.append(one)
        notes += said
    picked, said = pick(clean, person)
    capture = combined(picked, align=align, fps=fps, skeleton=skeleton)
    return replace(capture, notes=(*notes, *said, *capture.notes))


def _sources(
    paths: AnyPath | Iterable[AnyPath], name: str | None, notes: list[str]
) -> list[tuple[Source, Format]]:
    """Return what there is to read at the paths, a format each."""
    listed = [paths] if isinstance(paths, str | PathLike) else list(paths)
    if not listed:
        raise FormatError("no files were given")
    found: list[tuple[Source, Format]] = []
    for path in map(Path, listed):
        if path.is_dir():
            inside = _in_folder(path, name, notes, DEPTH)
            if not inside:
                raise FormatError(f"{path}: a folder with no file of a known format")
            found += inside
        elif path.exists():
            source = Source(path)
            found.append((source, find(source, name)))
        else:
            raise FormatError(f"{path}: there is no such file or folder")
    return found


def _in_folder(
    folder: Path, name: str | None, notes: list[str], depth: int
) -> list[tuple[Source, Format]]:
    """Return what a folder holds: frames, files of cameras, or folders of these."""
    cameras = frames_in(folder)
    if cameras:
        return [(source, find(source, name)) for source in cameras]
    inside = sorted(
        (path for path in folder.iterdir() if not path.name.startswith(".")),
        key=lambda path: natural(path.name),
    )
    found: list[tuple[Source, Format]] = []
    unknown = []
    for path in inside:
        if path.is_file():
            source = Source(path)
            kind = find(source, name) if name else _quietly(source)
            if kind is None:
                unknown.append(path.name)
            else:
                found.append((source, kind))
    if not found and depth > 1:
        for path in inside:
            if path.is_dir():
                found += _in_folder(path, name, notes, depth - 1)
        return found
    if found and unknown:
        shown = ", ".join(unknown[:5]) + (", ..." if len(unknown) > 5 else "")
        notes.append(f"{folder.name}: not read, of no known format: {shown}")
    return _one_of_each(found, folder, notes)


def _quietly(source: Source) -> Format | None:
    """Return the format of a file that nobody named; None also where it is broken."""
    try:
        return detect(source)
    except FormatError:
        return None


def _one_of_each(
    found: list[tuple[Source, Format]], folder: Path, notes: list[str]
) -> list[tuple[Source, Format]]:
    """Keep one file where a detector writes the same in two formats.

    Raises
    ------
    FormatError
        If files of several formats remain, and it is not clear which are meant.
    """
    order = [each.name for each in FORMATS]
    kept: dict[str, tuple[Source, Format]] = {}
    for source, kind in sorted(found, key=lambda each: order.index(each[1].name)):
        first = kept.setdefault(source.name, (source, kind))
        if first[0] is not source and first[1].name == kind.name:
            kept[source.path.name] = (source, kind)
        elif first[0] is not source:
            notes.append(f"{source.path.name} was left out for {first[0].path.name}")
    names = sorted({kind.name for _, kind in kept.values()})
    if len(names) > 1:
        raise FormatError(
            f"{folder}: holds files of several formats ({', '.join(names)}); list those of the "
            "cameras one by one"
        )
    return sorted(kept.values(), key=lambda each: natural(each[0].path.name))


def _sized(views: list[View], asked: Size | Sequence[Size] | None) -> list[View]:
    """Return the views with the image sizes that were told, and with coordinates in pixels."""
    sizes: list[Size | None] = [view.image_size for view in views]
    if asked is not None:
        told = np.array(asked)
        if told.shape not in ((2,), (len(views), 2)) or not (told > 0).all():
            raise FormatError(
                f"image_size is {asked!r}, not (width, height), nor {len(views)} of these"
            )
        sizes = [(int(w), int(h)) for w, h in np.broadcast_to(told, (len(views), 2))]
    out = []
    for view, size in zip(views, sizes, strict=True):
        keypoints = view.keypoints
        if view.shares:
            if size is None:
                raise FormatError(
                    f"{view.name}: coordinates are shares of the image's width and height, and its "
                    "size is not in the file; say image_size=(width, height)"
                )
            keypoints = keypoints * np.array(size, np.float32)
        out.append(replace(view, keypoints=keypoints, image_size=size))
    return out
