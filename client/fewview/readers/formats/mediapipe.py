"""MediaPipe: landmarks of each frame as JSON, under the names that people give them.

Landmarks are dictionaries of x, y and visibility. If they are shares of the image, its size is in
the file (`width`, `height`) or is given.
"""

from typing import Any

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.json_frames import number_of, time_of, times_of
from fewview.readers.sources import Source
from fewview.readers.views import Int64, View, packed

KEYS = ("landmarks", "pose_landmarks", "poseLandmarks", "landmark", "hand_landmarks")
PARTS = ("left_hand_landmarks", "right_hand_landmarks", "face_landmarks")  # of holistic
CONFIDENCES = ("visibility", "vis", "score", "confidence")
Person = list[dict[str, Any]]


def fits(source: Source) -> bool:
    """Whether the first frames hold landmarks."""
    frames = _frames(source.json)
    return any(_people(frame) for frame in frames[:1000])


def read(source: Source) -> list[View]:
    """Return the view of a file, or of a folder with a file for each frame.

    Raises
    ------
    FormatError
        If landmarks are broken.
    """
    content = source.json
    frames = list(source.frames_json()) if source.frames else _frames(content)
    listed = [_people(frame) for frame in frames]
    try:
        names = _ordered(listed, source)
        people = [[_landmarks(one) for one in each] for each in listed]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"landmarks without x and y ({error!r})", place=source) from error
    keypoints, confidence = packed(people, str(source))
    fields = content if isinstance(content, dict) else {}
    width, height = (fields.get(key, fields.get(f"image_{key}")) for key in ("width", "height"))
    fps = fields.get("fps")
    notes = []
    if np.isnan(confidence[np.isfinite(keypoints[..., 0])]).all():
        notes.append("landmarks without a visibility have the confidence 1")
    if any(isinstance(frame, dict) and any(map(frame.get, PARTS)) for frame in frames):
        notes.append("landmarks of hands or faces beside the body were left out")
    return [
        View(
            source.name,
            keypoints,
            _numbers(frames, source),
            confidence,
            keypoint_names=names,
            image_size=(int(width), int(height)) if width and height else None,
            times=times_of([time_of(frame) for frame in frames]),
            fps=float(fps) if fps else None,
            notes=tuple(notes),
        )
    ]


def _frames(content: Any) -> list[Any]:
    if isinstance(content, dict):
        content = content.get("frames", content.get("results", content))
        content = [content] if isinstance(content, dict) else content
    return content if isinstance(content, list) else []


def _numbers(frames: list[Any], source: Source) -> Int64:
    """Return the number of each frame, from the frames or from the names of their files."""
    given = [number_of(frame) for frame in frames]
    if source.frames:
        named = [frame_number(path.name) for path in source.frames]
        given = [number if number is None else number[1] for number in named]
    numbers = np.array([number for number in given if number is not None], np.int64)
    if len(numbers) == len(frames) and np.all(np.diff(numbers) > 0):
        return numbers
    return np.arange(len(frames))


def _ordered(frames: list[list[Person]], source: Source) -> tuple[str, ...] | None:
    """Sort landmarks by their `id`, where they have one, and return their names.

    Raises
    ------
    FormatError
        If not all people have the same ones.
    """
    everybody = [person for people in frames for person in people]
    for person in everybody:
        if all(isinstance(point.get("id"), int) for point in person):
            person.sort(key=lambda point: int(point["id"]))
    for key in ("id", "name"):
        if len({tuple(point.get(key) for point in person) for person in everybody}) > 1:
            raise FormatError(
                f"people have landmarks of unlike {key}; write all of each", place=source
            )
    names = [point.get("name") for point in everybody[0]] if everybody else []
    complete = all(isinstance(name, str) for name in names) and len(set(names)) == len(names) > 0
    return tuple(map(str, names)) if complete else None


def _people(frame: Any) -> list[Person]:
    """Return the landmarks of each person of a frame: one list, or a list of lists."""
    while isinstance(frame, dict):
        frame = next((frame[key] for key in KEYS if frame.get(key)), None)
    if not isinstance(frame, list) or not frame:
        return []
    if isinstance(frame[0], dict) and any(key in frame[0] for key in KEYS):
        return [person for one in frame for person in _people(one)]
    people = [one for one in frame if one] if isinstance(frame[0], list) else [frame]
    return [one for one in people if isinstance(one[0], dict) and {"x", "y"} <= one[0].keys()]


def _landmarks(person: Person) -> Float32:
    sure = next((key for key in CONFIDENCES if key in person[0]), "")
    return np.array([(p["x"], p["y"], p.get(sure, np.nan)) for p in person], np.float32)
