"""YOLO's pose labels: a text file for each image, a line for each person.

``class cx cy w h``, then x, y, confidence of each keypoint, all but the first as shares of the
image, then optional numbers of the detector: its confidence, the number of the track. Images
without any person have no file.
"""

from itertools import product
from pathlib import Path

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.names import frame_number
from fewview.readers.skeletons import SKELETONS
from fewview.readers.sources import MAX_FRAME, Source, check_size, yolo_numbers
from fewview.readers.views import View, packed

BOX = 5  # numbers before the keypoints
USUAL = {len(skeleton.names) for skeleton in SKELETONS.values()}


def fits(source: Source) -> bool:
    """Whether the files of a camera's frames are lines of such numbers."""
    return bool(source.frames) and source.frames[0].suffix.lower() == ".txt"


def read(source: Source) -> list[View]:
    """Return the view of a folder with a file for each image.

    Raises
    ------
    FormatError
        If a line is of other numbers.
    """
    frames = [_people(path) for path in source.frames]
    keypoints, confidence = packed(frames, str(source))
    named = [number[1] for path in source.frames if (number := frame_number(path.name))]
    numbers = named if len(set(named)) == len(frames) else range(len(frames))
    order = np.argsort(numbers)
    return [
        View(
            source.name,
            keypoints[order],
            np.array(numbers, np.int64)[order],
            None if np.isnan(confidence).all() else confidence[order],
            skeletons=("coco-17", "hands-21"),
        )
    ]


def _people(path: Path) -> list[Float32]:
    check_size(path, MAX_FRAME)
    people = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        if line.strip():
            numbers = yolo_numbers(line)
            if numbers is None:
                raise FormatError(f"{path}: no line of YOLO's pose labels: {line[:60]!r}")
            people.append(_points(numbers))
    return people


def _points(numbers: list[float]) -> Float32:
    """Return (P, 3): of what the count of numbers may mean, a skeleton that is known first."""
    count = len(numbers) - BOX
    meant = [
        (dimensions, (count - added) // dimensions)
        for dimensions, added in product((3, 2), (0, 1, 2))
        if (count - added) % dimensions == 0
    ]
    dimensions, points = next((each for each in meant if each[1] in USUAL), meant[0])
    values = np.array(numbers[BOX : BOX + dimensions * points], np.float32).reshape(points, -1)
    return np.pad(values, ((0, 0), (0, 3 - dimensions)), constant_values=np.nan)
