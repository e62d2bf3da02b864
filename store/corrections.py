"""Corrections of a dataset's keypoints: an overlay that never touches what a detector gave.

A dataset has a list of them in its record, and a job keeps the list that its dataset had when it
was made. Whoever reads keypoints gets them with the corrections applied, by `applied` alone.
"""

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from store.capture import Capture
from store.errors import InputError
from store.records import DatasetRecord, FitRecord, LiftRecord

MOST = 5000  # of a dataset: 200 kB, in its record and in that of each of its jobs
FARTHEST = 100_000.0  # pixels from the origin, where the image's size is unknown
BEYOND = 0.5  # of an image's side: so far outside of it a keypoint may be
CERTAIN, GONE = 1.0, 0.0  # the confidence of a keypoint that was put right, and of a removed one


class Place(NamedTuple):
    """A keypoint of a view in a frame."""

    frame: int
    view: int
    keypoint: int


class Correction(NamedTuple):
    """Where a keypoint really is, in pixels; None: nowhere in this image, so it was removed."""

    place: Place
    position: tuple[float, float] | None


Corrections = Sequence[Correction]


def of(
    session: Session, kind: type[DatasetRecord | FitRecord | LiftRecord], identifier: str
) -> list[Correction]:
    """Return the corrections of a dataset, or those that a job was made with, by their places."""
    return in_rows(session.scalar(select(kind.corrections).where(kind.id == identifier)))


def in_rows(rows: Iterable[Sequence[Any]] | None) -> list[Correction]:
    """Return the corrections in a column of a record."""
    return [Correction(Place(*row[:3]), _position(*row[3:])) for row in rows or []]


def columns(corrections: Corrections) -> dict[str, Any]:
    """Return the columns of a record that has these corrections, which have different places.

    The checksum is the same whenever the corrections are, in whatever order they came.
    """
    rows = sorted([*place, *(position or (None, None))] for place, position in corrections)
    return {
        "corrections": rows or None,
        "corrections_count": len(rows),
        "corrections_checksum": hashlib.sha256(orjson.dumps(rows)).hexdigest() if rows else None,
    }


def merged(
    known: Corrections, corrected: Corrections, undone: Iterable[Place]
) -> dict[Place, Correction]:
    """Return corrections after some were undone, and others put in; the last of a place counts.

    Raises ``InputError`` where that makes more of them than a dataset may have.
    """
    by_place = {correction.place: correction for correction in known}
    for place in undone:
        by_place.pop(place, None)
    by_place |= {correction.place: correction for correction in corrected}
    if len(by_place) > MOST:
        raise InputError(
            "correct",
            f"expected {MOST} corrections of a dataset at most, this would make {len(by_place)}: "
            "mend what is wrong so often in the detector, or leave the view out",
        )
    return by_place


def same_keypoints(record: DatasetRecord, read: DatasetRecord) -> bool:
    """Return whether a dataset has the frames and corrections that it had when it was read."""
    return (record.checksum, record.corrections_checksum) == (
        read.checksum,
        read.corrections_checksum,
    )


def check(dataset: DatasetRecord, corrected: Corrections, undone: Sequence[Place]) -> None:
    """Raise ``InputError`` unless places are in the dataset, and positions in or near its images.

    Fields are ``correct/INDEX/...`` and ``undo/INDEX/...``.
    """
    places: set[Place] = set()
    for index, (place, position) in enumerate(corrected):
        _check_place(dataset, place, f"correct/{index}")
        if place in places:
            raise InputError(
                f"correct/{index}", "expected each keypoint of a frame once, this came before"
            )
        places.add(place)
        size = (dataset.image_sizes or [None] * dataset.views)[place.view]
        if position is not None and not _near(position, size):
            where = f"an image of {size[0]} x {size[1]}" if size else "any image"
            raise InputError(
                f"correct/{index}/position",
                f"expected pixels in {where} or near it, got {list(position)}; write null if the "
                "keypoint is not in the image",
            )
    for index, place in enumerate(undone):
        _check_place(dataset, place, f"undo/{index}")


def _check_place(dataset: DatasetRecord, place: Place, field: str) -> None:
    there = zip(
        place._fields, place, (dataset.frames, dataset.views, dataset.keypoints), strict=True
    )
    for name, value, count in there:
        if not 0 <= value < count:
            raise InputError(
                f"{field}/{name}",
                f"expected a {name} from 0 to {count - 1}, as the dataset has, got {value}",
            )


def _near(position: tuple[float, float], size: Sequence[int] | None) -> bool:
    if size is None:
        return all(abs(pixels) <= FARTHEST for pixels in position)
    return all(
        -BEYOND * side <= pixels <= (1 + BEYOND) * side
        for pixels, side in zip(position, size, strict=True)
    )


def applied(capture: Capture, corrections: Corrections, first_frame: int = 0) -> Capture:
    """Return a capture with the corrections of its frames; its arrays change where they can.

    Parameters
    ----------
    corrections
        Of the dataset, whose frame ``first_frame`` is the first of the capture.
    """
    mine = [each for each in corrections if 0 <= each.place.frame - first_frame < capture.frames]
    if not mine:
        return capture
    frames, views, keypoints = np.array([each.place for each in mine]).T
    where = (frames - first_frame, views, keypoints)
    pixels = np.require(capture.keypoints, requirements="W")
    pixels[where] = [values_of(each)[0] for each in mine]
    confidence = capture.confidence
    if confidence is not None:
        confidence = np.require(confidence, requirements="W")
        confidence[where] = [values_of(each)[1] for each in mine]
    return replace(capture, keypoints=pixels, confidence=confidence)


def places_of(corrections: Corrections, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which keypoints (N, K, P) of the first N frames of a dataset are corrected."""
    there = np.zeros(shape, np.bool_)
    for place, _ in corrections:
        if place.frame < len(there):
            there[place] = True
    return there


def values_of(correction: Correction) -> tuple[tuple[float, float], float]:
    """Return what stands in the arrays in place of what was detected: pixels and confidence."""
    if correction.position is None:
        return (math.nan, math.nan), GONE
    return correction.position, CERTAIN


def _position(x: float | None, y: float | None) -> tuple[float, float] | None:
    return None if x is None or y is None else (x, y)
