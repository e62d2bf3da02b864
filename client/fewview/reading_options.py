"""How files of 2D keypoints are to be read: what `fewview.read` and all commands are told."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Literal

from fewview.errors import FormatError

Align = Literal["index", "time"]
Person = int | str
Size = tuple[int, int]


@dataclass(frozen=True)
class ReadingOptions:
    """Options of reading; `fewview.read` says more of each.

    Attributes
    ----------
    format
        Name of the format; None to find out from the content.
    person
        "auto", a number, the name of a track or individual, or one of these for each camera; text
        such as "0,1,0" is a list.
    min_confidence
        Detections that are less sure are gaps.
    skeleton
        Name of a skeleton that gives the keypoints their names and edges.
    align
        "index": frames of the same number belong together. "time": frames of the nearest time.
    fps
        Frames per second, where a file tells no times.
    image_size
        (width, height) in pixels of all views, or of each; text such as "1920x1080" for all.
    untrusted
        Whether to refuse formats whose readers have to trust their files.

    Raises
    ------
    FormatError
        If one of them cannot be.
    """

    format: str | None = None
    person: Person | Sequence[Person] = "auto"
    min_confidence: float = 0.0
    skeleton: str | None = None
    align: Align = "index"
    fps: float | None = None
    image_size: Size | Sequence[Size] | str | None = None
    untrusted: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence <= 1:
            raise FormatError(f"min_confidence is {self.min_confidence}, not in [0, 1]")
        if self.align not in ("index", "time"):
            raise FormatError(f"align is {self.align!r}, neither 'index' nor 'time'")
        if self.fps is not None and not 0 < self.fps < inf:
            raise FormatError(f"fps is {self.fps}, not above 0")
        self.sizes()

    def sizes(self) -> Size | Sequence[Size] | None:
        """Return the image size of all views, or of each, as numbers.

        Raises
        ------
        FormatError
            If it is text of another kind than "1920x1080".
        """
        if not isinstance(self.image_size, str):
            return self.image_size
        width, _, height = self.image_size.lower().partition("x")
        if not (width.isdigit() and height.isdigit()):
            raise FormatError(
                f"image size {self.image_size!r}: expected WIDTHxHEIGHT, such as 1920x1080"
            )
        return int(width), int(height)
