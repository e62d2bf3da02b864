"""Views of one person each, side by side: common keypoints, common frames."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Capture, Float32, Float64
from fewview.errors import FormatError
from fewview.readers.skeletons import skeleton_of
from fewview.readers.views import Edges, Int64, View, bounded
from fewview.reading_options import Align

SLIGHTLY_ABOVE = 1.1  # peaks of heatmaps that are interpolated


def cleaned(view: View, min_confidence: float) -> tuple[View, list[str]]:
    """Return a view with gaps as NaN and confidences in [0, 1], and what was changed."""
    keypoints, confidence, notes = view.keypoints.copy(), view.confidence, []
    if not view.pixels_from_zero:
        nowhere = (keypoints == 0).all(-1) | (keypoints == -1).all(-1)
        sure = 1.0 if confidence is None else np.nan_to_num(confidence)
        told = nowhere & (np.asarray(sure) > 0)
        if told.any():
            notes.append(f"{view.name}: {int(told.sum())} keypoints at (0, 0) or (-1, -1) are gaps")
        keypoints[nowhere] = np.nan
    gaps = ~np.isfinite(keypoints).all(-1)
    if confidence is not None:
        confidence = np.where(gaps, 0.0, np.nan_to_num(confidence, nan=1.0)).astype(np.float32)
        highest = float(confidence.max(initial=0.0))
        if 1 < highest <= SLIGHTLY_ABOVE:
            notes.append(f"{view.name}: confidences up to {highest:.3f} were clipped to 1")
        elif highest > SLIGHTLY_ABOVE:
            notes.append(
                f"{view.name}: confidences go up to {highest:.4g}, so they were divided by it"
            )
            confidence = confidence / np.float32(highest)
        confidence = np.clip(confidence, 0, 1)
        weak = (confidence < min_confidence) & (confidence > 0)
        if weak.any():
            notes.append(
                f"{view.name}: {int(weak.sum())} detections below {min_confidence:g} are gaps"
            )
        gaps |= (confidence <= 0) | weak
        confidence[gaps] = 0
    keypoints[gaps] = np.nan
    return replace(view, keypoints=keypoints, confidence=confidence), notes


def combined(
    views: Sequence[View], *, align: Align, fps: float | None, skeleton: str | None
) -> Capture:
    """Return the capture of views of one person (M = 1), that were cleaned.

    Raises
    ------
    FormatError
        If keypoints or frames of the views cannot be matched.
    """
    notes: list[str] = []
    notes += [f"{view.name}: {note}" for view in views for note in view.notes]
    views = [_named(view, skeleton, notes) for view in views]
    views = _common_keypoints(views, notes)
    fps = fps or _common_rate(views)
    rows, times = _aligned(views, align, fps, notes)
    first = views[0]
    shape = (len(rows), len(views), first.keypoints.shape[2])
    bounded((*shape, 2), "the views together")
    keypoints = np.full((*shape, 2), np.nan, np.float32)
    confidence = np.zeros(shape, np.float32)
    for v, view in enumerate(views):
        there = rows[:, v] >= 0
        keypoints[there, v] = view.keypoints[rows[there, v], 0]
        if view.confidence is not None:
            confidence[there, v] = view.confidence[rows[there, v], 0]
        else:
            confidence[:, v] = np.isfinite(keypoints[:, v]).all(-1)
    sizes = tuple(view.image_size for view in views)
    return Capture(
        keypoints,
        confidence if any(view.confidence is not None for view in views) else None,
        _truth(views, rows),
        times,
        first.keypoint_names,
        next((view.edges for view in views if view.edges is not None), None),
        tuple(view.name for view in views),
        sizes if any(sizes) else None,
        fps,
        tuple(notes),
    )


def _named(view: View, skeleton: str | None, notes: list[str]) -> View:
    """Return the view with the names and edges of its skeleton, as far as they can be known."""
    count = view.keypoints.shape[2]
    if view.keypoint_names is not None and skeleton is None:
        return view
    known, candidates = skeleton_of(count, skeleton, view.skeletons)
    if known is not None:
        said = f"the {count} keypoints were taken for {known.title}"
        if skeleton is None and said not in notes:
            notes.append(said)
        return replace(view, keypoint_names=known.names, edges=known.edges)
    if candidates:
        said = (
            f"{count} keypoints without names, which may be {' or '.join(candidates)}: say which, "
            f"as in skeleton={candidates[0]!r} (--skeleton {candidates[0]})"
        )
        if said not in notes:
            notes.append(said)
    return view


def _common_keypoints(views: list[View], notes: list[str]) -> list[View]:
    """Return the views with the keypoints that all have, in the order of the first."""
    counts = {view.keypoints.shape[2] for view in views}
    names = [view.keypoint_names for view in views]
    if None in names:
        if len(counts) > 1:
            raise FormatError(
                "the cameras have "
                + ", ".join(f"{view.name} {view.keypoints.shape[2]}" for view in views)
                + " keypoints, and not all have names to match them by; say skeleton= (--skeleton)"
            )
        known = next((each for each in names if each is not None), None)
        return [replace(view, keypoint_names=known) for view in views]
    named = [each for each in names if each is not None]
    in_all = set(named[0]).intersection(*named[1:])
    common = [name for name in named[0] if name in in_all]
    if not common:
        raise FormatError(
            "the cameras have no keypoint of the same name: "
            + "; ".join(f"{v.name}: {', '.join(n[:4])}" for v, n in zip(views, named, strict=True))
        )
    for view, each in zip(views, named, strict=True):
        left = [name for name in each if name not in in_all]
        if left:
            notes.append(f"{view.name}: {', '.join(left)} left out, as not all cameras have them")
    return [_only_keypoints(view, common) for view in views]


def _only_keypoints(view: View, common: list[str]) -> View:
    names = list(view.keypoint_names or ())
    first = {name: place for place, name in reversed(list(enumerate(names)))}
    index = [first[name] for name in common]
    place = {old: new for new, old in enumerate(index)}
    edges: Edges | None = None
    if view.edges is not None:
        edges = tuple((place[a], place[b]) for a, b in view.edges if a in place and b in place)
    return replace(
        view,
        keypoints=view.keypoints[:, :, index],
        confidence=None if view.confidence is None else view.confidence[:, :, index],
        points3d=None if view.points3d is None else view.points3d[:, index],
        keypoint_names=tuple(common),
        edges=edges,
    )


def _aligned(
    views: list[View], align: Align, fps: float | None, notes: list[str]
) -> tuple[Int64, Float64 | None]:
    """Return which frame (N, K) of each view stands in each frame, -1 for none, and times."""
    if align == "time":
        return _by_time(views, fps, notes)
    numbers = common_numbers(views, notes)
    together = np.unique(np.concatenate(numbers))
    rows = np.full((len(together), len(views)), -1)
    for v, own in enumerate(numbers):
        rows[np.searchsorted(together, own), v] = np.arange(len(own))
    for view, own in zip(views, numbers, strict=True):
        if len(own) < len(together):
            notes.append(
                f"{view.name}: has {len(own)} of the {len(together)} frames; the others are gaps"
            )
    times = _own_times(views, rows)
    if fps is None or times is not None:
        return rows, times
    even = bool((np.diff(together) == 1).all())  # then the rate says it all
    return rows, None if even else (together - together[0]) / fps


def common_numbers(views: list[View], notes: list[str]) -> list[Int64]:
    """Return frame numbers (N,) that mean the same in all views."""
    numbers = [view.numbers for view in views]
    first = [int(own[0]) for own in numbers]
    last = [int(own[-1]) for own in numbers]
    shared = min(last) - max(first) + 1
    shortest = min(b - a + 1 for a, b in zip(first, last, strict=True))
    if shared * 2 >= shortest:
        return numbers
    notes.append(
        "frame numbers of the cameras hardly overlap ("
        + ", ".join(f"{v.name} {a} to {b}" for v, a, b in zip(views, first, last, strict=True))
        + "), so each camera's first frame was taken for the same"
    )
    return [own - start for own, start in zip(numbers, first, strict=True)]


def _common_rate(views: list[View]) -> float | None:
    """Return the frames per second that all views tell.

    Raises
    ------
    FormatError
        If they cannot be.
    """
    rates = {view.fps for view in views}
    for rate in rates:
        if rate is not None and not 0 < rate < inf:
            raise FormatError(f"`fps` is {rate}, not above 0")
    return rates.pop() if len(rates) == 1 else None


def _own_times(views: list[View], rows: Int64) -> Float64 | None:
    """Return the times that all views tell, (N,) where equal, else (N, K)."""
    if any(view.times is None for view in views) or (rows < 0).any():
        return None
    times = np.stack(
        [view.times[rows[:, v]] for v, view in enumerate(views) if view.times is not None], axis=1
    )
    return times[:, 0] if (times == times[:, :1]).all() else times


def _by_time(
    views: list[View], fps: float | None, notes: list[str]
) -> tuple[Int64, Float64 | None]:
    """Align to the times of the view with most frames: each takes what is nearest, within half."""
    clocks: list[NDArray[np.float64]] = []
    for view in views:
        if view.times is not None:
            clocks.append(view.times)
        elif rate := fps or view.fps:
            clocks.append(view.numbers / rate)
        else:
            raise FormatError(
                f"{view.name}: tells no times to align by; say fps (--fps), or align='index'"
            )
    if any(np.any(np.diff(clock) <= 0) for clock in clocks):
        raise FormatError("times must rise from frame to frame to align by them")
    reference = max(clocks, key=len)
    half = float(np.median(np.diff(reference))) / 2 if len(reference) > 1 else np.inf
    rows = np.full((len(reference), len(views)), -1)
    for v, (view, clock) in enumerate(zip(views, clocks, strict=True)):
        after = np.clip(np.searchsorted(clock, reference), 1, max(len(clock) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(clock) - 1)
        nearer = np.abs(clock[after] - reference) < np.abs(clock[before] - reference)
        nearest = np.where(nearer, after, before)
        near = np.abs(clock[nearest] - reference) <= half
        rows[near, v] = nearest[near]
        if not near.all():
            notes.append(f"{view.name}: {int((~near).sum())} moments without a frame are gaps")
    return rows, reference - reference[0]


def _truth(views: list[View], rows: Int64) -> Float32 | None:
    """Return the true structure that the first view has, for the frames that it has."""
    truth = views[0].points3d
    if truth is None:
        return None
    out = np.full((len(rows), *truth.shape[1:]), np.nan, np.float32)
    there = rows[:, 0] >= 0
    out[there] = truth[rows[there, 0]]
    return out
