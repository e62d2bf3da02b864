"""JSON and labels of people frame by frame, in the layouts that detectors give them."""

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from tests.tiers import thorough_after

from . import files

BODY = files.walk(12, 17)
Points = list[list[float]]
Write = Callable[[Path], None]


def points(n: int) -> Points:
    return [[float(v) for v in point] for point in BODY[n]]


def flat(n: int) -> list[float]:
    return [v for point in points(n) for v in point]


def scored(n: int) -> dict[str, Any]:
    return {"keypoints": [p[:2] for p in points(n)], "keypoint_scores": [p[2] for p in points(n)]}


def columns(n: int, **names: int) -> dict[str, Any]:
    return {name: [p[place] for p in points(n)] for name, place in names.items()}


FRAMES = range(12)
FILES: dict[str, tuple[str, Callable[[], Any]]] = {  # title, what is in the file of a video
    "mmpose": (
        "MMPose",
        lambda: {"instance_info": [{"frame_id": n, "instances": [scored(n)]} for n in FRAMES]},
    ),
    "mmpose-inferencer": ("MMPose", lambda: [{"predictions": [[scored(n)]]} for n in FRAMES]),
    "mmpose-one": ("MMPose", lambda: {"predictions": [[scored(n)] for n in FRAMES]}),
    "mmpose-0": (
        "JSON of people",
        lambda: [[{"bbox": [1, 2, 3, 4, 0.9], "keypoints": points(n)}] for n in FRAMES],
    ),
    "mmpose-0-wrapped": (
        "JSON of people",
        lambda: [{"pose_results": [{"keypoints": points(n)}]} for n in FRAMES],
    ),
    "alphapose-cmu": (
        "AlphaPose",
        lambda: {
            f"{n}.jpg": {"version": "AlphaPose v0.3", "bodies": [{"joints": flat(n)}]}
            for n in FRAMES
        },
    ),
    "alphapose-open": (
        "AlphaPose",
        lambda: {
            f"{n}.jpg": {"version": "AlphaPose v0.3", "people": [{"pose_keypoints_2d": flat(n)}]}
            for n in FRAMES
        },
    ),
    "alphapose": (
        "COCO",
        lambda: [
            {"image_id": f"{n}.jpg", "category_id": 1, "keypoints": flat(n), "score": 2.7}
            for n in FRAMES
        ],
    ),
    "vitpose": (
        "ViTPose",
        lambda: {
            "keypoints": [{"0": [[y, x, c] for x, y, c in points(n)]} for n in FRAMES],
            "skeleton": {str(k): f"k{k}" for k in range(17)},
        },
    ),
    "superanimal": (
        "SuperAnimal",
        lambda: [{"bodyparts": [points(n)], "bboxes": [[1, 2, 3, 4]]} for n in FRAMES],
    ),
    "yolo": (
        "YOLO",
        lambda: [
            [{"name": "person", "keypoints": columns(n, x=0, y=1, visible=2)}] for n in FRAMES
        ],
    ),
    "movenet": (
        "JSON of people",
        lambda: [
            {
                "keypoints": [
                    {"x": x, "y": y, "score": c, "name": f"k{k}"}
                    for k, (x, y, c) in enumerate(points(n))
                ]
            }
            for n in FRAMES
        ],
    ),
    "posenet": (
        "JSON of people",
        lambda: [
            [
                {
                    "pose": {
                        "keypoints": [
                            {"part": f"k{k}", "position": {"x": x, "y": y}, "score": c}
                            for k, (x, y, c) in enumerate(points(n))
                        ]
                    }
                }
            ]
            for n in FRAMES
        ],
    ),
    "openpifpaf": (
        "JSON of people",
        lambda: [{"frame": n + 1, "predictions": [{"keypoints": flat(n)}]} for n in FRAMES],
    ),
    "a map of names": (
        "JSON of people",
        lambda: [
            {"frame": n, "keypoints": {f"k{k}": p for k, p in enumerate(points(n))}} for n in FRAMES
        ],
    ),
    "records": (
        "JSON of people",
        lambda: {"frames": [{"frame": n, "persons": [{"keypoints": points(n)}]} for n in FRAMES]},
    ),
}

FILES |= {
    "frames by number": (
        "JSON of people",
        lambda: {"frames": {str(n): {"keypoints": points(n)} for n in FRAMES}},
    ),
    "arrays": ("JSON of people", lambda: [points(n) for n in FRAMES]),
    "arrays of people": ("JSON of people", lambda: [[points(n)] for n in FRAMES]),
    "arrays under a name": ("JSON of people", lambda: {"keypoints": [points(n) for n in FRAMES]}),
}


def assert_read(path: Path, title: str) -> None:
    capture = fewview.read(path)
    assert title in capture.notes[0]
    np.testing.assert_allclose(capture.keypoints[:, 0], BODY[..., :2], rtol=1e-5)
    assert capture.confidence is not None
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence[:, 0], BODY[..., 2], rtol=1e-5)
    assert capture.keypoint_names is not None


@pytest.mark.parametrize("layout", FILES)
@pytest.mark.parametrize("lines", [False, True])
def test_a_file_of_a_video(tmp_path: Path, layout: str, lines: bool) -> None:
    title, content = FILES[layout]
    message = content()
    path = tmp_path / "cam1.json"
    if lines and isinstance(message, list):
        path.write_text("".join(json.dumps(one) + "\n" for one in message), encoding="utf-16")
    else:
        path.write_text(json.dumps(message))
    assert_read(path, title)


def test_a_file_of_several_cameras(tmp_path: Path) -> None:
    message = [{"frame": n, "keypoints": points(n)} for n in FRAMES]
    path = tmp_path / "all.json"
    path.write_text(json.dumps({"left": message, "right": message[3:]}))
    capture = fewview.read(path)
    assert capture.view_names == ("left", "right")
    np.testing.assert_allclose(capture.keypoints[3:, 1], BODY[3:, :, :2], rtol=1e-5)
    assert np.isnan(capture.keypoints[:3, 1]).all()


def test_flat_pairs_have_no_confidence(tmp_path: Path) -> None:
    for count in (17, 12):
        message = [{"keypoints": [v for p in points(n)[:count] for v in p[:2]]} for n in FRAMES]
        (tmp_path / "a.json").write_text(json.dumps(message))
        capture = fewview.read(tmp_path / "a.json")
        np.testing.assert_allclose(capture.keypoints[:, 0], BODY[:, :count, :2], rtol=1e-5)
        assert capture.confidence is None


def easymocap(path: Path, n: int) -> None:
    who = [{"personID": 0, "bbox": [1, 2, 3, 4, 0.9], "keypoints": points(n)}]
    fields = {"filename": f"{n:06d}.jpg", "height": 1080, "width": 1920, "annots": who}
    (path / f"{n:06d}.json").write_text(json.dumps(fields))


def inferencer(path: Path, n: int) -> None:
    (path / f"{n + 1:06d}.json").write_text(json.dumps([scored(n)]))


def label(
    path: Path, n: int, more: str = "", *, body: files.Array = BODY, dimensions: int = 3
) -> None:
    shares = body[n] / (640, 480, 1)
    seen = shares[shares[:, 2] > 0, :2]
    low, high = seen.min(axis=0), seen.max(axis=0)
    numbers = [*(low + high) / 2, *high - low, *shares[:, :dimensions].ravel()]
    line = " ".join(f"{number:.8f}" for number in numbers)
    (path / f"film_{n + 1}.txt").write_text(f"0 {line}{more}\n")


def test_images_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for n in range(3):
        label(tmp_path, n)
    (tmp_path / "film_1.txt").rename(tmp_path / "later_1.txt")
    capture = fewview.read(tmp_path, image_size=(640, 480))
    np.testing.assert_allclose(capture.keypoints[:, 0], BODY[:3, :, :2], rtol=1e-5)
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence[:, 0], BODY[:3, :, 2], rtol=1e-5)


@pytest.mark.parametrize("name", ["inf", "nan", "0.5"])
def test_a_class_that_is_no_whole_number_is_none(tmp_path: Path, name: str) -> None:
    for n in range(3):
        label(tmp_path, n)
    last = tmp_path / "film_3.txt"
    last.write_text(f"{name} {last.read_text().partition(' ')[2]}")
    with pytest.raises(FormatError, match="no line of YOLO"):
        fewview.read(tmp_path, image_size=(640, 480))


@pytest.mark.parametrize(
    ("title", "write"),
    [
        ("EasyMocap", easymocap),
        ("MMPose", inferencer),
        ("YOLO", label),
        ("YOLO", lambda path, n: label(path, n, " 1")),
        ("YOLO", lambda path, n: label(path, n, " 0.87 1")),
    ],
)
def test_a_file_for_each_image(
    tmp_path: Path, title: str, write: Callable[[Path, int], None]
) -> None:
    inside = {"MMPose": "predictions", "YOLO": "labels"}.get(title, "")
    for camera in ("cam1", "cam2"):
        folder = tmp_path / camera / inside
        folder.mkdir(parents=True)
        for n in FRAMES:
            if n != 5 or camera == "cam1":  # nobody was seen there
                write(folder, n)
    capture = fewview.read(tmp_path, image_size=(640, 480))
    assert title in capture.notes[0]
    assert capture.view_names == ("cam1", "cam2")
    np.testing.assert_allclose(capture.keypoints[:, 0], BODY[..., :2], rtol=1e-5)
    assert np.isnan(capture.keypoints[5, 1]).all()
    np.testing.assert_allclose(capture.keypoints[6:, 1], BODY[6:, :, :2], rtol=1e-5)


@pytest.mark.parametrize(
    ("count", "dimensions", "more"),
    [
        (14, 3, ("",)),  # as many numbers as a hand's 21 pairs
        (18, 3, ("",)),  # as 26 pairs, a confidence and a track
        (11, 3, (" 0.87",)),  # as 17 pairs
        (12, 2, ("",)),  # as 8 triples
        (26, 2, (" 0.87",)),  # as 17 triples, a confidence and a track
        (14, 3, (" 0.87", " 0.87 1")),  # somebody who is tracked only at times
    ],
)
def test_labels_of_any_skeleton_are_parted_by_their_boxes(
    tmp_path: Path, count: int, dimensions: int, more: tuple[str, ...]
) -> None:
    body = files.walk(12, count)
    body[4, 2] = 0  # not seen
    for n in FRAMES:
        label(tmp_path, n, more[n % len(more)], body=body, dimensions=dimensions)
    capture = fewview.read(tmp_path, image_size=(640, 480))
    body[4, 2] = (np.nan, np.nan, 0)
    np.testing.assert_allclose(capture.keypoints[:, 0], body[..., :2], rtol=1e-5)
    if dimensions == 2:
        assert capture.confidence is None
    else:
        assert capture.confidence is not None
        np.testing.assert_allclose(capture.confidence[:, 0], body[..., 2], rtol=1e-5)


def test_sizes_in_files_are_those_of_cameras(tmp_path: Path) -> None:
    for n in FRAMES:
        easymocap(tmp_path, n)
    assert fewview.read(tmp_path).image_sizes == ((1920, 1080),)


def test_3d_in_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps([[{**scored(n), "keypoints": points(n)}] for n in FRAMES]))
    with pytest.raises(FormatError, match="not 2D"):
        fewview.read(path)


@pytest.mark.parametrize("seed", thorough_after(2, range(6)))
def test_mutated_files_are_read_or_refused_in_words(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = [json.dumps(content()).encode() for _, content in FILES.values()]
    table = files.dlc_csv(tmp_path / "t", files.columns(files.NAMES), BODY[:, :4].reshape(12, -1))
    whole += [
        table.read_bytes(),
        table.read_bytes().replace(b",", b";"),
        b"frame,nose_x,nose_y\n1,2,3\n",
    ]
    path = tmp_path / "cam"
    for content, _ in product(whole, range(4)):
        changed = bytearray(content)
        for at in rng.integers(0, len(content), rng.integers(1, 6)):
            changed[at] = rng.choice(list(b'0"{}[],;.\n-x\xff\x00e'))
        cut = rng.integers(1, len(content)) if rng.random() < 0.3 else len(content)
        path.write_bytes(changed[:cut])
        try:
            fewview.read(path, image_size=(640, 480))
        except FormatError as error:
            assert str(error)  # noqa: PT017
