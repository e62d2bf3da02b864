"""MediaPipe: landmarks of each frame as JSON, under the names that people give them.

Landmarks are dictionaries of x, y and visibility. Where they are shares of the image, its size is
in the file (`width`, `height`) or is told.
"""

from typing import Any

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.sources import Source
from fewview.readers.views import View, packed

KEYS = ("landmarks", "pose_landmarks", "poseLandmarks", "landmark", "hand_landmarks")
SHARES = 3.0  # pixels go further than this many images


def fits(source: Source) -> bool:
    """Whether the first frames hold landmarks."""
    frames = _frames(source.json)
    return any(_people(frame) for frame in frames[:1000])


def read(source: Source) -> list[View]:
    """Return the view of a file.

    Raises
    ------
    FormatError
        If landmarks are broken.
    """
    content = source.json
    frames = _frames(content)
    try:
        people = [[_landmarks(one) for one in _people(frame)] for frame in frames]
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{source}: landmarks without x and y ({error!r})") from error
    keypoints, confidence = packed(people, str(source))
    told = content if isinstance(content, dict) else {}
    width, height = (told.get(key, told.get(f"image_{key}")) for key in ("width", "height"))
    fps = told.get("fps")
    return [
        View(
            source.name,
            keypoints,
            np.arange(len(frames)),
            confidence,
            image_size=(int(width), int(height)) if width and height else None,
            fps=float(fps) if fps else None,
            shares=bool(np.nanmax(np.abs(keypoints)) <= SHARES),
            notes=("landmarks without a visibility have the confidence 1",)
            if np.isnan(confidence[np.isfinite(keypoints[..., 0])]).all()
            else (),
        )
    ]


def _frames(content: Any) -> list[Any]:
    if isinstance(content, dict):
        content = content.get("frames", content.get("results", content))
        content = [content] if isinstance(content, dict) else content
    return content if isinstance(content, list) else []


def _people(frame: Any) -> list[list[Any]]:
    """Return the landmarks of each person of a frame: one list, or a list of lists."""
    while isinstance(frame, dict):
        frame = next((frame[key] for key in KEYS if frame.get(key)), None)
    if not isinstance(frame, list) or not frame:
        return []
    if isinstance(frame[0], dict) and any(key in frame[0] for key in KEYS):
        return [person for one in frame for person in _people(one)]
    people = [one for one in frame if one] if isinstance(frame[0], list) else [frame]
    return [one for one in people if isinstance(one[0], dict) and {"x", "y"} <= one[0].keys()]


def _landmarks(person: list[Any]) -> Float32:
    return np.array([(p["x"], p["y"], p.get("visibility", np.nan)) for p in person], np.float32)
