"""Small files in the layouts of detectors, for the tests of readers."""

import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
REAL = Path(__file__).parents[4] / "shared" / "data"
RAW = REAL / "raw"
NAMES = ("nose", "tail", "paw", "ear")


def walk(frames: int, points: int = 4, *, start: float = 100.0, seed: int = 1) -> Array:
    """Return (frames, points, 3) of x, y, confidence: somebody who drifts to the right."""
    rng = np.random.default_rng(seed)
    shape = rng.uniform(0, 80, (points, 2))
    xy = shape + start + np.arange(frames)[:, None, None] * (2.0, 0.5)
    return np.concatenate([xy, rng.uniform(0.5, 0.99, (frames, points, 1))], axis=-1)


def columns(names: Sequence[str], people: Sequence[str] = ()) -> list[tuple[str, ...]]:
    """Return the labels of DeepLabCut's columns."""
    if people:
        return [("net", a, n, c) for a in people for n in names for c in ("x", "y", "likelihood")]
    return [("net", n, c) for n in names for c in ("x", "y", "likelihood")]


def dlc_csv(path: Path, labels: list[tuple[str, ...]], values: Array) -> Path:
    """Write a CSV as DeepLabCut does."""
    levels = ("scorer", "individuals", "bodyparts", "coords")
    names = levels if len(labels[0]) == 4 else (levels[0], *levels[2:])
    rows = [[name, *row] for name, row in zip(names, zip(*labels, strict=True), strict=True)]
    rows += [
        [str(i), *("" if np.isnan(v) else repr(float(v)) for v in row)]
        for i, row in enumerate(values)
    ]
    path.write_text("".join(",".join(row) + "\n" for row in rows))
    return path


def _text(dataset: Any, name: str) -> None:
    dataset.attrs["CLASS"] = np.bytes_("ARRAY")
    dataset.attrs["name"] = np.bytes_(name)
    dataset.attrs["transposed"] = np.uint8(1)


def dlc_h5_fixed(
    path: Path, labels: list[tuple[str, ...]], values: Array, *, pickled: bool = False
) -> Path:
    """Write a table as pandas does with ``format="fixed"``: levels and codes."""
    levels = ("scorer", "individuals", "bodyparts", "coords")
    names = levels if len(labels[0]) == 4 else (levels[0], *levels[2:])
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_("frame")
        group.attrs["nblocks"] = 1
        for axis in ("axis0", "block0_items"):
            group.attrs[f"{axis}_nlevels"] = len(names)
            for level, name in enumerate(names):
                message = [label[level] for label in labels]
                known = sorted(set(message))
                codes = np.array([known.index(one) for one in message], np.int8)
                group[f"{axis}_label{level}"] = codes
                if pickled:  # as PyTables stores an array of objects
                    data = np.frombuffer(pickle.dumps(np.array(known, object), 2), np.uint8)
                    kind = h5py.vlen_dtype(np.uint8)
                    stored = group.create_dataset(f"{axis}_level{level}", (1,), kind)
                    stored[0] = data
                    _text(stored, name)
                    stored.attrs["CLASS"] = np.bytes_("VLARRAY")
                else:
                    group[f"{axis}_level{level}"] = np.array(known, "S")
                    _text(group[f"{axis}_level{level}"], name)
        group["axis1"] = np.arange(len(values))
        group["block0_values"] = values
        group["block0_values"].attrs["transposed"] = np.uint8(1)
    return path


def dlc_h5_table(path: Path, labels: list[tuple[str, ...]], values: Array) -> Path:
    """Write a table as pandas does with ``format="table"``: labels as pickles."""
    levels = ["scorer", "individuals", "bodyparts", "coords"]
    names = levels if len(labels[0]) == 4 else [levels[0], *levels[2:]]
    kind = np.dtype([("index", "<i8"), ("values_block_0", "<f8", (len(labels),))])
    rows = np.zeros(len(values), kind)
    rows["index"], rows["values_block_0"] = np.arange(len(values)), values
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_("frame_table")
        group.attrs["non_index_axes"] = np.bytes_(pickle.dumps([(1, labels)], 0))
        info = {1: {"names": names, "type": "MultiIndex"}, "index": {}}
        group.attrs["info"] = np.bytes_(pickle.dumps(info, 0))
        group["table"] = rows
        group["table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(labels, 0))
    return path


def openpose(folder: Path, frames: Sequence[Sequence[Array | None]], first: int = 0) -> Path:
    """Write a folder of OpenPose: of each frame its people, None for ``{}``."""
    folder.mkdir(parents=True)
    for number, people in enumerate(frames, first):
        fields: list[dict[str, Any]] = [
            {} if one is None else {"person_id": [-1], "pose_keypoints_2d": one.ravel().tolist()}
            for one in people
        ]
        name = f"{folder.name}_{number:012d}_keypoints.json"
        (folder / name).write_text(json.dumps({"version": 1.3, "people": fields}))
    return folder


def sleap_analysis(path: Path, values: Array, tracks: Sequence[str]) -> Path:
    """Write an analysis file: values (tracks, frames, points, 3)."""
    with h5py.File(path, "w") as file:
        file["tracks"] = values[..., :2].transpose(0, 3, 2, 1)
        file["point_scores"] = values[..., 2].transpose(0, 2, 1)
        file["track_names"] = np.array(tracks, "S")
        file["node_names"] = np.array(NAMES, "S")
        file["edge_inds"] = np.array([[0, 1], [0, 2]])
    return path


def slp(path: Path, values: Array, *, format_id: float = 1.2) -> Path:
    """Write a project of predictions (tracks, frames, points, 3) of one video."""
    tracks, frames, points, _ = values.shape
    flat = values.transpose(1, 0, 2, 3).reshape(-1, 3)
    xy = [("x", "<f8"), ("y", "<f8"), ("visible", "?"), ("complete", "?")]
    predicted = np.zeros(len(flat), [*xy, ("score", "<f8")])
    predicted["x"], predicted["y"], predicted["score"] = flat.T
    predicted["visible"] = True
    count = frames * tracks
    instances = np.zeros(
        count,
        [("instance_id", "<i8"), ("instance_type", "u1"), ("frame_id", "<u8"), ("track", "<i4"),
         ("from_predicted", "<i8"), ("point_id_start", "<u8"), ("point_id_end", "<u8")],
    )  # fmt: skip
    order = np.arange(count)
    instances["instance_id"], instances["instance_type"] = order, 1
    instances["frame_id"], instances["track"] = order // tracks, order % tracks
    instances["from_predicted"] = -1
    instances["point_id_start"], instances["point_id_end"] = order * points, (order + 1) * points
    table = np.zeros(
        frames,
        [("frame_id", "<u8"), ("video", "<u4"), ("frame_idx", "<u8"),
         ("instance_id_start", "<u8"), ("instance_id_end", "<u8")],
    )  # fmt: skip
    table["frame_id"], table["frame_idx"] = np.arange(frames), np.arange(frames) + 5
    table["instance_id_start"] = np.arange(frames) * tracks
    table["instance_id_end"] = (np.arange(frames) + 1) * tracks
    kind = {"py/reduce": [{"py/type": "sleap.skeleton.EdgeType"}, {"py/tuple": [1]}]}
    content = {
        "nodes": [{"name": name} for name in reversed(NAMES)],
        "skeletons": [
            {
                "nodes": [{"id": 3 - i} for i in range(len(NAMES))],
                "links": [
                    {"source": 3, "target": 2, "type": kind},
                    {"source": 3, "target": 1, "type": {"py/id": 1}},
                    {"source": 2, "target": 1, "type": {"py/id": 2}},
                ],
            }
        ],
    }
    with h5py.File(path, "w") as file:
        file["frames"], file["instances"], file["pred_points"] = table, instances, predicted
        file["points"] = np.zeros(0, xy)
        file["tracks_json"] = np.array([json.dumps([0, f"t{i}"]) for i in range(tracks)], "S")
        file["videos_json"] = np.array([json.dumps({"backend": {"filename": "a/b.mp4"}})], "S")
        meta = file.create_group("metadata")
        meta.attrs["format_id"], meta.attrs["json"] = format_id, np.bytes_(json.dumps(content))
    return path
