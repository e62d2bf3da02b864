"""Views of one person each, side by side: all keypoints, common frames."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from fewview.capture import Capture, Float32, located
from fewview.errors import FormatError
from fewview.readers.large_arrays import blocks, built
from fewview.readers.skeletons import edges_of, skeleton_of
from fewview.readers.timing import together
from fewview.readers.union import with_all_keypoints
from fewview.readers.views import Int64, View, bounded, unseen
from fewview.reading_options import Align

SLIGHTLY_ABOVE = 1.1  # peaks of heatmaps that are interpolated
FEW = 0.01  # of the confidences of a camera: so many above 1 are errors, and no other scale


def cleaned(view: View, min_confidence: float) -> tuple[View, list[str]]:
    """Return a view with gaps as NaN and confidences in [0, 1], and what was changed.

    Its arrays are those of `view`, which are changed: a copy of an hour takes half a gigabyte.
    """
    keypoints, notes = np.require(view.keypoints, requirements="W"), []
    confidence = view.confidence
    if confidence is not None:
        confidence = np.require(confidence, np.float32, "W")
    placeholders, odd, positive, highest, divisor = 0, 0, 0, 0.0, 1.0
    for block in blocks(keypoints, confidence):
        here, sure = keypoints[block], None if confidence is None else confidence[block]
        if not view.pixels_from_zero:
            nowhere = unseen(here)
            placeholders += int((nowhere if sure is None else nowhere & (sure > 0)).sum())
            here[nowhere] = np.nan
        gaps = ~located(here)
        here[gaps] = np.nan
        if sure is not None:
            sure[~np.isfinite(sure)] = 1
            sure[gaps] = 0
            highest = max(highest, float(sure.max(initial=0.0)))
            odd += int((sure > SLIGHTLY_ABOVE).sum())
            positive += int((sure > 0).sum())
    if placeholders:
        notes.append(f"{view.name}: {placeholders} keypoints at (0, 0) or (-1, -1) are gaps")
    if odd and odd < FEW * positive:
        notes.append(
            f"{view.name}: {odd} confidences above 1, up to {highest:.4g}, were clipped to 1"
        )
    elif odd:
        divisor = highest
        notes.append(f"{view.name}: confidences go up to {highest:.4g}, so they were divided by it")
    elif highest > 1:
        notes.append(f"{view.name}: confidences up to {highest:.3f} were clipped to 1")
    if confidence is not None:
        if highest > 1:
            _scaled(confidence, divisor)
        weak = _weak_left_out(keypoints, confidence, min_confidence)
        if weak:
            notes.append(f"{view.name}: {weak} detections below {min_confidence:g} are gaps")
    return replace(view, keypoints=keypoints, confidence=confidence), notes


def _scaled(confidence: Float32, divisor: float) -> None:
    """Divide confidences, and clip them to 1."""
    for block in blocks(confidence):
        confidence[block] = np.minimum(confidence[block] / np.float32(divisor), 1)


def _weak_left_out(keypoints: Float32, confidence: Float32, least: float) -> int:
    """Make gaps of keypoints with less confidence, or none; return how many had some."""
    weak = 0
    for block in blocks(keypoints, confidence):
        sure = confidence[block]
        gaps = (sure <= 0) | (sure < least)
        weak += int((gaps & (sure > 0)).sum())
        sure[gaps] = 0
        keypoints[block][gaps] = np.nan
    return weak


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
    views = _same_keypoints(list(views), notes)
    for view in views:
        if view.fps is not None and not 0 < view.fps < inf:
            raise FormatError(f"`fps` is {view.fps}, not above 0", place=view.name, option="fps")
    rows, numbers, times, fps = together(views, align, notes, one_file=one_file)
    first = views[0]
    keypoints, confidence = _side_by_side(views, rows)
    sizes = tuple(view.image_size for view in views)
    return Capture(
        keypoints,
        confidence,
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


def _side_by_side(views: Sequence[View], rows: Int64) -> tuple[Float32, Float32 | None]:
    """Return keypoints (N, K, P, 2) and confidences (N, K, P), None if no view has any.

    Parameters
    ----------
    rows
        (N, K) which frame of each view stands in each, -1 for none.
    """
    shape = (*rows.shape, views[0].keypoints.shape[2])
    bounded((*shape, 2), "the views together")

    def keypoints_of(block: slice) -> Float32:
        out = np.full((*rows[block].shape, *shape[2:], 2), np.nan, np.float32)
        for v, view in enumerate(views):
            there = rows[block, v] >= 0
            out[there, v] = view.keypoints[rows[block, v][there], 0]
        return out

    def confidence_of(block: slice) -> Float32:
        out = np.zeros((*rows[block].shape, *shape[2:]), np.float32)
        for v, view in enumerate(views):
            there = rows[block, v] >= 0
            own = rows[block, v][there]
            if view.confidence is not None:
                out[there, v] = view.confidence[own, 0]
            else:
                out[there, v] = located(view.keypoints[own, 0])
        return out

    points, given = [view.keypoints for view in views], [view.confidence for view in views]
    keypoints = built(keypoints_of, rows, *points)
    if not any(each is not None for each in given):
        return keypoints, None
    return keypoints, built(confidence_of, rows, *points, *given)


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


def _same_keypoints(views: list[View], notes: list[str]) -> list[View]:
    """Return the views with the keypoints of all; those without names have those of a view."""
    counts = {view.keypoints.shape[2] for view in views}
    names = [view.keypoint_names for view in views]
    if None not in names:
        return with_all_keypoints(views, notes)
    if len(counts) > 1:
        raise FormatError(
            "the cameras have "
            + ", ".join(f"{view.name} {view.keypoints.shape[2]}" for view in views)
            + " keypoints, and not all have names to match them by",
            option="skeleton",
            remedy="NAME",
        )
    known = next((each for each in names if each is not None), None)
    return [replace(view, keypoint_names=known) for view in views]


def _truth(views: list[View], rows: Int64) -> Float32 | None:
    """Return the true structure that the first view has, for the frames that it has."""
    truth = views[0].points3d
    if truth is None:
        return None
    out = np.full((len(rows), *truth.shape[1:]), np.nan, np.float32)
    there = rows[:, 0] >= 0
    out[there] = truth[rows[there, 0]]
    return out
