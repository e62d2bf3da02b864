"""YOLO's pose labels: a text file for each image, a line for each person.

``class cx cy w h``, then x, y and often confidence of each keypoint, all but the first as shares of
the image, then optional numbers of the detector: its confidence, the number of the track. Images
without any person have no file.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.skeletons import SKELETONS
from fewview.readers.sources import MAX_FRAME, Source, check_size, yolo_numbers
from fewview.readers.views import View, packed, unseen

BOX = 5  # numbers before the keypoints
ADDED = ("confidence", "track")  # the numbers after them, where there are all
REACH = 0.75  # of a box's sides, to where keypoints lie from its centre: half a side, and some more
USUAL = {len(skeleton.names) for skeleton in SKELETONS.values()}


def fits(source: Source) -> bool:
    """Whether the files of a camera's frames are lines of such numbers."""
    return bool(source.frames) and source.frames[0].suffix.lower() == ".txt"


def read(source: Source) -> list[View]:
    """Return the view of a folder with a file for each image.

    Raises
    ------
    FormatError
        If a line is of other numbers, or lines are of people of unlike numbers of keypoints.
    """
    frames = [_lines(path) for path in source.frames]
    lines = [line for frame in frames for line in frame]
    dimensions, points = _layout(lines, str(source)) if lines else (3, 0)
    people = [[_keypoints(line, dimensions, points) for line in frame] for frame in frames]
    keypoints, confidence = packed(people, str(source))
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


def _lines(path: Path) -> list[Float32]:
    check_size(path, MAX_FRAME)
    lines = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        if line.strip():
            numbers = yolo_numbers(line)
            if numbers is None:
                raise FormatError(f"no line of YOLO's pose labels: {line[:60]!r}", place=path)
            lines.append(np.array(numbers, np.float32))
    return lines


def _layout(lines: Sequence[Float32], what: str) -> tuple[int, int]:
    """Return the numbers of each keypoint, 2 or 3, and how many keypoints there are.

    Several fit a count of numbers. By the right ones, most keypoints lie in the boxes of their
    people; where several do as well, a skeleton that is known comes first.

    Raises
    ------
    FormatError
        If none fit all lines; `what` names the folder.
    """
    counts = {len(line) - BOX for line in lines}
    fewest, most = min(counts), max(counts)
    meant = [
        (dimensions, points)
        for dimensions in (3, 2)
        for points in range(2, fewest // dimensions + 1)
        if most - dimensions * points <= len(ADDED)
    ]
    ranks = {}
    for dimensions, points in meant:
        whole = BOX + dimensions * points + len(ADDED)
        if all(line[-1].is_integer() for line in lines if len(line) == whole):
            share = round(_share_inside(lines, dimensions, points), 2)
            ranks[dimensions, points] = share, points in USUAL, dimensions, points
    if not ranks:
        raise FormatError(
            f"lines have {fewest + BOX} to {most + BOX} numbers; write people of one kind",
            place=what,
        )
    return max(ranks, key=lambda each: ranks[each])


def _share_inside(lines: Sequence[Float32], dimensions: int, points: int) -> float:
    """Return the share of the keypoints that are seen which lie in their boxes, or near."""
    values = np.array([line[: BOX + dimensions * points] for line in lines])
    centre, sides = values[:, None, 1:3], values[:, None, 3:BOX]
    keypoints = values[:, BOX:].reshape(len(lines), points, dimensions)[..., :2]
    inside = (np.abs(keypoints - centre) <= REACH * sides).all(-1)
    seen = ~unseen(keypoints)
    return float(inside[seen].mean()) if seen.any() else 0.0


def _keypoints(line: Float32, dimensions: int, points: int) -> Float32:
    """Return (P, 3): x, y, confidence, NaN where there is none."""
    values = line[BOX : BOX + dimensions * points].reshape(points, dimensions)
    return np.pad(values, ((0, 0), (0, 3 - dimensions)), constant_values=np.nan)
