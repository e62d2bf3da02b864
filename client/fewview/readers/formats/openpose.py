"""OpenPose: a JSON file for each frame of each camera, with its `people`.

People are listed in any order, and their number changes; where `{}` holds somebody's place
(Pose2Sim writes so after it has associated people), places are people. Bodies are read, and hands
where there are no bodies.
"""

from typing import Any

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.sources import Source
from fewview.readers.views import View, packed

MIDDLE, NECK, HIPS = 8, 1, [9, 12]  # of BODY_25, which files do not name; BODY_25B has others
PARTS = ("pose_keypoints_2d", "hand_right_keypoints_2d", "hand_left_keypoints_2d")


def fits(source: Source) -> bool:
    """Whether this is a frame with `people`, or many of them."""
    content = source.json
    if not isinstance(content, dict) or not isinstance(content.get("people"), list):
        return False
    return all(isinstance(person, dict) for person in content["people"])


def read(source: Source) -> list[View]:
    """Return the view of a folder of frames, or of one frame's file.

    Raises
    ------
    FormatError
        If a file is no frame of OpenPose, or no person was detected.
    """
    contents = list(source.frames_json()) if source.frames else [source.json]
    frames = [_people(content, source) for content in contents]
    part = next(
        (p for p in PARTS if any(_of(person, p) for people in frames for person in people)), ""
    )
    placed = any(not person for people in frames for person in people)
    detections = [[_keypoints(_of(person, part), source) for person in people] for people in frames]
    keypoints, confidence = packed(detections, str(source))
    numbers = _numbers(source, len(frames))
    notes = []
    if any(_of(person, other) for people in frames for person in people for other in PARTS[1:]):
        if part == PARTS[0]:
            notes.append("hands are in the files, and were left out: bodies are read")
        else:
            notes.append(f"no bodies are in the files: {part.split('_')[1]} hands are read")
    return [
        View(
            source.name.removesuffix("_json"),
            keypoints,
            numbers,
            confidence,
            people=tuple(map(str, range(keypoints.shape[1]))) if placed else None,
            notes=tuple(notes),
            skeletons=("body-25",) if _has_middle_of_hips(keypoints) else (),
        )
    ]


def _has_middle_of_hips(keypoints: Float32) -> bool:
    """Whether 25 keypoints (N, people, 25, 2) are BODY_25's: MidHip lies between the hips."""
    if keypoints.shape[2] != 25:
        return False
    shown = np.where(keypoints == 0, np.nan, keypoints)
    off = np.linalg.norm(shown[:, :, MIDDLE] - shown[:, :, HIPS].mean(2), axis=-1)
    share = off / np.linalg.norm(shown[:, :, MIDDLE] - shown[:, :, NECK], axis=-1)
    share = share[np.isfinite(share)]
    return bool(len(share)) and float(np.median(share)) < 0.15


def _people(content: Any, source: Source) -> list[dict[str, Any]]:
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise FormatError("one of its files is no frame of OpenPose", place=source)
    return people


def _of(person: dict[str, Any], part: str) -> Any:
    """Return the numbers of a part; before version 1.2 its name had no 2D in it."""
    return person.get(part) or person.get(part.removesuffix("_2d"))


def _keypoints(numbers: Any, source: Source) -> Float32 | None:
    """Return (P, 3) of x, y, confidence; None if there is no person."""
    if not numbers:
        return None
    try:
        return np.array(numbers, np.float32).reshape(-1, 3)
    except (ValueError, TypeError) as error:
        raise FormatError("keypoints are no triples of x, y, confidence", place=source) from error


def _numbers(source: Source, count: int) -> "np.ndarray[Any, np.dtype[np.int64]]":
    found = [frame_number(path.name) for path in source.frames]
    numbers = [number[1] for number in found if number is not None]
    if len(numbers) == count and len(set(numbers)) == count:
        return np.array(numbers, np.int64)
    return np.arange(count)
