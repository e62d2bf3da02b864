"""What there is to read at some paths: files, folders of frames, folders of cameras, zip files."""

import re
from collections.abc import Container, Iterable, Sequence
from os import PathLike
from pathlib import Path

from fewview.errors import FormatError
from fewview.readers.archives import is_archive, unpacked
from fewview.readers.file_names import natural
from fewview.readers.registry import FORMATS, Format, detect, find
from fewview.readers.sources import Source, frames_among, frames_in
from fewview.readers.trials import names_of_paths, of_one_trial

Found = tuple[Source, Format]
AnyPath = str | PathLike[str]
DEPTH = 4  # of folders in folders
MOST_CAMERAS = 64  # files beyond so many are no cameras
FILTERED = re.compile(r"[_-]filtered(?=[./\\]|$)")


def paths_at(paths: AnyPath | Iterable[AnyPath], folder: Path) -> list[Path]:
    """Return the files and folders that are given; zip files are unpacked into an empty folder.

    Raises
    ------
    FormatError
        If there is none, or a zip file cannot be read.
    """
    listed = [paths] if isinstance(paths, str | PathLike) else list(paths)
    if not listed:
        raise FormatError("no files were given")
    return [
        unpacked(path, folder / str(number)) if is_archive(path) else path
        for number, path in enumerate(map(Path, listed))
    ]


def sources_at(
    paths: Sequence[Path],
    name: str | None,
    notes: list[str],
    *,
    others: Container[Path] = (),
    trial: str | None = None,
) -> list[Found]:
    """Return what there is to read at the paths, a format each.

    Parameters
    ----------
    name
        Of the format; None to find it out.
    notes
        Gets what was left out.
    others
        Files and folders that hold no keypoints.
    trial
        Whose files are meant, where they are of several.

    Raises
    ------
    FormatError
        If there is nothing of a known format, or the files are of several trials.
    """
    given = [path for path in paths if path not in others]
    if not given:
        raise FormatError("there are cameras of a calibration, and no keypoints: give those, too")
    found = _frames_one_by_one(given, name)
    for path in [] if found else given:
        if path.is_dir():
            inside = _in_folder(path, name, notes, DEPTH, others)
            if not inside:
                raise _nothing_in(path)
            found += _newest(inside, path, notes)
        elif path.exists():
            source = Source(path)
            found.append((source, find(source, name)))
        else:
            raise FormatError("there is no such file or folder", place=path)
    names = names_of_paths([each.path for each, _ in found], [each.name for each, _ in found])
    mine, called, note = of_one_trial(names, trial)
    notes += filter(None, [note])
    for index, camera in zip(mine, called, strict=True):
        found[index][0].name = camera
    return [found[index] for index in mine]


def _frames_one_by_one(paths: Sequence[Path], name: str | None) -> list[Found]:
    """Return the cameras whose frames are listed file by file; none unless these are so many."""
    if len(paths) <= MOST_CAMERAS or not all(path.is_file() for path in paths):
        return []
    return [(source, find(source, name)) for source in frames_among(paths, paths[0].parent)]


def _in_folder(
    folder: Path, name: str | None, notes: list[str], depth: int, others: Container[Path]
) -> list[Found]:
    """Return what a folder holds: frames, files of cameras, or folders of these."""
    cameras = frames_in(folder, others)
    if cameras:
        return [(source, find(source, name)) for source in cameras]
    inside = sorted(
        (path for path in folder.iterdir() if not path.name.startswith(".") and path not in others),
        key=lambda path: natural(path.name),
    )
    found: list[Found] = []
    unknown: list[Source] = []
    for path in inside:
        if path.is_file():
            source = Source(path)
            kind = _quietly(source)
            if kind is None:
                unknown.append(source)
            elif name in (None, kind.name):
                found.append((source, kind))
    if name and not found:  # none looks like it, so those may be that look like nothing
        found = [(source, find(source, name)) for source in unknown]
        unknown = []
    if not found and depth > 1:
        for path in inside:
            if path.is_dir():
                found += _in_folder(path, name, notes, depth - 1, others)
        return found
    if found and unknown:
        shown = ", ".join(source.path.name for source in unknown[:5]) + (
            ", ..." if len(unknown) > 5 else ""
        )
        notes.append(f"{folder.name}: not read, of no known format: {shown}")
    return _one_of_each(found, folder, notes)


def _nothing_in(folder: Path) -> FormatError:
    """Return the error of a folder without a file that can be read: what the first looks like."""
    nothing = "a folder with no file of a known format"
    files = sorted((path for path in folder.iterdir() if path.is_file()), key=natural)
    files = [path for path in files if not path.name.startswith(".")]
    if not files:
        return FormatError(nothing, place=folder)
    name = files[0].name
    try:
        found = find(Source(files[0]), None)
    except FormatError as error:
        problem = f"{nothing}; {name}: {error.problem}"
        return FormatError(problem, place=folder, option=error.option, remedy=error.remedy)
    return FormatError(f"{nothing}; {name} looks like {found.title}", place=folder)


def _newest(found: list[Found], folder: Path, notes: list[str]) -> list[Found]:
    """Leave out what lies there filtered, too, as DeepLabCut and Anipose write it beside it."""
    paths = [str(source.path.relative_to(folder)) for source, _ in found]
    done = {FILTERED.sub("", path): path for path in paths if FILTERED.search(path)}
    kept = []
    for path, each in zip(paths, found, strict=True):
        other = done.get(path, path)
        if other == path or each[0].frames:
            kept.append(each)
        else:
            notes.append(f"{path} was left out for {other}")
    return kept


def _quietly(source: Source) -> Format | None:
    """Return the format of a file from its content; None also if the file is broken."""
    try:
        return detect(source)
    except FormatError:
        return None


def _one_of_each(found: list[Found], folder: Path, notes: list[str]) -> list[Found]:
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
            f"holds files of several formats ({', '.join(names)}); list those of the "
            "cameras one by one",
            place=folder,
        )
    return sorted(kept.values(), key=lambda each: natural(each[0].path.name))
