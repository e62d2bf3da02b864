"""Label Studio: JSON of tasks, an image each, whose keypoints are shares of the image in per cent.

Both of its exports, "JSON" and "JSON-MIN", with the size of each image. Where a task shows several
images (`to_name`), each is a camera's; elsewhere cameras are told apart by the names of the images.
Several people are told apart by the region that their keypoints lie in (`parentID`), or that a
relation leads to; without, a label that comes again is the next person's.

Source: Label Studio's documentation, "Export annotations", and label_studio_converter's samples.
"""

import re
from collections.abc import Iterator
from typing import Any
from urllib.parse import unquote

import numpy as np

from fewview.errors import FormatError
from fewview.readers.file_names import split_frames
from fewview.readers.named_points import Point, people_among, side_by_side
from fewview.readers.sources import Source
from fewview.readers.views import SEVERAL_SIZES, View, packed, size_in

LABEL = "keypointlabels"
LOOKED_INTO = 100  # tasks
_UPLOADED = re.compile(r"\A[0-9a-f]{8}-(?=.)")  # what Label Studio puts before a file's name
Record = dict[str, Any]
Result = tuple[str, Record, Record, str, float]  # which image, value, record, whose, score


def fits(source: Source) -> bool:
    """Whether this is a list of tasks, of which one has keypoints."""
    content = source.json
    return isinstance(content, list) and any(
        isinstance(task, dict) and any(True for _ in _results(task))
        for task in content[:LOOKED_INTO]
    )


def read(source: Source) -> list[View]:
    """Return the views of a file: tasks without keypoints are left out.

    Raises
    ------
    FormatError
        If its tasks do not fit together.
    """
    images: dict[tuple[str, str], list[tuple[str, str, Point]]] = {}
    sizes: dict[tuple[str, str], tuple[int, int]] = {}
    notes: set[str] = set()
    try:
        for number, task in enumerate(source.json):
            for shown, value, record, group, score in _results(task):
                image = (shown, _image(task, shown) or f"{task.get('id', number)}.")
                width, height = size_in(record, "original_width", "original_height") or (0, 0)
                if not width:
                    raise FormatError("keypoints without the size of their image", place=source)
                x, y = float(value["x"]) / 100 * width, float(value["y"]) / 100 * height
                sizes[image] = width, height
                images.setdefault(image, []).append((group, str(value[LABEL][0]), (x, y, score)))
                if record.get("image_rotation"):
                    notes.add("images were turned when they were labelled, and are read as turned")
        return _views(source, images, sizes, tuple(notes))
    except (KeyError, TypeError, IndexError, AttributeError, ValueError, OverflowError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(
            f"tasks of Label Studio that do not fit together ({error!r})", place=source
        ) from error


def _views(
    source: Source,
    images: dict[tuple[str, str], list[tuple[str, str, Point]]],
    sizes: dict[tuple[str, str], tuple[int, int]],
    notes: tuple[str, ...],
) -> list[View]:
    shown = list(dict.fromkeys(name for name, _ in images))
    cameras: dict[tuple[str, str], list[tuple[int, tuple[str, str]]]] = {}
    for name in shown:
        files = [file for each, file in images if each == name]
        for camera, found in split_frames(files).items():
            cameras[name, camera] = [(number, (name, files[index])) for number, index in found]
    views = []
    for (name, camera), frames in cameras.items():
        people = [people_among(images[image]) for _, image in frames]
        names, detections = side_by_side(people, str(source))
        keypoints, confidence = packed(detections, str(source))
        mine = {sizes[image] for _, image in frames}
        called = camera if len(cameras) > len(shown) else name
        views.append(
            View(
                called if len(cameras) > 1 and called else source.name,
                keypoints,
                np.array([number for number, _ in frames], np.int64),
                None if np.isnan(confidence).all() else confidence,
                keypoint_names=names,
                image_size=mine.pop() if len(mine) == 1 else None,
                notes=(*notes, SEVERAL_SIZES) if mine else notes,
                pixels_from_zero=True,
            )
        )
    return views


def _results(task: Record) -> Iterator[Result]:
    """Yield the keypoints of a task: which image shows it, its value, its record, whose it is.

    What a person labelled comes before what a model predicted; of several, the last that was not
    cancelled.
    """
    for key in ("annotations", "completions", "predictions"):
        made = [
            list(filter(_is_record, _listed(one.get("result"))))
            for one in filter(_is_record, _listed(task.get(key)))
            if not one.get("was_cancelled")
        ]
        whole = [each for each in made if any(map(_is_keypoint, each))]
        results = whole[-1] if whole else []
        joined = {str(each.get("from_id")): each.get("to_id") for each in results}
        for each in filter(_is_keypoint, results):
            value = each["value"]
            group = each.get("parentID", joined.get(str(each.get("id"))))
            score = each.get("score", value.get("score")) if key == "predictions" else None
            sure = float(score) if isinstance(score, int | float) else np.nan
            yield str(each.get("to_name", "")), value, each, str(group), sure
        if results:
            return
    for value in task.values():  # JSON-MIN has values under the names of its controls
        for each in _listed(value):
            if isinstance(each, dict) and _is_value(each) and "original_width" in each:
                yield "", each, each, "", np.nan


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _is_record(value: Any) -> bool:
    return isinstance(value, dict)


def _is_keypoint(result: Record) -> bool:
    return _is_value(result.get("value"))


def _is_value(value: Any) -> bool:
    return (
        isinstance(value, dict) and bool(_listed(value.get(LABEL))) and {"x", "y"} <= value.keys()
    )


def _image(task: Record, shown: str) -> str:
    """Return the name of an image of a task, as it was called before it was uploaded; "" of none.

    Addresses are of uploads, of folders (`?d=`), of buckets; a task with several images has them
    under the names that its results have, more often than not.
    """
    data = task.get("data")
    texts = {
        k: v for k, v in (data if isinstance(data, dict) else task).items() if isinstance(v, str)
    }
    named = [v for v in texts.values() if "." in v.rpartition("/")[2]]
    chosen = texts.get(shown.removeprefix("$")) or next(iter(named), "")
    if not chosen:
        chosen = str(task.get("file_upload") or "")
    path = unquote(chosen.rpartition("?d=")[2])
    folder, slash, file = path.replace("\\", "/").rpartition("/")
    return folder + slash + _UPLOADED.sub("", file)
