"""NWB with ndx-pose: a `PoseEstimation` for each camera, or for each subject of each camera.

Read as HDF5: nothing of the schema that a file carries is carried out. `PoseEstimation`s that link
to one device are the subjects of that camera. Cameras with a calibration (`CalibratedCamera`) are
that of the capture; 3D estimates are left out, their views are read.

Source: the specifications of NWB 2 and of ndx-pose 0.2 to 0.4.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fewview.calibration import Camera
from fewview.capture import Float32, Float64
from fewview.errors import FormatError
from fewview.readers import hdf5
from fewview.readers.sources import Source
from fewview.readers.union import with_all_keypoints
from fewview.readers.views import WIDEST, Edges, View, bounded

POSE, SERIES, SKELETON = "PoseEstimation", "PoseEstimationSeries", "Skeleton"
DEPTH = 6  # of groups in groups
INSIDE = 0.99  # of the keypoints, in an image of the size that a file gives


@dataclass(frozen=True)
class _Estimate:
    """A subject that a camera saw: the camera's name, and its view of one person."""

    device: str
    subject: str
    view: View


def fits(source: Source) -> bool:
    """Whether this is an NWB file."""
    return {"identifier", "session_description", "general"} <= source.hdf5.keys()


def read(source: Source) -> list[View]:
    """Return a view for each camera whose estimated positions a file has.

    Raises
    ------
    FormatError
        If it has none, or they do not fit together.
    """
    what = str(source)
    with hdf5.opened(source.path) as file:
        there = list(_groups(file, POSE))
        plane = [group for group in there if not _is_3d(group)]
        found = [_estimate(group, source) for group in plane or there]
        left = tuple(
            f"{group.name.rpartition('/')[2]} left out, as its points are 3D"
            for group in there
            if group not in plane
        )
    if not found:
        raise FormatError(
            "NWB without a PoseEstimation of ndx-pose, which has the keypoints of a camera",
            place=source,
        )
    cameras: dict[str, list[_Estimate]] = {}
    for one in found:
        cameras.setdefault(one.device or one.subject, []).append(one)
    views = [_together(each, what) for each in cameras.values()]
    views[0] = replace(views[0], notes=(*views[0].notes, *left))
    return views if len(views) > 1 else [replace(views[0], name=source.name)]


def _groups(group: Any, kind: str, depth: int = DEPTH) -> Iterator[Any]:
    """Yield the groups of a type that are in a group, without following links."""
    for name in sorted(group):
        if not hdf5.is_hard(group, name):
            continue
        inside = group[name]
        if _type(inside) == kind:
            yield inside
        elif depth and hasattr(inside, "keys"):
            yield from _groups(inside, kind, depth - 1)


def _is_3d(estimate: Any) -> bool:
    """Whether all series of an estimate are of points in 3D."""
    shapes = [getattr(one.get("data"), "shape", ()) for one in _groups(estimate, SERIES, 0)]
    return bool(shapes) and all(shape[1:] == (3,) for shape in shapes)


def _type(item: Any) -> str:
    return hdf5.text(item.attrs.get("neurodata_type", ""))


def _estimate(group: Any, source: Source) -> _Estimate:
    what = f"{source}: {group.name.rpartition('/')[2]}"
    nodes, pairs = _skeleton(group, what)
    place = {node: index for index, node in enumerate(nodes)}
    series = sorted(
        _groups(group, SERIES, 0),
        key=lambda each: place.get(each.name.rpartition("/")[2], len(nodes)),
    )
    if not series:
        raise FormatError("a PoseEstimation without series of keypoints", place=what)
    places, sure = zip(*(_positions(each, what) for each in series), strict=True)
    frames = {len(each) for each in places}
    if len(frames) > 1:
        raise FormatError("its keypoints have other numbers of frames", place=what)
    bounded((len(places), frames.pop(), 2), what)
    keypoints = np.stack(places, axis=1)[:, None]
    confidence = None
    if all(each is not None and len(each) == len(keypoints) for each in sure):
        confidence = np.stack(sure, axis=1)[:, None]
    names = tuple(each.name.rpartition("/")[2] for each in series)
    times, fps = _times(series[0], what)
    if times is not None and (len(times) != len(keypoints) or not np.isfinite(times).all()):
        times = None
    title = group.name.rpartition("/")[2]
    subject = title.removeprefix(POSE).strip("_- ") or title
    device = group.get("device", getlink=True)
    camera = device.path.rpartition("/")[2] if hasattr(device, "path") else ""
    size = _size(group, keypoints, what)
    view = View(
        camera or subject,
        keypoints,
        np.arange(len(keypoints)),
        confidence,
        keypoint_names=names,
        edges=_edges(names, nodes, pairs),
        image_size=size,
        times=times,
        fps=fps,
        camera=_calibrated(group.get("device"), camera, size, what) if camera else None,
    )
    return _Estimate(camera, subject, view)


def _positions(series: Any, what: str) -> tuple[Float32, Float32 | None]:
    """Return the places (N, 2) of a keypoint, and its confidences (N,)."""
    data = hdf5.values(series["data"], what)
    if data.ndim != 2 or data.shape[1] != 2:
        raise FormatError(
            f"{series.name.rpartition('/')[2]} has the shape {data.shape}: give the 2D keypoints "
            "of each camera",
            place=what,
        )
    scale, offset = (float(series["data"].attrs.get(n, d)) for n, d in _SCALE)
    sure = hdf5.values(series["confidence"], what) if "confidence" in series else None
    if sure is not None and sure.shape != data.shape[:1]:
        sure = None
    places = data.astype(np.float32) * np.float32(scale) + np.float32(offset)
    return places, None if sure is None else sure.astype(np.float32)


_SCALE = (("conversion", 1.0), ("offset", 0.0))


def _times(series: Any, what: str) -> tuple[Float64 | None, float | None]:
    if "timestamps" in series:
        return hdf5.values(series["timestamps"], what).astype(np.float64).ravel(), None
    start = series.get("starting_time")
    rate = float(start.attrs.get("rate", 0)) if start is not None else 0.0
    return None, rate if 0 < rate < np.inf else None


def _size(group: Any, keypoints: Float32, what: str) -> tuple[int, int] | None:
    """Return (width, height) as a file has it, or exchanged where keypoints show that it is so."""
    if "dimensions" not in group:
        return None
    given = hdf5.values(group["dimensions"], what).ravel()[:2].astype(int).tolist()
    seen = keypoints[np.isfinite(keypoints).all(-1)]
    for size in (given, given[::-1]):
        fitting = len(size) == 2 and all(0 < side < WIDEST for side in size)
        if fitting and len(seen) and (seen < size).all(-1).mean() > INSIDE:
            return size[0], size[1]
    return None


def _skeleton(group: Any, what: str) -> tuple[list[str], list[list[int]]]:
    """Return the nodes and edges of the skeleton that an estimate has or links to."""
    for name in group:
        item = group.get(name)
        if item is None or _type(item) != SKELETON or "nodes" not in item:
            continue
        nodes = [hdf5.text(node) for node in hdf5.values(item["nodes"], what).ravel()]
        pairs = hdf5.values(item["edges"], what) if "edges" in item else np.empty((0, 2))
        return nodes, pairs.reshape(-1, 2).astype(int).tolist()
    return [], []


def _edges(names: Sequence[str], nodes: Sequence[str], pairs: list[list[int]]) -> Edges | None:
    place = {name: index for index, name in enumerate(names)}
    inside = (pair for pair in pairs if 0 <= min(pair) <= max(pair) < len(nodes))
    called = [[nodes[end] for end in pair] for pair in inside]
    edges = [(place[a], place[b]) for a, b in called if a != b and a in place and b in place]
    return tuple(edges) or None


def _calibrated(device: Any, name: str, size: tuple[int, int] | None, what: str) -> Camera | None:
    """Return the camera of a device, if it is calibrated."""
    if device is None or "intrinsic_matrix" not in device:
        return None
    known = {
        part: hdf5.values(device[own], what).astype(np.float64)
        for part, own in (
            ("matrix", "intrinsic_matrix"),
            ("rotation", "rotation_matrix"),
            ("translation", "translation_vector"),
            ("distortion", "distortion_coefficients"),
        )
        if own in device
    }
    try:
        return Camera(name, size=size, **known)
    except ValueError as error:
        raise FormatError(f"a camera that is none ({error})", place=what) from error


def _together(estimates: list[_Estimate], what: str) -> View:
    """Return the view of a camera with the subjects that it saw."""
    if len(estimates) == 1:
        return estimates[0].view
    views = with_all_keypoints([one.view for one in estimates], [])
    first = views[0]
    if len({view.keypoints.shape for view in views}) > 1:
        raise FormatError(f"subjects of {first.name} have other frames or keypoints", place=what)
    sure = [view.confidence for view in views if view.confidence is not None]
    people = tuple(one.subject for one in estimates)
    return replace(
        first,
        keypoints=np.concatenate([view.keypoints for view in views], axis=1),
        confidence=np.concatenate(sure, axis=1) if len(sure) == len(views) else None,
        people=people if len(set(people)) == len(people) else None,
    )
