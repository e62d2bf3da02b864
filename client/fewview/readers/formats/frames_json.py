"""People frame by frame as JSON: of MMPose, AlphaPose, YOLO, EasyMocap, ViTPose and others.

One file for a video, or a folder with a file for each image. One table has the differences of the
layouts; all are read by `json_frames.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from fewview.errors import FormatError
from fewview.readers.file_names import frame_number
from fewview.readers.json_frames import (
    BARE,
    LOOKED_INTO,
    SCORES,
    Frame,
    cameras_of,
    frames_of,
    named_points,
    names_of,
    people_of,
    points_of,
    size_of,
    time_of,
    times_of,
)
from fewview.readers.named_points import side_by_side
from fewview.readers.sources import Source
from fewview.readers.views import Edges, View, packed
from fewview.readers.vision import is_vision

SKELETONS = ("coco-17", "coco-133", "halpe-26", "hands-21")


@dataclass(frozen=True)
class Layout:
    """A layout: its name, its title, whether JSON is of it, and words that are in it."""

    name: str
    title: str
    matches: Callable[[Any, Sequence[Any]], bool]  # the content, and people in it
    words: str = ""
    y_first: bool = False


LAYOUTS = (
    Layout(
        "apple-vision",
        "Apple Vision JSON",
        lambda _, people: _is_vision(people),
        "joints leftshoulder neck root rightupleg joint confidence location observations",
    ),
    Layout(
        "easymocap",
        "EasyMocap annotations",
        lambda content, _: _has(content, "annots"),
        "annots personid bbox keypoints iskeyframe filename",
    ),
    Layout(
        "alphapose",
        "AlphaPose JSON",
        lambda content, _: _is_alphapose(content),
        "version bodies joints",
    ),
    Layout(
        "vitpose",
        "ViTPose JSON",
        lambda content, _: _is_vitpose(content),
        "keypoints skeleton",
        y_first=True,
    ),
    Layout(
        "superanimal",
        "SuperAnimal JSON",
        lambda content, _: _has(content, BARE),
        "bodyparts bboxes bboxscores",
    ),
    Layout(
        "yolo-json",
        "YOLO pose JSON",
        lambda _, people: _is_yolo(people[0]),
        "name class confidence box keypoints x y visible",
    ),
    Layout(
        "mmpose",
        "MMPose JSON",
        lambda content, people: _scored(people[0]) or _is_mmpose(content),
        "metainfo instanceinfo instances predictions keypointscores bboxscore",
    ),
    Layout(
        "json",
        "JSON of people in frames",
        lambda _, __: True,
        "frames frame frameid people persons keypoints score pose",
    ),
)


_LAYOUTS_OF: WeakKeyDictionary[Source, Layout | None] = WeakKeyDictionary()


def fits(source: Source, layout: Layout) -> bool:
    """Whether this is of a layout, and of none before it in the table."""
    if source not in _LAYOUTS_OF:  # found once for all layouts
        _LAYOUTS_OF[source] = _layout_of(source)
    return _LAYOUTS_OF[source] is layout


def _layout_of(source: Source) -> Layout | None:
    content = next(iter(cameras_of(source.json).values()))
    frames = frames_of(content)
    people = [person for frame in frames[:LOOKED_INTO] for person in frame.people]
    if not people:
        return None
    return next(each for each in LAYOUTS if each.matches(content, people))


def read(source: Source, layout: Layout) -> list[View]:
    """Return the views of a file, or the view of a folder with a file for each image.

    Raises
    ------
    FormatError
        If it does not fit together, or holds 3D keypoints.
    """
    return [
        _view(source, name or source.name.removeprefix("results_"), content, layout)
        for name, content in cameras_of(source.json).items()
    ]


def _view(source: Source, name: str, content: Any, layout: Layout) -> View:
    what = str(source)
    try:
        frames = _frames(source, content)
        everybody = [person for frame in frames for person in frame.people]
        named = named_points(everybody)
        names: tuple[str, ...] | None
        if named is not None and not layout.y_first:
            mine = iter(named)
            people_named = [[next(mine) for _ in frame.people] for frame in frames]
            names, detections = side_by_side(people_named, what)
        else:
            names, detections = (
                None,
                [
                    [points_of(one, what, y_first=layout.y_first) for one in frame.people]
                    for frame in frames
                ],
            )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{layout.title} that is broken ({error!r})", place=what) from error
    keypoints, confidence = packed(detections, what)
    given = [frame.number for frame in frames if frame.number is not None]
    times = times_of([frame.time for frame in frames])
    numbers = np.arange(len(frames))
    if len(set(given)) == len(frames):
        numbers = np.array(given, np.int64)
    elif times is not None:
        numbers[np.argsort(times, kind="stable")] = np.arange(len(frames))
    order = np.argsort(numbers)
    names = names or names_of(content, everybody, keypoints.shape[2])
    fps = content.get("fps") if isinstance(content, dict) else None
    return View(
        name,
        keypoints[order],
        numbers[order],
        None if np.isnan(confidence).all() else confidence[order],
        keypoint_names=names,
        edges=_edges(content, keypoints.shape[2]) if names else None,
        image_size=size_of(content),
        times=None if times is None else times[order],
        fps=float(fps) if isinstance(fps, int | float) and fps > 0 else None,
        skeletons=SKELETONS,
    )


def _frames(source: Source, content: Any) -> list[Frame]:
    if not source.frames:
        return frames_of(content)
    frames: list[Frame] = []
    for path, image in zip(source.frames, source.frames_json(), strict=True):
        number, people = frame_number(path.name), people_of(image)
        if people is None:
            raise FormatError("no people of one image", place=path)
        frames.append(Frame(number and number[1], time_of(image), people))
    return frames


def _has(content: Any, key: str) -> bool:
    """Whether a file, or its first frame, has this key."""
    first = content[0] if isinstance(content, list) and content else content
    return isinstance(first, dict) and key in first


def _is_alphapose(content: Any) -> bool:
    return isinstance(content, dict) and any(
        isinstance(frame, dict) and "AlphaPose" in str(frame.get("version"))
        for frame in list(content.values())[:1]
    )


def _is_vitpose(content: Any) -> bool:
    return (
        isinstance(content, dict)
        and {"keypoints", "skeleton"} <= content.keys()
        and isinstance(content["keypoints"], list)
    )


def _is_vision(people: Sequence[Any]) -> bool:
    named = named_points(people)
    return named is not None and is_vision({name for person in named for name in person})


def _is_yolo(person: Any) -> bool:
    points = person.get("keypoints") if isinstance(person, dict) else None
    return isinstance(points, dict) and {"x", "y"} <= points.keys()


def _scored(person: Any) -> bool:
    return isinstance(person, dict) and any(key in person for key in SCORES)


def _is_mmpose(content: Any) -> bool:
    return any(_has(content, key) for key in ("instance_info", "instances"))


def _edges(content: Any, count: int) -> Edges | None:
    """Return the edges, where predictions came with the description of their data."""
    meta = content.get("meta_info") if isinstance(content, dict) else None
    links = meta.get("skeleton_links") if isinstance(meta, dict) else None
    links = links.get("__ndarray__", ()) if isinstance(links, dict) else links or ()
    edges = tuple((int(a), int(b)) for a, b in links)
    inside = all(0 <= k < count for edge in edges for k in edge)
    return edges if edges and inside else None
