"""SLEAP: projects (.slp) and analysis files (HDF5), with tracks of one or several animals."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers import hdf5
from fewview.readers.sources import Source
from fewview.readers.views import Edges, View, packed

USER, PREDICTED = 0, 1
PIXEL_CENTRES_SINCE = 1.1  # earlier projects count from the corner of a pixel, half a pixel apart
AXES = ("frame", "track", "node", "xy")  # of what is read
# Of files: as SLEAP writes them, as it did without transposing, and as sleap-io may; files of
# sleap-io say their axes in an attribute.
LAYOUTS = (
    ("track", "xy", "node", "frame"),
    ("frame", "node", "xy", "track"),
    AXES,
)
Array = NDArray[Any]


def fits_slp(source: Source) -> bool:
    """Whether this is a project."""
    return {"instances", "frames", "metadata", "pred_points"} <= source.hdf5.keys()


def fits_analysis(source: Source) -> bool:
    """Whether this is an analysis file."""
    return {"tracks", "node_names"} <= source.hdf5.keys()


def read_analysis(source: Source) -> list[View]:
    """Return the view of an analysis file, as SLEAP and sleap-io lay it out.

    Raises
    ------
    FormatError
        If its arrays do not fit together.
    """
    what = str(source)
    with hdf5.opened(source.path) as file:
        tracks = hdf5.values(file["tracks"], what)
        nodes = _texts(file["node_names"], what)
        if tracks.ndim != 4:
            raise FormatError(f"`tracks` has the shape {tracks.shape}, of no SLEAP", place=source)
        axes = _axes(file, tracks.shape, len(nodes))
        if not axes:
            raise FormatError(
                f"`tracks` {tracks.shape} is not of {len(nodes)} nodes in 2D", place=source
            )
        values = tracks.transpose([axes.index(axis) for axis in AXES])
        scores = hdf5.values(file["point_scores"], what) if "point_scores" in file else None
        if scores is not None and scores.ndim == 3:
            left = [axis for axis in axes if axis != "xy"]
            scores = scores.transpose([left.index(axis) for axis in AXES[:3]])
        if scores is not None and scores.shape != values.shape[:3]:
            raise FormatError("`point_scores` do not fit `tracks`", place=source)
        names = _texts(file["track_names"], what) if "track_names" in file else []
        edges = hdf5.values(file["edge_inds"], what) if "edge_inds" in file else np.empty((0, 2))
    people = tuple(names) if len(names) == values.shape[1] else None
    if people is None and values.shape[1] == 1:
        people = ("",)
    return [
        View(
            source.name,
            values.astype(np.float32),
            np.arange(len(values)),
            None if scores is None else scores.astype(np.float32),
            people=people,
            keypoint_names=tuple(nodes),
            edges=tuple((int(a), int(b)) for a, b in edges) if np.size(edges) else None,
        )
    ]


def _axes(file: Any, shape: tuple[int, ...], nodes: int) -> tuple[str, ...]:
    """Return what the axes of `tracks` are; nothing if it is not of these nodes in 2D."""
    attributes = file["tracks"].attrs
    layouts: tuple[tuple[str, ...], ...] = LAYOUTS
    if "dims" in attributes:
        layouts = (tuple(map(str, json.loads(attributes["dims"]))),)
    elif not file.attrs.get("transpose", True):
        layouts = LAYOUTS[1:]
    for axes in layouts:
        size = dict(zip(axes, shape, strict=True))
        if sorted(axes) == sorted(AXES) and (size["node"], size["xy"]) == (nodes, 2):
            return axes
    return ()


def read_slp(source: Source) -> list[View]:
    """Return a view for each video of a project that has labelled frames.

    Raises
    ------
    FormatError
        If its tables do not fit together, or nothing is labelled.
    """
    what = str(source)
    with hdf5.opened(source.path) as file:
        frames, instances, user, predicted = (
            hdf5.values(file[table], what)
            for table in ("frames", "instances", "points", "pred_points")
        )
        points = {USER: _points(user), PREDICTED: _points(predicted)}
        metadata = file["metadata"].attrs
        content = json.loads(metadata["json"])
        if float(metadata.get("format_id", 1.0)) < PIXEL_CENTRES_SINCE:
            for rows in points.values():
                rows[:, :2] -= 0.5
        tracks = [json.loads(text)[1] for text in _texts(file.get("tracks_json"), what)]
        notes: tuple[str, ...] = ()
        at_once = frames["instance_id_end"].astype(int) - frames["instance_id_start"].astype(int)
        untracked = float(np.mean(instances["track"] < 0)) if len(instances) else 0.0
        if untracked > 0.5 or len(tracks) > 2 + 2 * int(at_once.max(initial=0)):
            notes = (
                f"its {len(tracks)} tracks are fragments: animals are followed by where they are",
            )
            tracks, notes = [], notes if tracks else ()
        videos = [_video(text, n) for n, text in enumerate(_texts(file.get("videos_json"), what))]
    nodes, edges = _skeleton(content, source)
    found = sorted({int(video) for video in frames["video"]})
    views = []
    for video in found:
        mine = np.sort(frames[frames["video"] == video], order="frame_idx")
        people = [_instances(frame, instances, points, len(tracks)) for frame in mine]
        keypoints, confidence = packed(people, str(source))
        tracked = bool(tracks) and keypoints.shape[1] <= len(tracks)
        named = videos[video] if video < len(videos) and len(found) > 1 else source.name
        views.append(
            View(
                named,
                keypoints,
                mine["frame_idx"].astype(np.int64),
                confidence,
                people=tuple(map(str, tracks[: keypoints.shape[1]])) if tracked else None,
                keypoint_names=nodes,
                edges=edges,
                notes=notes,
            )
        )
    if not views:
        raise FormatError("a SLEAP project without labelled frames", place=source)
    return views


def _texts(dataset: Any, what: str) -> list[str]:
    """Return the texts of a dataset; none if it is not there."""
    values = () if dataset is None else hdf5.values(dataset, what)
    return [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values]


def _points(rows: Array) -> Array:
    """Return (n, 3) x, y, score; what people placed has the score 1, what is not visible NaN."""
    scored = "score" in (rows.dtype.names or ())
    scores = rows["score"] if scored else np.ones(len(rows))
    values = np.stack([rows["x"], rows["y"], scores], axis=-1).astype(np.float64)
    if not scored:
        values[~rows["visible"]] = np.nan
    return values


def _instances(
    frame: Array, instances: Array, points: dict[int, Array], tracks: int
) -> list[Float32 | None]:
    """Return a frame's animals, at the places of their tracks where there are tracks.

    What a person has corrected stands in place of the prediction it was made from.
    """
    here = instances[int(frame["instance_id_start"]) : int(frame["instance_id_end"])]
    corrected = {int(i["from_predicted"]) for i in here if i["instance_type"] == USER}
    placed: dict[int, Float32] = {}
    others: list[Float32 | None] = []
    for one in here:
        kind, track = int(one["instance_type"]), int(one["track"])
        if kind == PREDICTED and int(one["instance_id"]) in corrected:
            continue
        table = points.get(kind, points[PREDICTED])
        values = table[int(one["point_id_start"]) : int(one["point_id_end"])].astype(np.float32)
        if 0 <= track < tracks and (kind == USER or track not in placed):
            placed[track] = values
        else:
            others.append(values)
    if tracks:  # animals without a track have no place among those that have one
        return (
            [placed.get(track) for track in range(tracks)] if placed or tracks > 1 else others[:1]
        )
    return others


def _skeleton(content: Any, source: Source) -> tuple[tuple[str, ...], Edges]:
    """Return the nodes in the order of points, and what joins them (no symmetries)."""
    try:
        skeleton = content["skeletons"][0]
        order = [int(node["id"]) for node in skeleton["nodes"]]
        names = tuple(str(content["nodes"][index]["name"]) for index in order)
        edges = tuple(
            (order.index(link["source"]), order.index(link["target"]))
            for link in skeleton["links"]
            if _edge_type(link.get("type", {})) == 1
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise FormatError(
            "a SLEAP project whose skeleton is not understood", place=source
        ) from error
    return names, edges


def _edge_type(pickled: dict[str, Any]) -> int:
    """Return 1 for an edge, 2 for a symmetry, from an object of jsonpickle."""
    if "py/reduce" in pickled:
        return int(pickled["py/reduce"][1]["py/tuple"][0])
    return int(pickled.get("py/id", 1))


def _video(text: str, number: int) -> str:
    """Return the name of a video: of its file, or of the folder of its images."""
    fields = json.loads(text)
    backend = fields.get("backend", fields)
    name = backend.get("filename", "")
    if isinstance(name, list):
        name = str(name[0]).replace("\\", "/").rpartition("/")[0] if name else ""
    name = str(name).replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
    return name.rpartition(".")[0] or name.strip(".") or f"video{number}"  # "." is embedded
