"""One person of those that a camera detected, followed over the frames."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.views import Int64, View
from fewview.reading_options import Person

MEMORY = 300  # frames after which somebody who was lost is not looked for any more
NEAR, WIDENING, FAR = 0.75, 0.05, 2.0  # of a body's size: a step, more for each frame lost, at most


@dataclass
class Track:
    """Somebody who is followed.

    Attributes
    ----------
    frames, places
        Where they were seen, and at which places of the frames' lists.
    last
        (P, 2) where each keypoint was last.
    """

    last: Float32
    frames: list[int] = field(default_factory=list)
    places: list[int] = field(default_factory=list)


def pick(views: Sequence[View], person: Person | Sequence[Person]) -> tuple[list[View], list[str]]:
    """Return each view with one person, M = 1, and what is to be said of the choice.

    Raises
    ------
    FormatError
        If there is no such person.
    """
    if isinstance(person, str) and "," in person and not _known(views, person):
        person = [part.strip() for part in person.split(",")]
    if not isinstance(person, str | int):
        if len(person) != len(views):
            raise FormatError(f"person: {len(person)} were named for {len(views)} cameras")
        picked = [pick([view], one) for view, one in zip(views, person, strict=True)]
        return [view for (view,), _ in picked], [note for _, notes in picked for note in notes]
    placed = any(view.people is not None and len(view.people) > 1 for view in views)
    # Where places are people in one camera's files, they are in those of the others.
    views = [
        replace(view, people=tuple(map(str, range(view.keypoints.shape[1]))))
        if placed and view.people is None and _counted(views)
        else view
        for view in views
    ]
    if all(view.people is not None for view in views):
        return _by_name(views, person)
    chosen, notes = [], []
    for view in views:
        if view.people is not None or view.keypoints.shape[1] == 1:
            names = view.people or ("0",)
            (one,), said = _by_name([replace(view, people=names)], person)
            notes += said
        else:
            one, said_of_one = _followed(view, person)
            notes.append(said_of_one)
        chosen.append(one)
    if sum(view.keypoints.shape[1] > 1 for view in views) > 1:
        notes.append(
            "people were followed in each camera on its own: see that all show the same one, or "
            "choose with person="
        )
    return chosen, notes


def _known(views: Sequence[View], name: str) -> bool:
    return any(name in (view.people or ()) for view in views)


def _counted(views: Sequence[View]) -> bool:
    """Whether the names of all people that have names are their places, 0, 1, ..."""
    return all(
        name == str(place)
        for view in views
        for place, name in enumerate(view.people or ())
        if len(view.people or ()) > 1
    )


def seen(view: View) -> NDArray[np.float64]:
    """Return how much of each person (N, M) is seen: the sum of confidences."""
    observed: NDArray[np.bool_] = np.all(np.isfinite(view.keypoints), axis=-1)
    if view.confidence is None:
        return np.asarray(observed.sum(-1), np.float64)
    weight = np.clip(np.nan_to_num(view.confidence, nan=1.0), 0, 1)
    total: NDArray[np.float64] = np.where(observed, weight, 0.0).sum(-1, dtype=np.float64)
    return total


def _by_name(views: Sequence[View], person: Person) -> tuple[list[View], list[str]]:
    """Pick somebody who has a name, the same in all views: the one seen most if it is left open."""
    totals: dict[str, float] = {}
    for view in views:
        for name, much in zip(view.people or (), seen(view).sum(0), strict=True):
            totals[name] = totals.get(name, 0.0) + float(much)
    names = list(totals)
    if person == "auto":
        if all(view.keypoints.shape[1] == 1 for view in views):
            return list(views), []
        name = max(names, key=lambda each: totals[each])
    elif isinstance(person, str) and person in names:
        name = person
    elif str(person).isdigit() and int(person) < len(names):
        name = names[int(person)]
    else:
        raise FormatError(f"there is no person {person!r}; there are {', '.join(names) or 'none'}")
    share = totals[name] / max(sum(totals.values()), 1e-9)
    notes = []
    if len(names) > 1:
        notes.append(
            f"{len(names)} people or animals ({', '.join(names[:6])}{', ...' * (len(names) > 6)}): "
            f"{name!r} was taken, {share:.0%} of all that was seen"
        )
    return [_only(view, (view.people or ()), name) for view in views], notes


def _only(view: View, people: tuple[str, ...], name: str) -> View:
    """Return the view with one person, who may never be in it."""
    if name in people:
        place = people.index(name)
        return _with(view, np.full(len(view.keypoints), place), name)
    if len(people) == 1 and people[0] == "":
        return _with(view, np.zeros(len(view.keypoints), np.int64), name)
    return _with(view, np.full(len(view.keypoints), -1), name)


def _with(view: View, places: Int64, name: str) -> View:
    """Return the view with who is at these places (N,), NaN where -1."""
    frames, absent = np.arange(len(places)), places < 0
    keypoints = view.keypoints[frames, places][:, None]
    keypoints[absent] = np.nan
    confidence = None if view.confidence is None else view.confidence[frames, places][:, None]
    if confidence is not None:
        confidence[absent] = np.nan
    return replace(view, keypoints=keypoints, confidence=confidence, people=(name,))


def _followed(view: View, person: Person) -> tuple[View, str]:
    """Follow people from frame to frame and pick one: seen most, or mostly at a place in lists."""
    tracks, amount = follow(view), seen(view)
    much = [float(amount[t.frames, t.places].sum()) for t in tracks]
    order = sorted(range(len(tracks)), key=lambda i: -much[i])
    if person != "auto":
        if not str(person).isdigit():
            raise FormatError(f"{view.name}: people have no names there; choose one by a number")
        order = [i for i in order if _place(tracks[i].places) == int(person)]
        if not order:
            raise FormatError(
                f"{view.name}: nobody is number {person} for long; at most "
                f"{view.keypoints.shape[1]} people are detected at once"
            )
    track = tracks[order[0]]
    present = int((amount.max(-1) > 0).sum())
    said = (
        f"{view.name}: up to {view.keypoints.shape[1]} people at once; one was followed through "
        f"{len(track.frames)} of the {present} frames that show anybody"
    )
    places = np.full(len(view.keypoints), -1)
    places[track.frames] = track.places
    return _with(view, places, "0"), said


def _place(places: list[int]) -> int:
    return int(np.bincount(places).argmax())


def follow(view: View) -> list[Track]:
    """Link the people of each frame to those before them: nearest first, keypoint by keypoint."""
    tracks: list[Track] = []
    present = seen(view) > 0
    for frame, keypoints in enumerate(view.keypoints):
        free = [int(place) for place in np.flatnonzero(present[frame])]
        alive = [track for track in tracks if frame - track.frames[-1] <= MEMORY]
        pairs = sorted(
            (distance, i, place)
            for i, track in enumerate(alive)
            for place in free
            if (distance := _distance(track, keypoints[place], frame)) is not None
        )
        taken: set[int] = set()
        for _, i, place in pairs:
            if place in free and i not in taken:
                taken.add(i)
                free.remove(place)
                _extend(alive[i], keypoints[place], frame, place)
        for place in free:
            track = Track(keypoints[place].copy())
            _extend(track, keypoints[place], frame, place)
            tracks.append(track)
    return tracks


def _extend(track: Track, keypoints: Float32, frame: int, place: int) -> None:
    known = np.isfinite(keypoints).all(-1)
    track.last[known] = keypoints[known]
    track.frames.append(frame)
    track.places.append(place)


def _distance(track: Track, keypoints: Float32, frame: int) -> float | None:
    """Return how far off somebody is, in sizes of the body; None if too far."""
    known = np.isfinite(track.last).all(-1)
    here = np.isfinite(keypoints).all(-1)
    both = known & here
    size = float(np.ptp(track.last[known], axis=0).max()) or 1.0
    if both.any():
        gap = float(np.median(np.linalg.norm(track.last[both] - keypoints[both], axis=-1)))
    else:
        gap = float(np.linalg.norm(track.last[known].mean(0) - keypoints[here].mean(0)))
    reach = min(FAR, NEAR + WIDENING * (frame - track.frames[-1] - 1))
    return gap / size if gap <= reach * size else None
