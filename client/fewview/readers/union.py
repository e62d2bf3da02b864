"""The keypoints of all views, where each view has those of its own detector."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.headers import plain
from fewview.readers.large_arrays import built
from fewview.readers.views import Edges, View, bounded


def with_all_keypoints(views: Sequence[View], notes: list[str]) -> list[View]:
    """Return the views with the keypoints that any of them has, gaps where it has none itself.

    Keypoints are in the order of the first view, then of the next. Capitals and separators do not
    make another name. Views are as they were if one has no names.

    Raises
    ------
    FormatError
        If a view has no keypoint in common with any other.
    """
    given = [view.keypoint_names for view in views]
    named = [names for names in given if names is not None]
    if len(named) < len(views) or len(set(named)) == 1:
        return list(views)
    keys = [[plain(name) for name in names] for names in named]
    if any(len(set(each)) < len(each) for each in keys):
        keys = [list(names) for names in named]
    called: dict[str, str] = {}
    owners: dict[str, list[str]] = {}
    for view, own, names in zip(views, keys, named, strict=True):
        for key, name in zip(own, names, strict=True):
            called.setdefault(key, name)
        for key in dict.fromkeys(own):
            owners.setdefault(key, []).append(view.name)
    apart = [
        f"{view.name}: {', '.join(names[:4])}"
        for view, own, names in zip(views, keys, named, strict=True)
        if all(len(owners[key]) == 1 for key in own)
    ]
    if apart:
        raise FormatError(
            f"cameras have no keypoint of the same name as another: {'; '.join(apart)}"
        )
    place = {key: index for index, key in enumerate(called)}
    for view in views:
        alone = [called[key] for key, who in owners.items() if who == [view.name]]
        if alone:
            notes.append(f"{view.name} alone has {', '.join(alone)}, whose depths are a guess")
    all_names = tuple(called.values())
    edges = _joined(views, keys, place)
    return [
        _spread(view, [place[key] for key in own], all_names, edges)
        for view, own in zip(views, keys, strict=True)
    ]


def _joined(
    views: Sequence[View], keys: Sequence[Sequence[str]], place: dict[str, int]
) -> Edges | None:
    """Return the edges that any view has, between the places of all keypoints."""
    edges = {
        (place[own[a]], place[own[b]]): None
        for view, own in zip(views, keys, strict=True)
        for a, b in view.edges or ()
    }
    twice = {(a, b) for a, b in edges if (b, a) in edges and a > b}
    return tuple(edge for edge in edges if edge not in twice) or None


def _spread(view: View, places: Sequence[int], names: tuple[str, ...], edges: Edges | None) -> View:
    """Return the view with P keypoints, of which it has those of these places."""
    mine = dict(reversed(list(zip(places, range(len(places)), strict=True))))  # the first of equals
    index, origin = list(mine), list(mine.values())
    if index == list(range(len(names))) == origin:
        return replace(view, keypoint_names=names, edges=edges)
    frames, people = view.keypoints.shape[:2]
    bounded((frames, people, len(names), 2), view.name)

    def keypoints(block: slice) -> Float32:
        part = view.keypoints[block]
        out = np.full((*part.shape[:2], len(names), 2), np.nan, np.float32)
        out[:, :, index] = part[:, :, origin]
        return out

    sure = view.confidence

    def confidence(block: slice) -> Float32:
        part = np.zeros(0) if sure is None else sure[block]
        out = np.zeros((*part.shape[:2], len(names)), np.float32)
        out[:, :, index] = part[:, :, origin]
        return out

    truth = view.points3d
    if truth is not None:
        truth = np.full((len(truth), len(names), 3), np.nan, np.float32)
        truth[:, index] = np.asarray(view.points3d)[:, origin]
    return replace(
        view,
        keypoints=built(keypoints, view.keypoints),
        confidence=None if sure is None else built(confidence, sure),
        points3d=truth,
        keypoint_names=names,
        edges=edges,
    )
