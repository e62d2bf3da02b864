"""COCO keypoints: one file of all views, `labels.json`.

A keypoint has visibility 2 where the view's detector saw it, 1 where only other views show where it
is, and 0 where there is no label. `keypoint_weights` beside `keypoints` is an addition of ours.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from fewview.writers.labels.form import Labels, ViewLabels

NAME = "labels.json"
MARGIN = 0.1  # of the box around the keypoints, at each side
CATEGORY = 1


def write(folder: Path, labels: Labels) -> list[Path]:
    """Write the images, annotations and the category."""
    folder.mkdir(parents=True, exist_ok=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for view, place in zip(labels.views, labels.folders, strict=True):
        for row, number in enumerate(view.frames.tolist()):
            image: dict[str, Any] = {
                "id": len(images) + 1,
                "file_name": "/".join(labels.image(place, number)),
            }
            if view.size is not None:
                image |= {"width": view.size[0], "height": view.size[1]}
            images.append(image)
            if view.labelled[row].any():
                annotations.append(_annotation(view, row, len(annotations) + 1, len(images)))
    content = {
        "images": images,
        "annotations": annotations,
        "categories": [
            {
                "id": CATEGORY,
                "name": "subject",
                "keypoints": list(labels.keypoint_names),
                # The standard counts keypoints from 1.
                "skeleton": [[first + 1, second + 1] for first, second in labels.edges],
            }
        ],
    }
    file = folder / NAME
    file.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    return [file]


def _annotation(view: ViewLabels, row: int, identifier: int, image: int) -> dict[str, Any]:
    labelled = view.labelled[row]
    visibility = np.where(labelled, np.where(view.detected[row], 2, 1), 0)
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
        "id": identifier,
        "image_id": image,
        "category_id": CATEGORY,
        "keypoints": flat,
        "keypoint_weights": view.weights[row].tolist(),
        "num_keypoints": int(labelled.sum()),
        "bbox": [*np.round(low, 3).tolist(), width, height],
        "area": round(width * height, 3),
        "iscrowd": 0,
    }
