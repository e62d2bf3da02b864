"""labelme and X-AnyLabeling: a JSON file beside each image, with its shapes; points are keypoints.

Points of one `group_id` belong together; without, a label that comes again is the next person's.
X-AnyLabeling adds a `score`.

Source: labelme's `label_file.py`, X-AnyLabeling's documentation of its format.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.named_points import Point, people_among, side_by_side
from fewview.readers.sources import SHAPES, Source
from fewview.readers.views import SEVERAL_SIZES, View, packed, size_in

Record = dict[str, Any]


def fits(source: Source) -> bool:
    """Whether this is a file of one image's shapes, or many of them."""
    content = source.json
    return isinstance(content, dict) and isinstance(content.get(SHAPES), list)


def read(source: Source) -> list[View]:
    """Return the view of a folder with a file for each image, or of one file.

    Raises
    ------
    FormatError
        If a file has other content, or none has a point.
    """
    paths = source.frames or (source.path,)
    sizes: set[tuple[int, int] | None] = set()

    def people() -> Iterator[list[dict[str, Point]]]:
        for content in source.frames_json() if source.frames else [source.json]:
            sizes.add(size_in(content, "imageWidth", "imageHeight"))
            yield people_among(_points(content))

    try:
        names, detections = side_by_side(people(), str(source))
    except FormatError:
        raise
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        raise FormatError(
            f"one of its files is none of labelme ({error!r})", place=source
        ) from error
    if not names:
        raise FormatError(
            "its shapes are no points: keypoints are shapes of the type `point`", place=source
        )
    keypoints, confidence = packed(detections, str(source))
    found = [frame_number(path.name) for path in paths]
    given = [number[1] for number in found if number is not None]
    numbers = np.array(given if len(set(given)) == len(paths) else range(len(paths)), np.int64)
    order = np.argsort(numbers)
    size = sizes.pop() if len(sizes) == 1 else None
    return [
        View(
            source.name,
            keypoints[order],
            numbers[order],
            None if np.isnan(confidence).all() else confidence[order],
            keypoint_names=names,
            image_size=size,
            notes=(SEVERAL_SIZES,) if sizes else (),
            pixels_from_zero=True,
        )
    ]


def _points(content: Record) -> list[tuple[Any, str, Point]]:
    """Return whose the points of an image are, their labels and places."""
    points = []
    for shape in content[SHAPES]:
        if shape.get("shape_type") == "point":
            (x, y), score = shape["points"][0][:2], shape.get("score")
            sure = float(score) if isinstance(score, int | float) else np.nan
            points.append(
                (str(shape.get("group_id")), str(shape["label"]), (float(x), float(y), sure))
            )
    return points
