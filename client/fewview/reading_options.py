"""How files of 2D keypoints are to be read: what `fewview.read` and all commands take."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Literal, TypeVar

from fewview.errors import FormatError
from fewview.plain import is_number

NONE = "none"  # given in place of names, where there are none
Align = Literal["auto", "index", "time"]
Person = int | str
Size = tuple[int, int]
Sizes = Size | Sequence[Size | None] | Mapping[str, Size] | str
Value = TypeVar("Value")
FURTHEST = 1e6  # pixels: a corner lies in an image


@dataclass(frozen=True)
class ReadingOptions:
    """Options of reading; `fewview.read` explains them.

    Attributes
    ----------
    format
        Name of the format; None to find it from the content.
    person
        "auto", a number, the name of a track or individual, or one of these for each camera; text
        such as "0,1,0" is a list.
    min_confidence
        Detections with less confidence are gaps.
    skeleton
        Name of a skeleton with the names and edges of the keypoints.
    align
        "index": frames of the same number belong together. "time": frames of the nearest time.
        "auto": by time if the cameras' rates or times differ.
    fps
        Frames per second, if a file has no times: of all, or text such as
        "cam1=60,cam2=30".
    image_size
        (width, height) in pixels of all views, of each, or by their names; text such as
        "1920x1080" for all, "1920x1080,cam2=1080x1920" where some differ.
    untrusted
        Whether to refuse formats whose readers have to trust their files.
    columns
        The contents of a table's columns, such as "x={}_x,y={}_y,frame=No".
    cameras
        Names of the views that are wanted, in their order; text with commas is a list.
    trial
        Name of the trial, or of the detector, to read, if there are files of several.
    y
        "down", as in images; "up" if y counts from the lower edge.
    mirror
        Names of the views whose images are mirrored; text with commas is a list; "none": of none.
    offset
        (x, y) of the corner of a crop in the whole image, from which a view's keypoints count:
        text such as "cam2=560,180", or "560,180" for all.
    offset_seconds
        By how much views show every moment later than the others, negative if earlier: text such
        as "cam2=4.2".
    views_in_names
        Words of the cameras that keypoints' names begin or end with; text with commas is a list.
        None to find them, "none" if there are none.

    Raises
    ------
    FormatError
        If one of them is invalid.
    """

    format: str | None = None
    person: Person | Sequence[Person] = "auto"
    min_confidence: float = 0.0
    skeleton: str | None = None
    align: Align = "auto"
    fps: float | str | None = None
    image_size: Sizes | None = None
    untrusted: bool = False
    columns: str | None = None
    cameras: Sequence[str] | str | None = None
    trial: str | None = None
    y: Literal["down", "up"] = "down"
    mirror: Sequence[str] | str | None = None
    offset: str | None = None
    offset_seconds: str | None = None
    views_in_names: Sequence[str] | str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence <= 1:
            raise FormatError(f"{self.min_confidence} is not in [0, 1]", option="min_confidence")
        if self.align not in ("auto", "index", "time"):
            raise FormatError(
                f"{self.align!r} is neither 'auto', 'index' nor 'time'", option="align"
            )
        if self.y not in ("down", "up"):
            raise FormatError(f"{self.y!r} is neither 'down' nor 'up'", option="y")
        self.sizes([""])
        self.rates([""])
        self.corners([""])
        self.delays([""])

    @property
    def words_of_views(self) -> list[str] | None:
        """The words of cameras in keypoints' names; None to find them."""
        given = self.views_in_names
        listed = given.split(",") if isinstance(given, str) else given
        return None if listed is None else [word.strip() for word in listed if word.strip()]

    def sizes(self, views: Sequence[str]) -> list[Size | None]:
        """Return the image size of each view, None where it was not given.

        Raises
        ------
        FormatError
            If one is invalid, there are too many or too few, or it names no view. No view may have
            the name "", which means any view.
        """
        given = self.image_size
        if isinstance(given, str):
            return _of_views(given, views, _size, "image_size")
        if isinstance(given, Mapping):
            return [given.get(name) for name in views]
        if given is None:
            return [None] * len(views)
        of_each = any(isinstance(size, Sequence) for size in given)
        listed: list[Any] = list(given) if of_each else [given] * len(views)
        right = all(
            size is None or (len(size) == 2 and all(int(n) > 0 for n in size)) for size in listed
        )
        if not right or (len(listed) != len(views) and views != [""]):
            raise FormatError(
                f"{given!r} is not (width, height), nor {len(views)} of these",
                option="image_size",
            )
        return [None if size is None else (int(size[0]), int(size[1])) for size in listed]

    def rates(self, views: Sequence[str]) -> list[float | None]:
        """Return the frames per second of each view, None where they were not given.

        Raises
        ------
        FormatError
            If one cannot be, or names no view.
        """
        if self.fps is None:
            return [None] * len(views)
        return _of_views(str(self.fps), views, _rate, "fps")

    def corners(self, views: Sequence[str]) -> list[tuple[float, float] | None]:
        """Return (x, y) from which each view's keypoints count, None where it was not given.

        Raises
        ------
        FormatError
            If one cannot be, or names no view.
        """
        if self.offset is None:
            return [None] * len(views)
        return _of_views(_pairs_joined(self.offset), views, _corner, "offset")

    def delays(self, views: Sequence[str]) -> list[float | None]:
        """Return by how many seconds each view is late, None where it was not given.

        Raises
        ------
        FormatError
            If one is no number, or names no view.
        """
        if self.offset_seconds is None:
            return [None] * len(views)
        return _of_views(self.offset_seconds, views, _seconds, "offset_seconds")

    def named(self, option: Literal["cameras", "mirror"], views: Sequence[str]) -> list[int] | None:
        """Return the indices of the views that an option names; None if it was not given.

        Mirrors that are "none" name no view.

        Raises
        ------
        FormatError
            If there is no view of a name, or one is named twice.
        """
        given: Sequence[str] | str | None = getattr(self, option)
        if given is None:
            return None
        names = given.split(",") if isinstance(given, str) else given
        if option == "mirror" and [name.strip() for name in names] == [NONE]:
            return []
        places = [_place(name, views, option) for name in names]
        for place in places:
            if places.count(place) > 1:
                raise FormatError(
                    f"{views[place]!r} is named twice; name each camera once",
                    option=option,
                )
        return places


def _pairs_joined(text: str) -> str:
    """Write each pair of numbers as 560x180: what separates these does not separate views."""
    joined: list[str] = []
    first = False  # whether the part before is the first number of a pair
    for part in text.split(","):
        number = is_number(part.rpartition("=")[2])
        if first and number and "=" not in part:
            joined[-1] = f"{joined[-1].rstrip()}x{part.strip()}"
            first = False
        else:
            joined.append(part)
            first = number
    return ",".join(joined)


def _of_views(
    text: str, views: Sequence[str], parse: Callable[[str, str], Value], option: str
) -> list[Value | None]:
    """Return the value of each view from text such as ``30,cam2=60``: one for all, or by name."""
    found: list[Value | None] = [None] * len(views)
    for part in text.split(","):
        name, named, value = part.rpartition("=")
        parsed = parse(value.strip(), option)
        if not named:
            found = [parsed if each is None else each for each in found]
        elif list(views) != [""]:
            found[_place(name, views, option)] = parsed
    return found


def _place(name: str, views: Sequence[str], option: str) -> int:
    name = name.strip()
    if name in views:
        return list(views).index(name)
    raise FormatError(f"there is no camera {name!r}; there are {', '.join(views)}", option=option)


def _size(text: str, option: str) -> Size:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise FormatError(
            f"{text!r}: expected WIDTHxHEIGHT, such as 1920x1080, or of each camera, such "
            "as cam1=1920x1080,cam2=1080x1920",
            option=option,
        )
    return int(width), int(height)


def _rate(text: str, option: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0 < rate < inf:
        raise FormatError(
            f"{text!r} is not above 0: expected one number, or those of each camera, such as "
            "cam1=60,cam2=30",
            option=option,
        )
    return rate


def _corner(text: str, option: str) -> tuple[float, float]:
    x, _, y = text.partition("x")
    try:
        corner = float(x), float(y)
    except ValueError:
        corner = inf, inf
    if not all(abs(number) <= FURTHEST for number in corner):
        raise FormatError(
            f"{text.replace('x', ',')!r}: expected X,Y in pixels, such as 560,180, or of each "
            "camera, such as cam1=560,180,cam2=0,90",
            option=option,
        )
    return corner


def _seconds(text: str, option: str) -> float:
    try:
        late = float(text)
    except ValueError:
        late = inf
    if not isfinite(late):
        raise FormatError(
            f"{text!r} is no number of seconds: expected one of each camera, such as "
            "cam1=4.2,cam2=-0.5",
            option=option,
        )
    return late
