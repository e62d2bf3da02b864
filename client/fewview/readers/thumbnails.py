"""Whom each camera shows, to choose by looking: a small picture of everybody."""

from collections.abc import Sequence

import numpy as np

from fewview.capture import Float32, SeenPerson, ViewPeople, located
from fewview.readers.people import seen, tracks_of
from fewview.readers.views import Int64, View

MOST = 12  # people of a view: beyond these they are hardly seen
COMPARED = 200  # frames, to see whether somebody was picked


def people_of(
    views: Sequence[View], picked: Sequence[View], called: Sequence[View], y: str
) -> tuple[ViewPeople, ...] | None:
    """Return whom each view shows; None where no view shows several.

    Parameters
    ----------
    views
        With all people, cleaned.
    picked
        The same with one person each, in the same pixels.
    called
        The same, with the edges of their skeletons.
    y
        Whether y goes "down" or "up" in all of them.
    """
    if all(view.keypoints.shape[1] == 1 for view in views):
        return None
    upright = np.array((1, -1 if y == "up" else 1), np.float32)
    return tuple(
        ViewPeople(_people_in(view, one.keypoints[:, 0], upright), known.edges or ())
        for view, one, known in zip(views, picked, called, strict=True)
    )


def _people_in(view: View, picked: Float32, upright: Float32) -> tuple[SeenPerson, ...]:
    """Return those of a view under the numbers by which `pick` chooses them in it alone."""
    listed: list[tuple[int, str, Int64, Int64]] = []  # number, name, frames, places in these
    if view.people is not None or view.keypoints.shape[1] == 1:
        there = seen(view) > 0
        names = view.people or ("",)
        for place, name in enumerate(names):
            rows = np.flatnonzero(there[:, place])
            listed.append((place, name, rows, np.full(len(rows), place)))
        listed.sort(key=lambda each: -len(each[2]))
    else:
        tracks = sorted(tracks_of([view]), key=lambda track: -track.amount)
        listed = [(n, "", track.rows, track.places) for n, track in enumerate(tracks)]
    people = []
    for number, name, rows, places in [each for each in listed if len(each[2])][:MOST]:
        known = located(view.keypoints[rows, places]).sum(-1)
        fullest = np.flatnonzero(known == known.max())
        best = fullest[len(fullest) // 2]
        shown = view.keypoints[rows[best], places[best]] * upright
        some = slice(None, None, -(-len(rows) // COMPARED))
        same = view.keypoints[rows[some], places[some]] == picked[rows[some]]
        people.append(SeenPerson(number, name, len(rows), shown, bool(same.all(-1).any())))
    return tuple(people)
