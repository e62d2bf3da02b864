"""Zip files of what a detector wrote into folders."""

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from fewview.errors import FormatError
from fewview.readers.budget import take
from fewview.readers.file_names import natural
from fewview.readers.sources import ZIP, Source

MAX_UNPACKED = 2**30  # bytes
MAX_MEMBERS = 200_000  # files
WORKBOOK = "xl/workbook.xml"
MAX_DEPTH = 32  # of folders in folders
NAMED = "named"  # the folder of what was unpacked, under its own name


@contextmanager
def workplace() -> Iterator[Path]:
    """Give a folder to unpack into, that is gone afterwards; errors leave it out."""
    with TemporaryDirectory(prefix="fewview-") as folder:
        try:
            yield Path(folder)
        except FormatError as error:
            raise FormatError(
                error.problem.replace(f"{folder}/", ""),  # libraries' messages name it
                place=_within(error.place, Path(folder)),
                option=error.option,
                remedy=error.remedy,
            ) from error


def _within(place: str, folder: Path) -> str:
    """Return a place without the folder that it was unpacked into, if it was."""
    if not place.startswith(f"{folder}/"):
        return place
    number_and_named = 2
    return str(Path(*Path(place).relative_to(folder).parts[number_and_named:]))


def is_archive(path: Path) -> bool:
    """Whether this is a zip file, and not an npz with `keypoints`.

    Raises
    ------
    FormatError
        If it is one that is broken, or a workbook.
    """
    if not path.is_file() or not Source(path).begins(ZIP):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        if WORKBOOK in names:
            raise FormatError("an Excel workbook; save the sheet of each camera as CSV", place=path)
        return "keypoints.npy" not in names
    except FormatError:
        raise
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile) as error:
        raise FormatError(
            f"a zip file or npz that is broken ({_cause(error)})", place=path
        ) from error


def unpacked(path: Path, folder: Path) -> Path:
    """Unpack a zip file and return the folder of what is in it, which has the zip's name.

    Folders that hold nothing but a folder are gone through; what computers hide is left out.

    Raises
    ------
    FormatError
        If it is broken or encrypted, unpacks to too much, or holds files outside it.
    """
    named = folder / NAMED / (path.name.partition(".")[0] or "zip")
    named.mkdir(parents=True)
    _unpack(path, named, without_common=True)
    return named


def laid_out(path: Path, folder: Path) -> list[str]:
    """Unpack a zip file into an empty folder, as it is; return the names of what lies there.

    Raises
    ------
    FormatError
        As for `unpacked`, and if there is nothing.
    """
    _unpack(path, folder, without_common=False)
    names = sorted((inside.name for inside in folder.iterdir()), key=natural)
    if not names:
        raise FormatError("the folders hold no files")
    return names


def _unpack(path: Path, folder: Path, *, without_common: bool) -> None:
    """Unpack a zip file into a folder, which gets no file that a computer hides."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = [each for each in archive.infolist() if _is_file(each)]
            size = sum(each.file_size for each in members)
            if size > MAX_UNPACKED or len(members) > MAX_MEMBERS:
                raise FormatError(
                    f"unpacks to {len(members):,} files of {size / 2**20:,.0f} MiB, more "
                    f"than the {MAX_MEMBERS:,} files and {MAX_UNPACKED / 2**20:,.0f} MiB that are "
                    "read of a zip file; part it",
                    place=path,
                )
            if max((member.filename.count("/") for member in members), default=0) > MAX_DEPTH:
                raise FormatError(
                    f"has more than {MAX_DEPTH} folders within each other", place=path
                )
            take(size, path)
            if without_common:
                _without_common_folders(members)
            for member in members:
                archive.extract(member, folder)
    except (
        zipfile.BadZipFile,
        zlib.error,
        lzma.LZMAError,
        struct.error,
        EOFError,
        OSError,
        RuntimeError,  # encrypted members
        NotImplementedError,  # kinds of compression
        ValueError,
    ) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(
            f"a zip file that cannot be read ({_cause(error)})", place=path
        ) from error


def _without_common_folders(members: list[zipfile.ZipInfo]) -> None:
    """Take the folders that all files are in away from their names."""
    places = [PurePosixPath(member.filename).parts for member in members]
    levels = zip(*{place[:-1] for place in places}, strict=False)  # as deep as the least deep
    common = sum(1 for _ in takewhile(lambda level: len(set(level)) == 1, levels))
    for member, place in zip(members, places, strict=True):
        member.filename = "/".join(place[common:])


def _is_file(member: zipfile.ZipInfo) -> bool:
    parts = PurePosixPath(member.filename).parts
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in parts)
    return not member.is_dir() and not hidden


def _cause(error: Exception) -> str:
    """Return what went wrong, without the path of a folder that was unpacked into."""
    return (isinstance(error, OSError) and error.strerror) or str(error)
