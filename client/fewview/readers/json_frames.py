"""JSON of people frame by frame, in the many layouts that detectors and scripts give it.

What differs is how frames, people and keypoints are spelled; the words are listed here. A person is
a dictionary with keypoints, or a bare list of ``[x, y, confidence]``.
"""

from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.headers import axis_of
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
NUMBERS = (
    *("frame_id", "frame", "frame_index", "frame_idx", "frame_number", "frame_num"),
    *("filename", "image_name", "image", "file_name", "image_id"),
)
BARE = "bodyparts"  # of SuperAnimal: a list of people, each a list of points
LOOKED_INTO = 1000  # frames
MOST_SURE = 2.0  # of a confidence; flags of visibility go up to 2
Frame = tuple[int | None, list[Any]]  # its number, if it has one, and its people


def frames_of(content: Any) -> list[Frame]:
    """Return the frames of a file; none if it holds no people frame by frame."""
    if isinstance(content, dict):
        content = next(
            (content[key] for key in FRAMES if _holds_frames(content.get(key), key)), content
        )
    if isinstance(content, dict):
        people = None if _are_numbered(content) else people_of(content)
        listed = [(_number(content), people)] if people is not None else _by_names(content)
    else:
        listed = [(_number(one), people_of(one)) for one in content or ()]
    frames = [(number, people) for number, people in listed if people is not None]
    if len(frames) < len(listed) or not any(
        has_points(people) for _, people in frames[:LOOKED_INTO]
    ):
        return []
    return _by_number(frames)


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


def _by_names(content: dict[str, Any]) -> list[tuple[int | None, list[Any] | None]]:
    """Return the frames that a file has under the names of images; none if it has others."""
    numbers = [frame_number(key if "." in key else f"{key}.") for key in map(str, content)]
    if None in numbers:
        return []
    frames = zip(numbers, content.values(), strict=True)
    return [(number and number[1], people_of(frame)) for number, frame in frames]


def is_one_frame(content: Any) -> bool:
    """Whether this is a detector's output for one image, and not for a whole video."""
    if isinstance(content, dict):
        key = next((key for key in (*PEOPLE, BARE) if isinstance(content.get(key), list)), None)
        many = key in FRAMES and _holds_frames(content[key]) and len(content[key]) > 1
        return _are_named_points(_by_name(content)) if key is None else not many
    if not isinstance(content, list) or not content or not isinstance(content[0], dict):
        return False
    people = people_of(content)
    return has_points(people) and all(
        isinstance(one, dict) and not one.keys() & {*NUMBERS, *PEOPLE} for one in people or ()
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
    return any(one.keys() & {*NUMBERS, *PEOPLE} or _are_numbered(one) for one in value)


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
    at = value.get("location", value) if isinstance(value, dict) else None
    return isinstance(at, dict) and {"x", "y"} <= at.keys()


def _point(point: dict[str, Any]) -> list[float]:
    at = point.get("position", point.get("location", point))
    sure = next((v for k, v in point.items() if axis_of(k) in ("confidence", "visibility")), np.nan)
    return [at["x"], at["y"], sure]


def _number(frame: Any) -> int | None:
    """Return the number of a frame, from its field or from the name of its image."""
    fields = (
        next((frame[key] for key in NUMBERS if key in frame), None)
        if isinstance(frame, dict)
        else None
    )
    if isinstance(fields, str):
        found = frame_number(fields if "." in fields else f"{fields}.")
        return found and found[1]
    return fields if isinstance(fields, int) else None


def _by_number(frames: list[Frame]) -> list[Frame]:
    """Join records of one frame, where each is of one person."""
    numbers = [number for number, _ in frames]
    if None in numbers or len(set(numbers)) == len(numbers):
        return frames
    joined: dict[int | None, list[Any]] = {}
    for number, people in frames:
        joined.setdefault(number, []).extend(people)
    return list(joined.items())
