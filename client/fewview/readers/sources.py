"""What is at a path: a file, or the files of one camera's frames; looked into once, with bounds."""

import json
import re
from collections.abc import Container, Iterator, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from fewview.errors import FormatError
from fewview.readers import hdf5
from fewview.readers.file_names import frame_number, natural
from fewview.readers.json_frames import is_one_frame, people_of
from fewview.readers.text import HEAD, WESTERN, encoding_of, lines_of

MAX_JSON = 2**29  # bytes: parsed it takes several times as much
MAX_TEXT = 2**31
MAX_FRAME = 2**24  # of the file of one frame
MAX_FRAMES = 2**20
FIRST_LINES = 12
MAX_LINE = 2**16  # bytes of a person
FEWEST_NUMBERS = 9  # of a person: class, box, two keypoints
LOOKED_INTO = 1000  # files of a folder, of which the first may show no person
# Of a project's videos SLEAP calls them `labels.v001.000_cam1.analysis.h5`.
OF_SLEAP = re.compile(r"\.\d{3}_(.+)\.analysis\.(?:h5|csv)$", re.IGNORECASE)
_HEADING = re.compile(r"\[[A-Za-z_][\w.]*\]")
SHAPES = "shapes"  # of an image, in the files of labelme
HDF5, NUMPY, ZIP = b"\x89HDF\r\n\x1a\n", b"\x93NUMPY", b"PK\x03\x04"


def _named(file: str) -> str:
    """Return what a file is called: up to the first point, or after the video that SLEAP names."""
    video = OF_SLEAP.search(file)
    return video[1] if video else file.partition(".")[0] or file


class Source:
    """A file, or the JSON files of one camera's frames.

    Parameters
    ----------
    path
        The file, or the folder of the frames.
    frames
        The files of a camera that has one for each frame, in order.
    name
        Of the camera; from the path if not given.
    """

    def __init__(self, path: Path, frames: tuple[Path, ...] = (), name: str = "") -> None:
        self.path, self.frames = path, frames
        self.name = name or (path.name if frames else _named(path.name))

    def __str__(self) -> str:
        return str(self.path)

    @cached_property
    def head(self) -> bytes:
        """Its first bytes; of the first frame if it has many."""
        try:
            with (self.frames[0] if self.frames else self.path).open("rb") as file:
                return file.read(HEAD)
        except OSError as error:
            raise FormatError(f"{error.strerror or error}", place=self) from error

    def begins(self, magic: bytes) -> bool:
        """Whether a file (no frames) begins with these bytes."""
        return not self.frames and self.head.startswith(magic)

    @property
    def is_toml(self) -> bool:
        """Whether it begins with the heading of a table of TOML, as calibrations do."""
        first = next((line.strip() for line in self.lines if line.strip()), "")
        return _HEADING.fullmatch(first) is not None

    @cached_property
    def json(self) -> Any:
        """The JSON of the file, or of its first frame with content; None if it is no JSON.

        Raises
        ------
        FormatError
            If it looks like JSON, and is too large or broken.
        """
        start = self.head.decode(self.encoding or "ascii", errors="ignore").lstrip("\ufeff \t\r\n")[
            :1
        ]
        if not self.encoding or start not in ("{", "[") or self.is_toml:
            return None
        if self.frames:
            parsed = (load_json(path, MAX_FRAME) for path in self.frames[:LOOKED_INTO])
            return next(filter(None, parsed), None)
        return load_json(self.path, MAX_JSON)

    def frames_json(self) -> Iterator[Any]:
        """Yield the JSON of each frame."""
        for path in self.frames:
            yield load_json(path, MAX_FRAME)

    @cached_property
    def hdf5(self) -> dict[str, bool]:
        """Names of the top level of an HDF5 file, and whether pandas wrote what is there."""
        if not self.begins(HDF5):
            return {}
        with hdf5.opened(self.path) as file:
            return {name: "pandas_type" in file[name].attrs for name in file}

    @cached_property
    def encoding(self) -> str | None:
        """The encoding of a text; None if it is not text."""
        return encoding_of(self.frames[0] if self.frames else self.path, self.head)

    @cached_property
    def lines(self) -> list[str]:
        """The first lines of a text that are not empty; none if it is not text."""
        if self.encoding is None:
            return []
        try:
            path = self.frames[0] if self.frames else self.path
            return list(islice(lines_of(path, self.encoding), FIRST_LINES))
        except FormatError:
            return []

    def text_lines(self) -> Iterator[str]:
        """Yield the lines of a text that are not empty, without their ends.

        Raises
        ------
        FormatError
            If the file is too large or no text.
        """
        check_size(self.path, MAX_TEXT)
        if self.encoding is None:
            raise FormatError("cannot be read as text", place=self)
        return lines_of(self.path, self.encoding)


def load_json(path: Path, limit: int) -> Any:
    """Parse a JSON file of bounded size, or JSON lines as a list; NaN and Infinity are understood.

    Raises
    ------
    FormatError
        If it is too large, or broken.
    """
    check_size(path, limit)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{error.strerror or error}", place=path) from error
    try:
        try:
            text = content.decode(json.detect_encoding(content))
        except UnicodeDecodeError:
            text = content.decode(WESTERN, errors="replace")
        try:
            return json.loads(text.removeprefix("\ufeff"))
        except json.JSONDecodeError as error:
            if error.msg != "Extra data":
                raise
            return [json.loads(line) for line in text.splitlines() if line.strip()]
    except (ValueError, RecursionError) as error:
        raise FormatError(f"broken JSON ({error})", place=path) from error


def check_size(path: Path, limit: int) -> None:
    """Refuse a file that is larger than this."""
    size = path.stat().st_size
    if size > limit:
        raise FormatError(
            f"{size / 2**20:,.0f} MiB are more than the {limit / 2**20:,.0f} MiB that are "
            "read of such a file; write it in parts, or as npz",
            place=path,
        )


def frames_in(folder: Path, others: Container[Path] = ()) -> list[Source]:
    """Return the cameras whose frames are files of this folder, one file each.

    They are JSON, or lines of YOLO's labels.

    Parameters
    ----------
    others
        Files that hold no keypoints.
    """
    return frames_among([path for path in folder.iterdir() if path not in others], folder)


def frames_among(paths: Sequence[Path], folder: Path) -> list[Source]:
    """Return the cameras whose frames are among these files of a folder, as `frames_in` does."""
    for suffix, is_one in ((".json", _is_json_frame), (".txt", _is_yolo_frame)):
        files = [path for path in paths if path.suffix.lower() == suffix]
        if len(files) > MAX_FRAMES:
            raise FormatError(f"{len(files):,} files are too many", place=folder)
        files.sort(key=lambda path: natural(path.name))
        first = files[:LOOKED_INTO]
        if not files or any(path.stat().st_size > MAX_FRAME for path in first) or not is_one(first):
            continue
        cameras: dict[str, list[Path]] = {}
        for path in files:
            cameras.setdefault((frame_number(path.name) or ("", 0))[0], []).append(path)
        if len(cameras) > max(1, len(files) // 2):
            cameras = {"": files}
        several = len(cameras) > 1
        return [
            Source(folder, tuple(paths), name if several else folder.name)
            for name, paths in cameras.items()
        ]
    return []


def _is_json_frame(files: Sequence[Path]) -> bool:
    """Whether the first file with content is a detector's output for one image."""
    contents = (load_json(path, MAX_FRAME) for path in files)
    parsed = (content for content in contents if content and not _shows_nobody(content))
    content = next(parsed, None)
    of_image = isinstance(content, dict) and bool(content.keys() & {"landmarks", SHAPES})
    return of_image or is_one_frame(content, len(files))


def _shows_nobody(content: Any) -> bool:
    return isinstance(content, dict) and (people_of(content) == [] or content.get(SHAPES) == [])


def _is_yolo_frame(files: Sequence[Path]) -> bool:
    for path in files:
        with path.open("rb") as file:
            line = file.readline(MAX_LINE).decode("ascii", errors="replace")
        if line.strip():
            return yolo_numbers(line) is not None
    return False


def yolo_numbers(line: str) -> list[float] | None:
    """Return the numbers of a line of YOLO's pose labels; None if it is another."""
    try:
        numbers = [float(word) for word in line.split()]
    except ValueError:
        return None
    # A class, a box, and at least two keypoints; a box alone is no pose.
    shares = numbers[1:5]
    whole = len(numbers) >= FEWEST_NUMBERS and numbers[0].is_integer()
    return numbers if whole and all(0 <= share <= 2 for share in shares) else None
