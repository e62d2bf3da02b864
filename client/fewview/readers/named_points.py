"""Points that have names: each person has some of them, all files and frames have their union.

A joint that a detector did not find is absent from its list, so neither places nor numbers of
points mean anything: names alone do.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Float32
from fewview.errors import FormatError

Point = tuple[float, float, float]  # x, y, confidence; NaN where there is none
Person = Mapping[str, Point]
MOST_NAMES = 2000
# Cells of the arrays for each point of a file: keypoints that few people have take room in all.
SPARSEST, ANYHOW = 64, 2**20


def side_by_side(
    frames: Iterable[Sequence[Person]], what: str
) -> tuple[tuple[str, ...], list[list[Float32 | None]]]:
    """Return the P names that anybody's points have, and everybody (P, 3) in their order.

    Names are in the order in which they first appear. Who has no point takes no place. Frames are
    asked for one after the other, and what they hold is kept as arrays.

    Raises
    ------
    FormatError
        If there are too many names, or nearly everybody lacks nearly all of them; `what` names the
        file.
    """
    names: dict[str, int] = {}
    kept: list[list[tuple[NDArray[np.intp], Float32]]] = []
    points, most = 0, 0
    for people in frames:
        for person in people:
            points += len(person)
            for name in person:
                names.setdefault(name, len(names))
        most = max(most, len(people))
        kept.append(
            [
                (
                    np.array([names[name] for name in person], np.intp),
                    np.array(list(person.values()), np.float32),
                )
                for person in people
                if person
            ]
        )
        if len(names) > MOST_NAMES:
            break
    cells = len(kept) * most * len(names)
    if len(names) > MOST_NAMES or cells > max(ANYHOW, SPARSEST * points):
        raise FormatError(
            f"{points:,} points have {len(names):,} names, of up to {most:,} people at a time; "
            "names are those of keypoints, the same in all frames",
            place=what,
        )
    return tuple(names), [
        [_placed(places, values, len(names)) for places, values in people] for people in kept
    ]


def _placed(places: NDArray[np.intp], values: Float32, count: int) -> Float32:
    placed = np.full((count, 3), np.nan, np.float32)
    placed[places] = values
    return placed


def people_among(points: Iterable[tuple[Hashable, str, Point]]) -> list[dict[str, Point]]:
    """Return the people whose points an image shows.

    Parameters
    ----------
    points
        Of each point whom it belongs to, its name, and where it is. Where a name comes again, it is
        the next person's.
    """
    people: dict[tuple[Hashable, int], dict[str, Point]] = {}
    seen: Counter[tuple[Hashable, str]] = Counter()
    for group, name, point in points:
        people.setdefault((group, seen[group, name]), {})[name] = point
        seen[group, name] += 1
    return list(people.values())
