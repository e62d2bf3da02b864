"""MMPose and RTMPose: predictions of a video in one JSON file, or of one image in each."""

from typing import Any

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.names import frame_number
from fewview.readers.sources import Source
from fewview.readers.views import Edges, View, packed

SKELETONS = ("coco-17", "coco-133", "halpe-26", "hands-21")


def fits(source: Source) -> bool:
    """Whether these are predictions with `keypoint_scores`, of one image or of a video."""
    content = source.json
    if isinstance(content, dict):
        return isinstance(content.get("instance_info"), list)
    if not isinstance(content, list) or not content or not isinstance(content[0], dict):
        return False
    return "instances" in content[0] or "keypoint_scores" in content[0]


def read(source: Source) -> list[View]:
    """Return the view of a file, or of a folder with a file for each image.

    Raises
    ------
    FormatError
        If it does not fit together, or holds 3D keypoints.
    """
    content = source.json
    try:
        if source.frames:
            frames = list(source.frames_json())
            told = [frame_number(path.name) for path in source.frames]
            numbers = [n if one is None else one[1] for n, one in enumerate(told)]
        elif isinstance(content, list) and "instances" not in content[0]:
            frames, numbers = [content], [0]
        else:
            records = content["instance_info"] if isinstance(content, dict) else content
            frames = [record["instances"] for record in records]
            numbers = [int(record.get("frame_id", n)) for n, record in enumerate(records)]
        detections = [[_person(one, source) for one in people] for people in frames]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{source}: predictions of MMPose that are broken ({error!r})") from error
    if len(set(numbers)) < len(numbers):
        numbers = list(range(len(numbers)))
    keypoints, confidence = packed(detections, str(source))
    order = np.argsort(numbers)
    names, edges = _skeleton(content, keypoints.shape[2])
    return [
        View(
            source.name.removeprefix("results_"),
            keypoints[order],
            np.array(numbers, np.int64)[order],
            confidence[order],
            keypoint_names=names,
            edges=edges,
            skeletons=SKELETONS,
        )
    ]


def _person(one: dict[str, Any], source: Source) -> Float32:
    xy = np.array(one["keypoints"], np.float32)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise FormatError(
            f"{source}: `keypoints` of the shape {xy.shape} are not 2D; run the 2D estimator alone"
        )
    scores = np.array(one["keypoint_scores"], np.float32).reshape(-1, 1)
    return np.concatenate([xy, scores], axis=1)


def _skeleton(content: Any, count: int) -> tuple[tuple[str, ...] | None, Edges | None]:
    """Return names and edges, where the predictions came with the description of their data."""
    meta = content.get("meta_info") if isinstance(content, dict) else None
    if not isinstance(meta, dict) or not isinstance(meta.get("keypoint_id2name"), dict):
        return None, None
    known = {str(key): str(name) for key, name in meta["keypoint_id2name"].items()}
    if set(known) != {str(index) for index in range(count)}:
        return None, None
    links = meta.get("skeleton_links") or ()
    links = links.get("__ndarray__", ()) if isinstance(links, dict) else links
    edges = tuple((int(a), int(b)) for a, b in links)
    inside = all(0 <= k < count for edge in edges for k in edge)
    return tuple(known[str(i)] for i in range(count)), edges if edges and inside else None
