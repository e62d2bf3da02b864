"""COCO keypoints: annotation files, and files of results (also AlphaPose's).

Images of several cameras in one file are distinguished by their folders, or by the words before the
frame number.
"""

from typing import Any

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.readers.file_names import split_frames
from fewview.readers.sources import Source
from fewview.readers.views import SEVERAL_SIZES, Edges, View, packed

BODY = "keypoints"
WHOLE_BODY = (BODY, "foot_kpts", "face_kpts", "lefthand_kpts", "righthand_kpts")
SKELETONS = ("coco-17", "coco-133", "halpe-26", "hands-21")  # what 17 and other counts mean in COCO
Record = dict[str, Any]


def fits(source: Source) -> bool:
    """Whether this is a COCO file with keypoints."""
    content = source.json
    if isinstance(content, dict):
        records = content.get("annotations")
        return isinstance(records, list) and "images" in content and _have_keypoints(records)
    return isinstance(content, list) and _have_keypoints(content)


def _have_keypoints(records: list[Any]) -> bool:
    return any(
        isinstance(one, dict) and "image_id" in one and isinstance(one.get(BODY), list)
        for one in records[:1000]
    )


def read(source: Source) -> list[View]:
    """Return the views of a file.

    Raises
    ------
    FormatError
        If its records do not fit together.
    """
    content = source.json
    annotations = isinstance(content, dict)
    records = content["annotations"] if annotations else content
    images = _images(content, records)
    try:
        by_image: dict[Any, list[Record]] = {identifier: [] for identifier in images}
        for one in records:
            if one.get(BODY) and one["image_id"] in by_image and not one.get("iscrowd"):
                by_image[one["image_id"]].append(one)
        names, edges = _skeleton(content) if annotations else (None, None)
        cameras = _cameras(images)
        if len(cameras) == 1:
            cameras = {key.rsplit("/", 1)[-1]: frames for key, frames in cameras.items()}
        return [
            _view(source, camera, frames, images, by_image, names, edges)
            for camera, frames in cameras.items()
        ]
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(
            f"a COCO file that does not fit together ({error!r})", place=source
        ) from error


def _images(content: Any, records: list[Record]) -> dict[Any, Record]:
    """Return the images by identifier; those that nothing but records name are made up."""
    if isinstance(content, dict):
        return {image["id"]: image for image in content["images"]}
    return {one["image_id"]: {} for one in records if "image_id" in one}


def _cameras(images: dict[Any, Record]) -> dict[str, list[tuple[int, Any]]]:
    """Return of each camera the (frame number, image identifier) in order."""
    identifiers = list(images)
    given = [image.get("frame_id", image.get("frame_index")) for image in images.values()]
    numbers = [number for number in given if isinstance(number, int)]
    if len(set(numbers)) == len(identifiers):
        return {"": sorted(zip(numbers, identifiers, strict=True))}
    if not any("file_name" in image for image in images.values()) and all(
        isinstance(identifier, int) for identifier in identifiers
    ):
        return {"": [(number, number) for number in sorted(identifiers)]}
    names = [str(images[i].get("file_name", i)) for i in identifiers]
    split = split_frames(names)
    return {
        camera: [(number, identifiers[index]) for number, index in frames]
        for camera, frames in split.items()
    }


def _view(
    source: Source,
    camera: str,
    frames: list[tuple[int, Any]],
    images: dict[Any, Record],
    by_image: dict[Any, list[Record]],
    names: tuple[str, ...] | None,
    edges: Edges | None,
) -> View:
    whole = all("foot_kpts" in one for people in by_image.values() for one in people)
    parts = WHOLE_BODY if whole else (BODY,)
    flags = all("score" not in one for people in by_image.values() for one in people)
    people = [[_person(one, parts, flags) for one in by_image[i]] for _, i in frames]
    keypoints, confidence = packed(people, str(source))
    sizes = {(images[i].get("width"), images[i].get("height")) for _, i in frames}
    width, height = sizes.pop() if len(sizes) == 1 else (None, None)
    fitting = names is not None and len(names) == keypoints.shape[2]
    notes = (SEVERAL_SIZES,) if sizes else ()
    return View(
        camera or source.name,
        keypoints,
        np.array([number for number, _ in frames], np.int64),
        None if flags else confidence,
        keypoint_names=names if fitting else None,
        edges=edges if fitting else None,
        image_size=(int(width), int(height)) if width and height else None,
        skeletons=SKELETONS,
        notes=notes,
    )


def _person(one: Record, parts: tuple[str, ...], flags: bool) -> Float32:
    """Return (P, 3); a flag 0 of an annotation means a keypoint that is not labelled."""
    values = np.concatenate([np.array(one[part], np.float32).reshape(-1, 3) for part in parts])
    if flags:
        values[values[:, 2] == 0] = np.nan
    return values


def _skeleton(content: Record) -> tuple[tuple[str, ...] | None, Edges | None]:
    for category in content.get("categories") or ():
        if category.get("keypoints"):
            names = tuple(map(str, category["keypoints"]))
            # The standard counts keypoints from 1.
            edges = tuple((int(a) - 1, int(b) - 1) for a, b in category.get("skeleton") or ())
            inside = all(0 <= k < len(names) for edge in edges for k in edge)
            return names, edges if edges and inside else None
    return None, None
