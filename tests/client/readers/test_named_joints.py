"""Points with names: labels of annotation tools, joints of Apple Vision, JSON of other makers."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files

NAMES = ("nose", "left_hip", "right_hip", "tail")
SIZE = (1280, 720)
WALKS = [files.walk(6, len(NAMES), seed=seed) for seed in (1, 2)]
MISSING = ((2, 1), (4, 3))  # frame and keypoint that the first camera lacks


def seen(view: int) -> Any:
    """Return what a camera saw (frames, keypoints, 2), NaN where it saw nothing."""
    xy = WALKS[view][..., :2].copy()
    if view == 0:
        xy[tuple(zip(*MISSING, strict=True))] = np.nan
    return xy


def present(view: int, frame: int) -> list[tuple[str, float, float, float]]:
    """Return the names, places and confidences of what a camera saw in a frame, in any order."""
    order = np.random.default_rng(frame).permutation(len(NAMES))
    points = [
        (NAMES[k], *map(float, seen(view)[frame, k]), WALKS[view][frame, k, 2]) for k in order
    ]
    return [point for point in points if np.isfinite(point[1])]


def as_it_was_seen(capture: fewview.Capture) -> None:
    assert sorted(capture.keypoint_names or ()) == sorted(NAMES)
    order = [(capture.keypoint_names or ()).index(name) for name in NAMES]
    for view in range(2):
        np.testing.assert_allclose(capture.keypoints[:, view, order], seen(view), atol=1e-3)


def label_studio_task(view: int, frame: int, *, upload: str) -> dict[str, Any]:
    size = {"original_width": SIZE[0], "original_height": SIZE[1], "image_rotation": 0}
    values = [
        {"x": x / SIZE[0] * 100, "y": y / SIZE[1] * 100, "width": 0.3, "keypointlabels": [name]}
        for name, x, y, _ in present(view, frame)
    ]
    prefix = "" if upload == "min" else upload
    image = f"/data/upload/3/{prefix}cam{view + 1}_{frame:03d}.png"
    if upload == "min":
        return {"id": frame, "image": image, "kp": [{**value, **size} for value in values]}
    results = [
        {**size, "id": f"{n}", "to_name": "image", "type": "keypointlabels", "value": value}
        for n, value in enumerate(values)
    ]
    annotations = [
        {"id": 1, "was_cancelled": True, "result": results[:1]},
        {"id": 2, "was_cancelled": False, "result": results},
    ]
    return {"id": frame, "annotations": annotations, "data": {"image": image}, "predictions": []}


@pytest.mark.parametrize("upload", ["", "0a1b2c3d-", "min"])
def test_label_studio(tmp_path: Path, upload: str) -> None:
    tasks = [label_studio_task(v, f, upload=upload) for v in range(2) for f in range(6)]
    tasks.append({"id": 99, "annotations": [], "data": {"image": "cam1_999.png"}})
    (tmp_path / "project.json").write_text(json.dumps(tasks))
    capture = fewview.read(tmp_path / "project.json")
    as_it_was_seen(capture)
    assert capture.image_sizes == (SIZE, SIZE)
    assert capture.view_names == ("cam1", "cam2")


def test_two_animals_of_label_studio_are_told_apart_by_what_their_points_belong_to(
    tmp_path: Path,
) -> None:
    size = {"original_width": SIZE[0], "original_height": SIZE[1]}
    tasks = []
    for frame in range(6):
        results: list[dict[str, Any]] = []
        for animal, walk in enumerate(WALKS):
            for k, name in enumerate(NAMES):
                x, y = walk[frame, k, :2] + (600 * animal, 0)
                value = {"x": x / 12.8, "y": y / 7.2, "keypointlabels": [name]}
                results.append({**size, "id": f"{animal}{k}", "value": value})
                results.append(
                    {"type": "relation", "from_id": f"{animal}{k}", "to_id": str(animal)}
                )
        results = [results[i] for i in np.random.default_rng(frame).permutation(len(results))]
        tasks.append({"annotations": [{"result": results}], "data": {"image": f"f{frame}.png"}})
    (tmp_path / "cam1.json").write_text(json.dumps(tasks))
    capture = fewview.read(tmp_path / "cam1.json", person=1)
    spread = np.ptp(capture.keypoints[:, 0], axis=1)
    assert (spread < 100).all()  # of one animal; the two are 600 pixels apart


@pytest.mark.parametrize("score", [False, True])
def test_labelme(tmp_path: Path, score: bool) -> None:
    for view in range(2):
        folder = tmp_path / f"cam{view + 1}"
        folder.mkdir()
        for frame in range(6):
            shapes: list[dict[str, Any]] = [
                {"label": name, "points": [[x, y]], "group_id": 7, "shape_type": "point"}
                | ({"score": sure} if score else {})
                for name, x, y, sure in present(view, frame)
            ]
            shapes.append({"label": "rat", "points": [[0, 0], [9, 9]], "shape_type": "rectangle"})
            content: dict[str, Any] = {
                "version": "5.3.1",
                "flags": {},
                "shapes": shapes,
                "imagePath": "x.png",
            }
            content |= {"imageWidth": SIZE[0], "imageHeight": SIZE[1], "imageData": None}
            (folder / f"img{frame:05d}.json").write_text(json.dumps(content))
    empty = {"version": "5.3.1", "shapes": [], "imageWidth": SIZE[0], "imageHeight": SIZE[1]}
    (tmp_path / "cam2" / "img00006.json").write_text(json.dumps(empty))
    capture = fewview.read(tmp_path)
    assert capture.frames == 7
    assert np.isnan(capture.keypoints[6]).all()
    as_it_was_seen(replace(capture, keypoints=capture.keypoints[:6]))
    assert capture.image_sizes == (SIZE, SIZE)


def joints(view: int, frame: int, layout: str) -> Any:
    """Return the joints of a frame as different makers write them."""
    points = present(view, frame)
    if layout == "lists":
        return {"people": [{"keypoints": {name: [x, y, c] for name, x, y, c in points}}]}
    if layout == "listed":
        named = [{"name": name, "x": x, "y": y, "score": c} for name, x, y, c in points]
        return {"frame": frame, "joints": named}
    if layout == "null":
        absent = {name: None for name in NAMES if name not in [point[0] for point in points]}
        return {"keypoints": absent | {name: {"x": x, "y": y} for name, x, y, _ in points}}
    return {"frame": frame} | {name: {"x": x, "y": y} for name, x, y, _ in points}


def test_a_file_for_each_frame_of_joints_by_name(tmp_path: Path) -> None:
    for view in range(2):
        folder = tmp_path / f"cam{view + 1}"
        folder.mkdir()
        for frame in range(6):
            content = {
                "landmarks": {name: {"x": x, "y": y} for name, x, y, _ in present(view, frame)}
            }
            (folder / f"frame_{frame:04d}.json").write_text(json.dumps(content))
    as_it_was_seen(fewview.read(tmp_path))


@pytest.mark.parametrize("layout", ["lists", "listed", "null", "bare"])
def test_joints_by_name_are_a_union_with_gaps(tmp_path: Path, layout: str) -> None:
    for view in range(2):
        content = [joints(view, frame, layout) for frame in range(6)]
        (tmp_path / f"cam{view + 1}.json").write_text(json.dumps({"frames": content}))
    as_it_was_seen(fewview.read(tmp_path))


def test_lists_of_frames_are_cameras_and_no_frames(tmp_path: Path) -> None:
    """A file for each camera, with a list of frames, of which each has one body."""
    for layout in ("time", "camel", "bare"):
        folder = tmp_path / layout
        folder.mkdir()
        for view in range(2):
            frames = []
            for frame in range(40):
                points = present(view, frame % 6)
                joint = {name: {"location": [x, y], "confidence": c} for name, x, y, c in points}
                listed = [{"jointName": name, **each} for name, each in joint.items()]
                moment = {"time": {"timestampMs": 40 * frame}, "camel": {"frameIndex": frame}}
                frames.append(moment.get(layout, {}) | {"joints": listed})
            (folder / f"cam{view + 1}.json").write_text(json.dumps(frames))
        capture = fewview.read(folder)
        assert (capture.frames, capture.views) == (40, 2)
        as_it_was_seen(replace(capture, keypoints=capture.keypoints[:6], confidence=None))
        if layout == "time":
            assert capture.times is not None
            np.testing.assert_allclose(capture.times, np.arange(40) / 25)


def test_cameras_of_other_rates_are_joined_by_the_times_in_json(tmp_path: Path) -> None:
    for view, rate in enumerate((50, 25)):
        frames = [
            {"timestamp": n / rate, "joints": {k: {"x": 100 * n / rate, "y": 9} for k in NAMES}}
            for n in range(2 * rate)
        ]
        (tmp_path / f"cam{view + 1}.json").write_text(json.dumps(frames))
    x = fewview.read(tmp_path).keypoints[..., 0, 0]
    both = np.isfinite(x).all(1)
    assert both.sum() == 50
    np.testing.assert_allclose(x[both, 0], x[both, 1], atol=1e-4)


def test_large_images_in_files_of_labelme_take_no_memory(tmp_path: Path) -> None:
    shapes = [{"label": n, "points": [[8, 9]], "shape_type": "point"} for n in NAMES]
    for frame in range(60):
        content = {"shapes": shapes, "imageData": "A" * 200_000}
        (tmp_path / f"img{frame:02d}.json").write_text(json.dumps(content))
    fewview.read(tmp_path)  # what is imported and cached counts for nothing
    tracemalloc.start()
    try:
        assert fewview.read(tmp_path).frames == 60
        assert tracemalloc.get_traced_memory()[1] < 3e6  # of 12e6
    finally:
        tracemalloc.stop()


VISION = {
    "nose": "head_joint",
    "neck": "neck_1_joint",
    "root": "root",
    "leftHip": "left_upLeg_joint",
    "leftKnee": "left_leg_joint",
}


@pytest.mark.parametrize("identifiers", [False, True])
@pytest.mark.parametrize("downwards", [False, True])
def test_apple_vision_counts_y_upwards(tmp_path: Path, identifiers: bool, downwards: bool) -> None:
    upright = np.array([(400, 100), (400, 150), (400, 350), (380, 350), (380, 500)], float)
    frames = []
    for frame in range(8):
        y = (upright + frame)[:, 1] / SIZE[1]
        recognized = {
            VISION[name] if identifiers else name: {
                "location": {"x": (400 + frame) / SIZE[0], "y": at if downwards else 1 - at},
                "confidence": 0.9,
            }
            for place, (name, at) in enumerate(zip(VISION, y, strict=True))
            if (frame + place) % 4
        }
        frames.append({"timestamp": frame / 30, "bodies": [{"joints": recognized}]})
    (tmp_path / "cam1.json").write_text(json.dumps(frames))
    capture = fewview.read(tmp_path / "cam1.json", image_size=SIZE)
    assert "Apple Vision" in capture.notes[0]
    assert any("upwards" in note for note in capture.notes) != downwards
    named = dict(zip(capture.keypoint_names or (), capture.keypoints[5, 0, :, 1], strict=True))
    expected = dict(zip(VISION.values() if identifiers else VISION, upright[:, 1] + 5, strict=True))
    for name, y in named.items():
        assert np.isnan(y) or abs(y - expected[name]) < 0.01
    assert np.isnan(list(named.values())).sum() == 1


def test_tables_of_apple_vision_are_turned_too(tmp_path: Path) -> None:
    header = ",".join(f"{name}_x,{name}_y" for name in VISION)
    row = ",".join(f"0.5,{y}" for y in (0.9, 0.8, 0.5, 0.5, 0.2))
    (tmp_path / "cam1.csv").write_text("\n".join([header, *[row] * 4]))
    ways: tuple[Literal["down", "up"], ...] = ("down", "up")
    for way in ways:
        y = fewview.read(tmp_path / "cam1.csv", image_size=SIZE, y=way).keypoints[0, 0, :, 1]
        np.testing.assert_allclose(y, SIZE[1] * np.array([0.1, 0.2, 0.5, 0.5, 0.8]), atol=1.01)


def test_names_that_are_no_keypoints_are_refused(tmp_path: Path) -> None:
    frames = [
        {"joints": {f"at{frame}_{n}": {"x": 1, "y": 2} for n in range(3)}} for frame in range(900)
    ]
    (tmp_path / "cam1.json").write_text(json.dumps(frames))
    with pytest.raises(FormatError, match="names"):
        fewview.read(tmp_path / "cam1.json")
