"""What the headers of tables name: keypoints, coordinates, people, cameras, frames and times."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from fewview.errors import FormatError


def _names(words: str) -> tuple[str, ...]:
    return tuple(words.split())


AXES = {
    "x": _names("x u xpx imgx imagex imglocx xcoord"),
    "y": _names("y ypx imgy imagey imglocy ycoord"),
    "z": _names("z objz"),
    "confidence": _names(
        "likelihood confidence conf score scores probability prob p c certainty keypointscore"
    ),
    # What MediaPipe calls so, which gives a depth beside pixels, too.
    "visibility": _names("visibility vis visible v"),
}
ROLES = {
    "frame": (
        *_names(
            "frame syncindex frameidx frameid framenumber framenum frameno frameindex fnum index "
            "image imagename imageid filename file img imagepath unnamed0"
        ),
        "",
    ),
    "time": _names(
        "time times timestamp timestamps timesec timeseconds seconds sec t frametime timems ms "
        "timestampms milliseconds msec timens timestampns timeus timestampus"
    ),
    "camera": _names(
        "camera cam view video videopath videoname port camid cameraid camname cameraname viewid "
        "viewname"
    ),
    "person": _names(
        "person track individual animal id personid personidx trackid trackname instance subject "
        "objectid individuals animalid"
    ),
    "keypoint": _names(
        "keypoint bodypart joint landmark marker node landmarkid landmarkname landmarkindex "
        "landmarkidx pointid keypointid keypointname keypointindex kp kpt jointname jointid part "
        "bodyparts markername label name feature point nodename"
    ),
}
# Of seconds, which the name of a time can end in.
PARTS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3}
LONGEST_CELL = 200  # characters of a header's cell that are understood
FIELDS = {r"\{\}": "keypoint", r"\{camera\}": "camera", r"\{person\}": "person"}
LEVELS = ("scorer", "individuals", "bodyparts", "coords")
_AXIS_OF = {word: axis for axis, words in AXES.items() for word in words}
_WORDS = (
    "x|y|z|u|v|c|p|likelihood|confidence|conf|scores?|vis|visibility|visible|probability|prob|"
    "certainty"
)
_SPELLINGS = tuple(
    re.compile(pattern, flags)
    for pattern, flags in (
        (rf"(?P<name>.+?)[._ :/-](?P<axis>{_WORDS})", re.IGNORECASE),  # nose_x
        (rf"(?P<axis>{_WORDS})[._ :/-](?P<name>.+)", re.IGNORECASE),  # x_nose
        (rf"(?P<name>.+?) ?[\[(](?P<axis>{_WORDS})[\])]", re.IGNORECASE),  # nose[x]
        (r"(?P<axis>[xyzuvcps])(?P<name>\d+)", re.IGNORECASE),  # x1
        (r"(?P<name>.*[a-z0-9])(?P<axis>[XYZ]|Score|Confidence|Visibility|Likelihood)", 0),  # noseX
    )
)
_BETWEEN = "._ :/-"
_RUN = re.compile(r"[._ -]+")
_UNIT = re.compile(r"\s*[\[(](px|pix|pixels?)[\])]$", re.IGNORECASE)
_CAMERA = re.compile(r"(?<![^\W_])((?:cam|camera|view|port)[._ -]?\d+)(?![^\W_])", re.IGNORECASE)


class Label(NamedTuple):
    """What a column holds: "" for the camera, person or keypoint if there is but one."""

    camera: str
    person: str
    keypoint: str
    axis: str


@dataclass(frozen=True)
class Columns:
    """What the columns of a table hold.

    Attributes
    ----------
    roles
        Columns of the frame, the time, the camera, the person, the keypoint.
    labels
        Those of coordinates.
    """

    roles: dict[str, int]
    labels: dict[int, Label]

    @property
    def has_points(self) -> bool:
        """Whether some keypoint has an x and a y."""
        found = {(label[:3], label.axis) for label in self.labels.values()}
        return any((name, "y") in found for name, axis in found if axis == "x")


def plain(word: str) -> str:
    """Return a word in lower case, its letters and digits alone."""
    return "".join(filter(str.isalnum, word.lower()))


def unit_of(column: str) -> float:
    """Return the seconds of one unit of a column of times, by its name."""
    name = plain(column)
    return next((size for part, size in PARTS.items() if name.endswith(plain(part))), 1.0)


def axis_of(word: str) -> str | None:
    """Return what a column is called that holds x, y, z, a confidence or a visibility."""
    return _short_axis_of(word) if len(word) <= LONGEST_CELL else None


@lru_cache(1000)  # JSON asks for the same few words of each point
def _short_axis_of(word: str) -> str | None:
    return _AXIS_OF.get(plain(_UNIT.sub("", word)))


def stacked_columns(header: Sequence[Sequence[str]]) -> Columns:
    """Return what the columns hold whose last row of names is that of coordinates.

    The rows are called ``scorer``, ``individuals``, ``bodyparts``, ``coords`` in their first cell;
    where they are not, they are the last of these. Without body parts, keypoints are counted.
    """
    rows = [row for row in header if any(axis_of(cell) for cell in row) or any(row[1:])]
    names = [row[0].lower() for row in rows]
    if "coords" not in names:
        kinds = LEVELS if len(rows) == len(LEVELS) else (LEVELS[0], *LEVELS[2:])
        names = list(kinds[-len(rows) :])
    level = {name: _filled(row) for name, row in zip(names, rows, strict=True)}
    axes = [axis_of(cell) for cell in rows[names.index("coords")]]
    first = next((place for place, axis in enumerate(axes) if axis), 0)
    counted = [str(axes[first : place + 1].count(axes[first])) for place in range(len(axes))]
    parts, people = level.get("bodyparts", counted), level.get("individuals", [""] * len(axes))
    labels = {
        place: Label("", people[place], parts[place], axis)
        for place, axis in enumerate(axes)
        if axis and place >= first
    }
    return Columns({"frame": first - 1} if first else {}, parted(labels))


def _filled(row: Sequence[str]) -> list[str]:
    """Return a row in which empty cells have the name before them, as in merged cells."""
    filled = list(row)
    for place in range(2, len(row)):
        filled[place] = row[place] or filled[place - 1]
    return filled


def columns_of(header: Sequence[str]) -> Columns:
    """Return what the columns hold that a single row names: of a wide table, or a tidy one."""
    words = [plain(cell) for cell in header]
    roles: dict[str, int] = {}
    for role, names in ROLES.items():
        place = next((words.index(name) for name in names if name in words), None)
        if place is not None:
            roles[role] = place
    if not roles.keys() & {"frame", "time"} and words[roles.get("person", 0)] == "id":
        roles["frame"] = roles.pop("person")
    axes = {place: axis for place, cell in enumerate(header) if (axis := axis_of(cell))}
    if "keypoint" in roles and {"x", "y"} <= set(axes.values()):
        return Columns(roles, {i: Label("", "", "", axis) for i, axis in axes.items()})
    roles.pop("keypoint", None)
    taken = set(roles.values())
    labels = {
        place: label
        for place, cell in enumerate(header)
        if place not in taken and (label := _wide(cell)) is not None
    }
    if not any(label.axis == "y" for label in labels.values()):  # u and v are pixels, too
        labels = {i: _second(label) for i, label in labels.items()}
    return Columns(roles, parted(labels))


def _wide(cell: str) -> Label | None:
    """Return what a cell such as ``nose_x`` names; None if it names no coordinate."""
    if len(cell) > LONGEST_CELL:
        return None
    cell = _UNIT.sub("", cell)
    for spelling in _SPELLINGS:
        found = spelling.fullmatch(cell)
        axis = found and _AXIS_OF.get(
            "confidence" if found["axis"] == "s" else plain(found["axis"])
        )
        if found and axis and plain(found["name"]) not in ("instance", "tracking"):
            return Label("", "", found["name"].strip("._ -:/"), axis)
    return None


def _second(label: Label) -> Label:
    return label._replace(axis="y") if label.axis == "visibility" else label


def parted(labels: dict[int, Label]) -> dict[int, Label]:
    """Return the labels with the cameras that all keypoints name, such as ``pt1_cam2``."""
    found = {place: _CAMERA.search(label.keypoint) for place, label in labels.items()}
    cameras = {plain(each[1]) for each in found.values() if each}
    if len(cameras) < 2 or not all(found.values()):
        return labels
    out = {}
    for place, label in labels.items():
        each = found[place]
        if each is not None:
            name = label.keypoint[: each.start()] + " " + label.keypoint[each.end() :]
            name = name.strip(_BETWEEN) or label.keypoint
            out[place] = label._replace(camera=plain(each[1]), keypoint=_RUN.sub(_closed, name))
    return out


def _closed(run: re.Match[str]) -> str:
    """Return what stands for the separators about a hole, where a camera was cut out."""
    return "_" if " " in run[0] and len(run[0]) > 1 else run[0]


def mapped_columns(header: Sequence[str], mapping: str) -> Columns:
    """Return the contents of the columns by a mapping such as ``x={}_x,y={}_y,frame=No``.

    In the patterns of x, y, confidence or visibility, ``{}`` is the keypoint's name, and
    ``{camera}`` and ``{person}`` are theirs. Without ``{}``, a row is of one keypoint, and
    ``keypoint=`` gives the column of its name.

    Raises
    ------
    FormatError
        If the mapping cannot be read, or a pattern matches no column; the message names both.
    """
    roles: dict[str, int] = {}
    labels: dict[int, Label] = {}
    for part in mapping.split(","):
        role, _, name = (text.strip() for text in part.partition("="))
        if not name or (role not in ROLES and role not in AXES):
            raise FormatError(
                f"{part!r} is not ROLE=COLUMN, where the role is {', '.join(AXES)}, "
                f"{', '.join(ROLES)}",
                option="columns",
            )
        if role in ROLES:
            if name not in header:
                raise FormatError(_missing(part, header), option="columns")
            roles[role] = header.index(name)
            continue
        pattern = re.escape(name)
        for field, group in FIELDS.items():
            pattern = pattern.replace(field, f"(?P<{group}>.+?)", 1)
        found = {
            i: each
            for i, cell in enumerate(header)
            if len(cell) <= LONGEST_CELL and (each := re.fullmatch(pattern, cell))
        }
        if not found:
            raise FormatError(_missing(part, header), option="columns")
        for place, each in found.items():
            label = {"camera": "", "person": "", "keypoint": ""} | each.groupdict()
            labels[place] = Label(**label, axis=role)
    return Columns(roles, labels)


def _missing(part: str, header: Sequence[str]) -> str:
    shown = ", ".join(map(repr, header[:8])) + (", ..." if len(header) > 8 else "")
    return f"no column matches {part.strip()!r}; there are {shown}"
