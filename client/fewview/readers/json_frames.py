"""JSON of people frame by frame, in the many layouts that detectors and scripts give it.

What differs is how frames, people and keypoints are spelled; the words are listed here. A person is
a dictionary with keypoints, or a bare list of ``[x, y, confidence]``.
"""

from collections.abc import Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from fewview.capture import Float32, Float64
from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.headers import ROLES, axis_of, plain, unit_of
from fewview.readers.named_points import Point

FRAMES = ("instance_info", "frames", "results", "predictions", "pose_results", "data", "keypoints")
PEOPLE = (
    *("instances", "predictions", "people", "annots", "bodies", "persons", "pose_results"),
    *("observations", "poses"),
)
POINTS = (
    *("keypoints", "pose_keypoints_2d", "joints", "pose", "keypoint", "kpts"),
    *("recognizedPoints", "recognized_points", "points", "landmarks"),
)
SIDES = tuple((s, f"image_{s}", f"image{s.capitalize()}") for s in ("width", "height"))
CALLED = ("name", "part", "joint", "jointName", "joint_name")  # a point, in its own fields
SCORES = ("keypoint_scores", "keypoints_scores", "kp_score", "scores", "keypoint_confidences")
NUMBERS = tuple(word for word in ROLES["frame"] if word not in ("", "index", "unnamed0"))
BARE = "bodyparts"  # of SuperAnimal: a list of people, each a list of points
LOOKED_INTO = 1000  # frames
MOST_PEOPLE = 30  # of an image, where there are fewer files than that: more are frames
MOST_SURE = 2.0  # of a confidence; flags of visibility go up to 2
LONGEST_STEP = 5.0  # seconds between frames: times with more count in another unit


class Frame(NamedTuple):
    """A frame: its number and its time in seconds, if it has them, and its people."""

    number: int | None
    time: float | None
    people: list[Any]


def frames_of(content: Any) -> list[Frame]:
    """Return the frames of a file; none if it holds no people frame by frame."""
    if isinstance(content, dict):
        content = next(
            (content[key] for key in FRAMES if _holds_frames(content.get(key), key)), content
        )
    if isinstance(content, dict) and (_are_numbered(content) or people_of(content) is None):
        listed = _by_names(content)
    else:
        each = [content] if isinstance(content, dict) else content or ()
        listed = [(number_of(one), one) for one in each]
    frames = [
        Frame(number, time_of(one), people)
        for number, one in listed
        if (people := people_of(one)) is not None
    ]
    if len(frames) < len(listed) or not any(
        has_points(frame.people) for frame in frames[:LOOKED_INTO]
    ):
        return []
    return _by_number(frames)


def times_of(frames: Sequence[float | None]) -> Float64 | None:
    """Return the times (N,) of frames in seconds; None if one has none, or they are no seconds."""
    if None in frames or len(frames) < 2:
        return None
    times = np.array(frames, np.float64)
    return times if 0 < np.median(np.abs(np.diff(times))) < LONGEST_STEP else None


def people_of(frame: Any) -> list[Any] | None:
    """Return the people of a frame; None if it is no frame."""
    found: Any = None
    if isinstance(frame, list):
        found = [frame] if _is_points(frame) else frame
        if found is frame and all(isinstance(one, list) and not _is_points(one) for one in frame):
            found = [one for each in frame for one in each]
    elif isinstance(frame, dict):
        key = next((key for key in (BARE, *PEOPLE) if isinstance(frame.get(key), list)), None)
        if key is not None:
            return people_of(frame[key])
        if any(key in frame for key in POINTS):
            found = [frame]
        elif _are_numbered(frame):  # by their tracks
            found = list(frame.values())
        elif len(bare := {name: each for name, each in frame.items() if _is_point(each)}) > 2:
            found = [{POINTS[0]: bare}]
    right = found is not None and all(isinstance(one, dict) or _is_points(one) for one in found)
    return found if right else None


def cameras_of(content: Any) -> dict[str, Any]:
    """Return what a file holds of each camera, by its name; "" of one that it does not name."""
    if isinstance(content, dict) and len(content) > 1:
        names = list(map(str, content))
        images = _are_numbered(content) or all(PurePath(name).suffix for name in names)
        if not images and not {*FRAMES, *PEOPLE, *POINTS} & set(names):
            several = (
                isinstance(one, list) and len(frames_of(one)) > 1 for one in content.values()
            )
            if all(several):
                return dict(zip(names, content.values(), strict=True))
    return {"": content}


def _are_numbered(content: dict[str, Any]) -> bool:
    return all(str(key).isdecimal() for key in content)


def _by_names(content: dict[str, Any]) -> list[tuple[int | None, Any]]:
    """Return the frames that a file has under the names of images; none if it has others."""
    numbers = [frame_number(key if "." in key else f"{key}.") for key in map(str, content)]
    if None in numbers:
        return []
    frames = zip(numbers, content.values(), strict=True)
    return [(number and number[1], frame) for number, frame in frames]


def is_one_frame(content: Any, files: int) -> bool:
    """Whether this, of so many files, is a detector's output for an image, and not for a video."""
    if isinstance(content, dict):
        key = next((key for key in (*PEOPLE, BARE) if isinstance(content.get(key), list)), None)
        many = key in FRAMES and _holds_frames(content[key]) and len(content[key]) > 1
        return _are_named_points(_by_name(content)) if key is None else not many
    if not isinstance(content, list) or not content or not isinstance(content[0], dict):
        return False
    people = people_of(content)
    if not has_points(people) or len(content) > max(MOST_PEOPLE, files):
        return False
    moments = {time_of(one) for one in content}
    return len(moments) == 1 and not any(map(_is_frame, people or ()))


def _is_frame(one: Any) -> bool:
    """Whether this has the number of a frame, or several people."""
    return not isinstance(one, dict) or bool(
        one.keys() & set(PEOPLE) or {*NUMBERS} & set(map(plain, one))
    )


def has_points(people: Sequence[Any] | None) -> bool:
    """Whether somebody among these has keypoints."""
    return any(
        _is_points(one) or (isinstance(one, dict) and any(one.get(key) for key in POINTS))
        for one in people or ()
    )


def named_points(people: Sequence[Any]) -> list[dict[str, Point]] | None:
    """Return the points of each person by their names; None if somebody's have none."""
    found = []
    for person in people:
        named = _by_name(person)
        if named is None:
            return None
        found.append({name: _coordinates(each) for name, each in named.items() if each})
    return found


def _by_name(person: Any) -> dict[str, Any] | None:
    """Return what a person has under the names of points; None if these have no names."""
    if not isinstance(person, dict) or any(isinstance(person.get(key), list) for key in SCORES):
        return None
    points = next((person[key] for key in POINTS if person.get(key)), None)
    if isinstance(points, dict) and "keypoints" in points:  # of PoseNet
        points = points["keypoints"]
    if not points:
        return {} if any(key in person for key in POINTS) else None
    if isinstance(points, dict):
        return None if _by_axis(points) else {str(name): each for name, each in points.items()}
    if not isinstance(points, list) or not all(isinstance(each, dict) for each in points):
        return None
    names = [next((each[key] for key in CALLED if key in each), None) for each in points]
    if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        return None
    return {str(name): each for name, each in zip(names, points, strict=True)}


def _are_named_points(points: dict[str, Any] | None) -> bool:
    return bool(points) and all(
        not name.isdecimal() and (not point or _is_point(point) or _is_points([point]))
        for name, point in (points or {}).items()
    )


def _coordinates(point: Any) -> Point:
    if isinstance(point, dict):
        x, y, sure = _point(point)
    elif len(point) in (2, 3):
        x, y, sure = (*point, np.nan)[:3]
    else:
        raise ValueError(f"{len(point)} numbers are no x, y, confidence")
    return float(x), float(y), np.nan if sure is None else float(sure)


def points_of(person: Any, what: str, *, y_first: bool = False) -> Float32 | None:
    """Return (P, 3) of x, y, confidence (NaN where there is none); None if no person is there.

    Raises
    ------
    FormatError
        If they are 3D, or no points; `what` names the file.
    """
    points, scores = person, None
    if isinstance(person, dict):
        points = next((person[key] for key in POINTS if person.get(key)), None)
        if isinstance(points, dict) and "keypoints" in points:  # of PoseNet
            points = points["keypoints"]
        scores = next((person[key] for key in SCORES if isinstance(person.get(key), list)), None)
    if not points:
        return None
    values = _array(points, scores)
    if values.ndim != 2 or values.shape[1] not in (2, 3) or (scores and values.shape[1] == 3):
        raise FormatError(
            f"keypoints of the shape {values.shape} are not 2D; give those of the 2D "
            "estimator alone",
            place=what,
        )
    if y_first:
        values = values[:, [1, 0, *range(2, values.shape[1])]]
    if values.shape[1] == 2:
        sure = np.full(len(values), np.nan) if scores is None else np.ravel(scores)
        values = np.concatenate([values, np.asarray(sure, float).reshape(-1, 1)], axis=1)
    return values.astype(np.float32)


def names_of(content: Any, people: Sequence[Any], count: int) -> tuple[str, ...] | None:
    """Return the names that a file gives its keypoints."""
    fields = content if isinstance(content, dict) else {}
    meta = fields.get("meta_info")
    by_number = meta.get("keypoint_id2name") if isinstance(meta, dict) else fields.get("skeleton")
    if isinstance(by_number, dict) and set(by_number) == {str(index) for index in range(count)}:
        return tuple(str(by_number[str(index)]) for index in range(count))
    one = next((p for p in people if isinstance(p, dict)), {})
    return tuple(_by_name(one) or ()) or None


def size_of(frame: Any) -> tuple[int, int] | None:
    """Return the (width, height) in a frame or a file."""
    if not isinstance(frame, dict):
        return None
    pair = frame.get("image_size")
    if isinstance(pair, list) and len(pair) == 2:
        width, height = pair
    else:
        width, height = (
            next((frame[name] for name in names if name in frame), None) for names in SIDES
        )
    known = isinstance(width, int | float) and isinstance(height, int | float)
    return (int(width), int(height)) if known and width > 0 and height > 0 else None


def _holds_frames(value: Any, key: str = "") -> bool:
    """Whether these, under a key, are several frames, and not the people or points of one."""
    if isinstance(value, dict):
        return bool(value) and all(people_of(one) is not None for one in value.values())
    if not isinstance(value, list) or not value or _is_points(value):
        return False
    if key == "frames" or not all(isinstance(one, dict) for one in value):
        return all(people_of(one) is not None for one in value)
    moments = {time_of(one) for one in value}
    return len(moments) > 1 or any(_is_frame(one) or _are_numbered(one) for one in value)


def _is_points(value: Any) -> bool:
    """Whether this is a list of ``[x, y]`` or ``[x, y, confidence]``."""
    return (
        isinstance(value, list)
        and len(value) > 0
        and all(
            isinstance(one, list)
            and len(one) in (2, 3)
            and all(isinstance(number, int | float) or number is None for number in one)
            for one in value
        )
    )


def _by_axis(points: dict[str, Any]) -> bool:
    return {"x", "y"} <= points.keys() and isinstance(points["x"], list)


def _array(points: Any, scores: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    if isinstance(points, dict) and _by_axis(points):
        sure = [points[key] for key in points if axis_of(key) in ("confidence", "visibility")]
        return np.array([points["x"], points["y"], *sure[:1]], np.float64).T
    if isinstance(points, dict):
        points = list(points.values())
    if isinstance(points[0], dict):
        return np.array([_point(one) for one in points], np.float64)
    values = np.array(points, np.float64)
    if values.ndim == 1:
        values = values.reshape(-1, 2 if _are_pairs(values, scores) else 3)
    return values


def _are_pairs(values: np.ndarray[Any, np.dtype[np.float64]], scores: Any) -> bool:
    """Whether numbers are x, y, x, y, ..., and not x, y, confidence, ..."""
    if scores is not None:
        return len(values) == 2 * len(scores)
    if len(values) % 3:
        return True
    return len(values) % 2 == 0 and bool(np.nanmax(values[2::3]) > MOST_SURE)


def _is_point(value: Any) -> bool:
    at = _place(value) if isinstance(value, dict) else None
    return _is_points([at]) if isinstance(at, list) else isinstance(at, dict) and at.keys() >= _XY


_XY = {"x", "y"}


def _place(point: dict[str, Any]) -> Any:
    return next((point[key] for key in ("position", "location") if key in point), point)


def _point(point: dict[str, Any]) -> list[float]:
    at = _place(point)
    x, y = at[:2] if isinstance(at, list) else (at["x"], at["y"])
    sure = next((v for k, v in point.items() if axis_of(k) in ("confidence", "visibility")), np.nan)
    return [x, y, sure]


def number_of(frame: Any) -> int | None:
    """Return the number of a frame, from its field or from the name of its image."""
    given = _field(frame, NUMBERS)
    if isinstance(given, str):
        found = frame_number(given if "." in given else f"{given}.")
        return found and found[1]
    return int(given) if isinstance(given, int | float) and given == given // 1 else None


def time_of(frame: Any) -> float | None:
    """Return the seconds that a frame has in its field; None if it has none."""
    key = _key(frame, ROLES["time"])
    time = frame[key] if key else None
    return time * unit_of(key) if isinstance(time, int | float) else None


def _field(frame: Any, words: Sequence[str]) -> Any:
    key = _key(frame, words)
    return frame[key] if key else None


def _key(frame: Any, words: Sequence[str]) -> str:
    """Return the key of a dictionary that is the first of these words; "" if none is."""
    if not isinstance(frame, dict):
        return ""
    called = {plain(key): key for key in frame}
    return next((called[word] for word in words if word in called), "")


def _by_number(frames: list[Frame]) -> list[Frame]:
    """Join records of one frame, where each is of one person."""
    numbers = [frame.number for frame in frames]
    if None in numbers or len(set(numbers)) == len(numbers):
        return frames
    joined: dict[int | None, Frame] = {}
    for frame in frames:
        joined.setdefault(frame.number, frame._replace(people=[])).people.extend(frame.people)
    return list(joined.values())
