"""COCO keypoints: one file of all views, `labels.json`.

A keypoint has visibility 2 where the view's detector saw it, 1 where only other views show where it
is, and 0 where there is no label. `keypoint_weights` beside `keypoints` is an addition of ours.
"""

import json
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from fewview.writers.labels.form import Int64, Labels, ViewLabels

NAME = "labels.json"
MARGIN = 0.1  # of the box around the keypoints, at each side
CATEGORY = 1
Record = dict[str, Any]


def write(folder: Path, labels: Labels) -> list[Path]:
    """Write the images, annotations and the category."""
    folder.mkdir(parents=True, exist_ok=True)
    category = {
        "id": CATEGORY,
        "name": "subject",
        "keypoints": list(labels.keypoint_names),
        # The standard counts keypoints from 1.
        "skeleton": [[first + 1, second + 1] for first, second in labels.edges],
    }
    file = folder / NAME
    with file.open("w", encoding="utf-8") as stream:  # piece by piece: of all it is much in memory
        for opening, records in (
            ('{"images":[', _images(labels)),
            ('],"annotations":[', _annotations(labels)),
            ('],"categories":[', [category]),
        ):
            stream.write(opening)
            for place, record in enumerate(records):
                stream.write("," * (place > 0) + json.dumps(record, allow_nan=False))
        stream.write("]}")
    return [file]


def _images(labels: Labels) -> Iterator[Record]:
    identifiers = count(1)
    for view, place in zip(labels.views, labels.folders, strict=True):
        size = {} if view.size is None else {"width": view.size[0], "height": view.size[1]}
        for number in view.frames.tolist():
            name = "/".join(labels.image(place, number))
            yield {"id": next(identifiers), "file_name": name, **size}


def _annotations(labels: Labels) -> Iterator[Record]:
    """Yield one for each image that has labels."""
    identifiers, images = count(1), count(1)
    for view in labels.views:
        visibility = np.where(view.labelled, np.where(view.detected, 2, 1), 0)
        for row in range(len(view.frames)):
            image = next(images)
            if visibility[row].any():
                about = {"id": next(identifiers), "image_id": image}
                yield about | _annotation(view, row, visibility[row])


def _annotation(view: ViewLabels, row: int, visibility: Int64) -> Record:
    labelled = visibility > 0
    places = np.where(labelled[:, None], view.keypoints[row], 0.0)
    flat: list[float] = []
    for (x, y), flag in zip(places.tolist(), visibility.tolist(), strict=True):
        flat += [x, y, flag]
    low, high = places[labelled].min(0), places[labelled].max(0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    if view.size is not None:
        low, high = np.clip(low, 0, view.size), np.clip(high, 0, view.size)
    width, height = np.round(high - low, 3).tolist()
    return {
        "category_id": CATEGORY,
        "keypoints": flat,
        "keypoint_weights": view.weights[row].tolist(),
        "num_keypoints": int(labelled.sum()),
        "bbox": [*np.round(low, 3).tolist(), width, height],
        "area": round(width * height, 3),
        "iscrowd": 0,
    }
