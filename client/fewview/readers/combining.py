"""Views of one person each, side by side: common keypoints, common frames."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from fewview.capture import Capture, Float32, located
from fewview.errors import FormatError
from fewview.readers.skeletons import edges_of, skeleton_of
from fewview.readers.timing import together
from fewview.readers.views import Edges, Int64, View, bounded, unseen
from fewview.reading_options import Align

SLIGHTLY_ABOVE = 1.1  # peaks of heatmaps that are interpolated
FEW = 0.01  # of the confidences of a camera: so many above 1 are errors, and no other scale


def cleaned(view: View, min_confidence: float) -> tuple[View, list[str]]:
    """Return a view with gaps as NaN and confidences in [0, 1], and what was changed.

    Its arrays are those of `view`, which are changed: a copy of an hour takes half a gigabyte.
    """
    keypoints, confidence, notes = np.require(view.keypoints, requirements="W"), None, []
    if view.confidence is not None:
        confidence = np.require(view.confidence, np.float32, "W")
    if not view.pixels_from_zero:
        nowhere = unseen(keypoints)
        sure = 1.0 if confidence is None else np.nan_to_num(confidence)
        placeholders = nowhere & (np.asarray(sure) > 0)
        if placeholders.any():
            notes.append(
                f"{view.name}: {int(placeholders.sum())} keypoints at (0, 0) or (-1, -1) are gaps"
            )
        keypoints[nowhere] = np.nan
    gaps = ~located(keypoints)
    if confidence is not None:
        confidence[~np.isfinite(confidence)] = 1
        confidence[gaps] = 0
        highest = float(confidence.max(initial=0.0))
        odd = confidence > SLIGHTLY_ABOVE
        if odd.any() and odd.sum() < FEW * (confidence > 0).sum():
            notes.append(
                f"{view.name}: {int(odd.sum())} confidences above 1, up to {highest:.4g}, were "
                "clipped to 1"
            )
        elif odd.any():
            notes.append(
                f"{view.name}: confidences go up to {highest:.4g}, so they were divided by it"
            )
            confidence /= np.float32(highest)
        elif highest > 1:
            notes.append(f"{view.name}: confidences up to {highest:.3f} were clipped to 1")
        np.clip(confidence, 0, 1, out=confidence)
        weak = (confidence < min_confidence) & (confidence > 0)
        if weak.any():
            notes.append(
                f"{view.name}: {int(weak.sum())} detections below {min_confidence:g} are gaps"
            )
        gaps |= (confidence <= 0) | weak
        confidence[gaps] = 0
    keypoints[gaps] = np.nan
    return replace(view, keypoints=keypoints, confidence=confidence), notes


def combined(views: Sequence[View], *, align: Align, one_file: bool = False) -> Capture:
    """Return the capture of views of one person (M = 1), that were cleaned and named.

    Parameters
    ----------
    one_file
        Whether all views are of one file, whose rows belong together.

    Raises
    ------
    FormatError
        If keypoints or frames of the views cannot be matched.
    """
    notes: list[str] = []
    notes += [f"{view.name}: {note}" for view in views for note in view.notes]
    views = _common_keypoints(list(views), notes)
    for view in views:
        if view.fps is not None and not 0 < view.fps < inf:
            raise FormatError(f"{view.name}: `fps` is {view.fps}, not above 0", option="fps")
    rows, numbers, times, fps = together(views, align, notes, one_file=one_file)
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
            confidence[:, v] = located(keypoints[:, v])
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
        None if (numbers == np.arange(len(numbers))).all() else numbers,
    )


def named(views: Sequence[View], skeleton: str | None, notes: list[str]) -> list[View]:
    """Return the views with the names and edges of their skeletons, as far as they can be known."""
    return [_named(view, skeleton, notes) for view in views]


def _named(view: View, skeleton: str | None, notes: list[str]) -> View:
    """Return the view with the names and edges of its skeleton, as far as they can be known."""
    count = view.keypoints.shape[2]
    if view.keypoint_names is not None and skeleton is None:
        edges = view.edges or edges_of(view.keypoint_names)
        return replace(view, edges=edges)
    known, candidates = skeleton_of(count, skeleton, view.skeletons)
    if known is not None:
        note = f"the {count} keypoints were taken for {known.title}"
        if skeleton is None and note not in notes:
            notes.append(note)
        return replace(view, keypoint_names=known.names, edges=known.edges)
    if candidates:
        note = (
            f"{count} keypoints without names, which may be {' or '.join(candidates)}: give it, "
            f"as in skeleton={candidates[0]!r} (--skeleton {candidates[0]})"
        )
        if note not in notes:
            notes.append(note)
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
                + " keypoints, and not all have names to match them by; give skeleton (--skeleton)",
                option="skeleton",
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
    if names == common:
        return view
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


def _truth(views: list[View], rows: Int64) -> Float32 | None:
    """Return the true structure that the first view has, for the frames that it has."""
    truth = views[0].points3d
    if truth is None:
        return None
    out = np.full((len(rows), *truth.shape[1:]), np.nan, np.float32)
    there = rows[:, 0] >= 0
    out[there] = truth[rows[there, 0]]
    return out
