"""Points that have names: each person has some of them, all files and frames have their union.

A joint that a detector did not find is absent from its list, so neither places nor numbers of
points mean anything: names alone do.
"""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError

Point = tuple[float, float, float]  # x, y, confidence; NaN where there is none
Person = Mapping[str, Point]
MOST_NAMES = 2000
# Cells of the arrays for each point of a file: keypoints that few people have take room in all.
SPARSEST, ANYHOW = 64, 2**20


def side_by_side(
    frames: Sequence[Sequence[Person]], what: str
) -> tuple[tuple[str, ...], list[list[Float32 | None]]]:
    """Return the P names that anybody's points have, and everybody (P, 3) in their order.

    Names are in the order in which they first appear. Who has no point takes no place.

    Raises
    ------
    FormatError
        If there are too many names, or nearly everybody lacks nearly all of them; `what` names the
        file.
    """
    names: dict[str, int] = {}
    points, most = 0, max((len(people) for people in frames), default=0)
    for people in frames:
        for person in people:
            points += len(person)
            for name in person:
                names.setdefault(name, len(names))
    cells = len(frames) * most * len(names)
    if len(names) > MOST_NAMES or cells > max(ANYHOW, SPARSEST * points):
        raise FormatError(
            f"{points:,} points have {len(names):,} names, of up to {most:,} people at a time; "
            "names are those of keypoints, the same in all frames",
            place=what,
        )
    return tuple(names), [
        [_placed(person, names) for person in people if person] for people in frames
    ]


def _placed(person: Person, names: Mapping[str, int]) -> Float32:
    values = np.full((len(names), 3), np.nan, np.float32)
    values[[names[name] for name in person]] = list(person.values())
    return values


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
