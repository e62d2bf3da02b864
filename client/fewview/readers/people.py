"""One person of those that cameras detected, followed over the frames, the same in all."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Float32, located
from fewview.errors import FormatError
from fewview.geometry.placing import row_medians
from fewview.readers.large_arrays import blocks, built
from fewview.readers.matching import SURE, Track, same_people
from fewview.readers.timing import common_numbers
from fewview.readers.views import Int64, View
from fewview.reading_options import Person

MAX_PEOPLE = 256  # in a frame: following takes their number squared
MEMORY = 300  # frames after which somebody who was lost is not looked for any more
NEAR, WIDENING, FAR = 0.75, 0.05, 2.0  # of a body's size: a step, more for each frame lost, at most


@dataclass
class Followed:
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
    """Return each view with one person, M = 1, and notes about the choice.

    Raises
    ------
    FormatError
        If there is no such person.
    """
    if isinstance(person, str) and "," in person and not _known(views, person):
        person = [part.strip() for part in person.split(",")]
    if not isinstance(person, str | int):
        if len(person) != len(views):
            raise FormatError(f"{len(person)} were named for {len(views)} cameras", option="person")
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
    several = any(view.keypoints.shape[1] > 1 for view in views)
    if not several:
        views = [replace(v, people=("",)) if v.people is None else v for v in views]
    if not several or (person != "auto" and all(view.people is not None for view in views)):
        return _by_name(views, person)
    return _matched(views, person)


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
    total = np.empty(view.keypoints.shape[:2])
    for block in blocks(view.keypoints, view.confidence):
        observed = located(view.keypoints[block])
        if view.confidence is None:
            total[block] = observed.sum(-1)
        else:
            weight = np.clip(np.nan_to_num(view.confidence[block], nan=1.0), 0, 1)
            total[block] = np.where(observed, weight, 0.0).sum(-1, dtype=np.float64)
    return total


def _by_name(views: Sequence[View], person: Person) -> tuple[list[View], list[str]]:
    """Pick somebody who has a name, the same in all views: the one seen most if it is left open."""
    if person == "auto" and all(view.keypoints.shape[1] == 1 for view in views):
        return list(views), []
    totals: dict[str, float] = {}
    for view in views:
        for name, much in zip(view.people or (), seen(view).sum(0), strict=True):
            totals[name] = totals.get(name, 0.0) + float(much)
    names = list(totals)
    if person == "auto":
        name = max(names, key=lambda each: totals[each])
    elif isinstance(person, str) and person in names:
        name = person
    elif str(person).isdigit() and int(person) < len(names):
        name = names[int(person)]
    else:
        there = f"there are {', '.join(names)}" if any(names) else "there is one, without a name"
        raise FormatError(f"there is no person {person!r}; {there}", option="person")
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

    def of_one(array: Float32) -> Float32:
        def part(block: slice) -> Float32:
            here = places[block]
            own = array[block][np.arange(len(here)), here]
            own[here < 0] = np.nan
            return own[:, None]

        return built(part, array)

    confidence = None if view.confidence is None else of_one(view.confidence)
    return replace(view, keypoints=of_one(view.keypoints), confidence=confidence, people=(name,))


def _matched(views: Sequence[View], person: Person) -> tuple[list[View], list[str]]:
    """Follow people in each camera, find who is the same in all, and pick one."""
    for view in views:
        if view.people is None and view.keypoints.shape[1] > MAX_PEOPLE:
            raise FormatError(
                f"{view.keypoints.shape[1]:,} people in one frame are more than the "
                f"{MAX_PEOPLE} that are followed; have the detector give the surest alone",
                place=view.name,
            )
    tracks = tracks_of(views)
    if len({view.keypoints.shape[2] for view in views}) == 1:
        people, sureness = same_people(tracks, len(views))
    else:
        people, sureness = [[i] for i in range(len(tracks))], {}
    sure = _sureness(people[0], tracks, sureness, len(views)) if people else 0.0
    if sure < SURE and all(view.people is not None for view in views):
        return _by_name(views, person)
    if person != "auto" and not str(person).isdigit():
        raise FormatError(
            f"{person!r}: people have no names there; choose by a number", option="person"
        )
    number = 0 if person == "auto" else int(person)
    if number >= len(people):
        raise FormatError(f"there is no person {number}; {len(people)} were found", option="person")
    who = people[number]
    chosen, notes = [], []
    for v, view in enumerate(views):
        mine = [tracks[i] for i in who if tracks[i].view == v]
        if not mine:  # the person there is unknown
            others = [t for t in tracks if t.view == v]
            mine = sorted(others, key=lambda track: -track.amount)[number : number + 1]
        places = np.full(len(view.keypoints), -1)
        for track in mine:
            places[track.rows] = track.places
        chosen.append(_with(view, places, "0"))
        if view.keypoints.shape[1] > 1:
            notes.append(_note_of(view, places))
    return chosen, [*notes, *_certainty(views, tracks, who, sureness)]


def tracks_of(views: Sequence[View]) -> list[Track]:
    """Return everybody who is seen in each camera, under numbers that mean the same in all."""
    tracks = []
    for v, (view, numbers) in enumerate(zip(views, common_numbers(list(views), []), strict=True)):
        amount = seen(view)
        if view.people is None:
            found = [(np.array(one.frames), np.array(one.places)) for one in follow(view)]
        else:
            rows = [np.flatnonzero(amount[:, place] > 0) for place in range(amount.shape[1])]
            found = [(own, np.full(len(own), place)) for place, own in enumerate(rows)]
        tracks += [
            Track(
                v,
                rows,
                places,
                numbers[rows],
                view.keypoints[rows, places].astype(np.float64),
                float(amount[rows, places].sum()),
            )
            for rows, places in found
            if len(rows)
        ]
    return tracks


def _sureness(
    who: Sequence[int], tracks: Sequence[Track], sureness: dict[tuple[int, int], float], views: int
) -> float:
    """Return how sure it is that somebody is the same in all cameras: the weakest of the links.

    Of all links, the surest that join the cameras count.
    """
    joined = {v: {v} for v in range(views)}
    for (i, j), sure in sorted(sureness.items(), key=lambda each: -each[1]):
        one, other = (joined[tracks[k].view] for k in (i, j))
        if i in who and j in who and one is not other:
            one |= other
            joined |= dict.fromkeys(other, one)
            if len(one) == views:
                return sure
    return 0.0


def _note_of(view: View, places: Int64) -> str:
    shown = int((places >= 0).sum())
    named = view.people is not None and len(set(places[places >= 0].tolist())) == 1
    if named and view.people is not None and view.people[places.max()]:
        return f"{view.name}: {view.people[places.max()]!r} was taken, in {shown} frames"
    present = int((seen(view).max(-1) > 0).sum())
    return (
        f"{view.name}: up to {view.keypoints.shape[1]} people at once; one was followed through "
        f"{shown} of the {present} frames that show anybody"
    )


def _certainty(
    views: Sequence[View],
    tracks: Sequence[Track],
    who: Sequence[int],
    sureness: dict[tuple[int, int], float],
) -> list[str]:
    """Return a sentence on how sure it is that all cameras show the same person."""
    if len(views) < 2:
        return []
    found = {tracks[i].view for i in who}
    unsure = sorted({views[v].name for v in range(len(views)) if v not in found})
    remedy = (
        "see that all show the same one, or choose for each camera, as in person=[0, 1, 0] "
        "(--person 0,1,0)"
    )
    if unsure:
        return [f"who is the same person in {', '.join(unsure)} cannot be known: {remedy}"]
    least = _sureness(who, tracks, sureness, len(views))
    if least < SURE:
        return [
            "that all cameras show the same person is not sure: another choice fits "
            f"{1 - least:.0%} as well; {remedy}"
        ]
    return [
        "all cameras show the same person, by their epipolar geometry: the next best choice "
        f"fits {1 - least:.0%} as well"
    ]


def follow(view: View) -> list[Followed]:
    """Link the people of each frame to those before them: nearest first, keypoint by keypoint."""
    tracks: list[Followed] = []
    alive: list[Followed] = []
    present = seen(view) > 0
    for frame, keypoints in enumerate(view.keypoints):
        free = dict.fromkeys(np.flatnonzero(present[frame]).tolist())
        alive = [track for track in alive if frame - track.frames[-1] <= MEMORY]
        taken: set[int] = set()
        for i, place in _near(alive, keypoints, list(free), frame):
            if place in free and i not in taken:
                taken.add(i)
                del free[place]
                _extend(alive[i], keypoints[place], frame, place)
        for place in free:
            track = Followed(keypoints[place].copy())
            _extend(track, keypoints[place], frame, place)
            tracks.append(track)
            alive.append(track)
    return tracks


def _extend(track: Followed, keypoints: Float32, frame: int, place: int) -> None:
    known = located(keypoints)
    track.last[known] = keypoints[known]
    track.frames.append(frame)
    track.places.append(place)


def _near(
    tracks: Sequence[Followed], keypoints: Float32, places: Sequence[int], frame: int
) -> list[tuple[int, int]]:
    """Return which of T tracks may go on at which of M places of a frame, the nearest first.

    Near is in sizes of the body: the median over the keypoints that both have, else from centre to
    centre.
    """
    if not tracks or not places:
        return []
    last = np.stack([track.last for track in tracks])  # (T, P, 2)
    here = keypoints[places]  # (M, P, 2)
    sizes = np.fmax.reduce(last, axis=1) - np.fmin.reduce(last, axis=1)
    size = sizes.max(-1)
    size[size == 0] = 1
    apart = np.linalg.norm(last[:, None] - here, axis=-1)  # (T, M, P)
    gaps = row_medians(apart.reshape(-1, apart.shape[-1])).reshape(apart.shape[:2])
    for i, m in np.argwhere(np.isnan(gaps)):
        gaps[i, m] = np.linalg.norm(_centre(last[i]) - _centre(here[m]))
    lost = np.array([frame - track.frames[-1] - 1 for track in tracks])
    reach = np.minimum(FAR, NEAR + WIDENING * lost)
    distances = gaps / size[:, None]
    pairs = np.argwhere(distances <= reach[:, None])
    order = np.argsort(distances[tuple(pairs.T)], kind="stable")
    return [(i, places[m]) for i, m in pairs[order].tolist()]


def _centre(keypoints: Float32) -> Float32:
    centre: Float32 = keypoints[located(keypoints)].mean(0)
    return centre
