"""Labels in the formats of those who train detectors: our readers read the same numbers."""

import csv
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from fewview import read
from fewview.errors import FormatError
from fewview.readers.pandas_h5 import read_table
from fewview.readers.sources import Source
from fewview.writers.labels import LABEL_FORMATS, Labels, ViewLabels, write_labels

NAMES = ("nose", "left ear", "tail é", "paw")
FRAMES = np.array([3, 40, 117])


def labels() -> Labels:
    rng = np.random.default_rng(3)
    views = []
    for name, size in (("cam1", (1280, 720)), ("cam 2/left", None)):
        keypoints = np.round(rng.uniform(20, 700, (3, 4, 2)), 3)
        weights = np.round(rng.uniform(0.2, 1, (3, 4)), 3)
        keypoints[1, 2] = np.nan
        weights[1, 2] = 0
        detected = rng.random((3, 4)) < 0.7
        views.append(ViewLabels(name, FRAMES, keypoints, weights, detected, size))
    return Labels(tuple(views), NAMES, ((0, 1), (0, 2)), scorer="anna", length=2000)


@pytest.mark.parametrize("format", [known.name for known in LABEL_FORMATS])
def test_our_readers_read_what_is_written(format: str, tmp_path: Path) -> None:
    made = labels()
    files = write_labels(tmp_path, made, format)
    assert all(file.exists() for file in files)
    kinds = {file.suffix for file in files}
    for suffix in kinds:
        mine = [file for file in files if file.suffix == suffix]
        capture = read(mine)
        assert capture.keypoint_names == NAMES
        for view, written in enumerate(made.views):
            rows = capture.keypoints[:, view][np.isin(_numbers(capture), FRAMES)]
            np.testing.assert_array_equal(rows, written.keypoints.astype(np.float32))
        if format == "dlc-machine":
            assert capture.confidence is not None
            some = np.isin(_numbers(capture), FRAMES)
            for view, written in enumerate(made.views):
                np.testing.assert_allclose(capture.confidence[some, view], written.weights)


def _numbers(capture: object) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    numbers = getattr(capture, "numbers", None)
    count = len(getattr(capture, "keypoints", ()))
    return np.arange(count) if numbers is None else np.asarray(numbers)


def table(file: Path) -> list[list[str]]:
    return list(csv.reader(file.read_text(encoding="utf-8").splitlines()))


def test_deeplabcut_has_its_folders_names_and_rows(tmp_path: Path) -> None:
    write_labels(tmp_path, labels(), "dlc")
    folder = tmp_path / "labeled-data" / "cam1"
    assert {file.name for file in folder.iterdir()} == {
        "CollectedData_anna.csv",
        "CollectedData_anna.h5",
    }
    rows = table(folder / "CollectedData_anna.csv")
    assert rows[0] == ["scorer", "", "", *["anna"] * 8]
    assert rows[1][:5] == ["bodyparts", "", "", "nose", "nose"]
    assert rows[2] == ["coords", "", "", *["x", "y"] * 4]
    assert rows[3][:3] == ["labeled-data", "cam1", "img0003.png"]
    assert rows[4][7:9] == ["", ""]
    assert (tmp_path / "labeled-data" / "cam_2_left").is_dir()
    columns, levels, values, named = read_table(Source(folder / "CollectedData_anna.h5"))
    assert levels == ["scorer", "bodyparts", "coords"]
    assert columns[4] == ("anna", "tail é", "x")
    assert named[2] == ("labeled-data", "cam1", "img0117.png")
    np.testing.assert_array_equal(values, labels().views[0].keypoints.reshape(3, 8))
    with h5py.File(folder / "CollectedData_anna.h5") as file:
        assert file["df_with_missing"].attrs["pandas_type"] == b"frame"


def test_coco_has_visibility_weights_boxes_and_the_skeleton(tmp_path: Path) -> None:
    made = labels()
    [file] = write_labels(tmp_path, made, "coco")
    content = json.loads(file.read_text(encoding="utf-8"))
    assert [image["file_name"] for image in content["images"][:2]] == [
        "labeled-data/cam1/img0003.png",
        "labeled-data/cam1/img0040.png",
    ]
    assert (content["images"][0]["width"], content["images"][0]["height"]) == (1280, 720)
    assert "width" not in content["images"][3]
    [category] = content["categories"]
    assert category["keypoints"] == list(NAMES)
    assert category["skeleton"] == [[1, 2], [1, 3]]
    for row, one in enumerate(content["annotations"][:3]):
        view = made.views[0]
        found = np.array(one["keypoints"]).reshape(4, 3)
        expected = np.where(view.labelled[row], 1 + view.detected[row], 0)
        np.testing.assert_array_equal(found[:, 2], expected)
        np.testing.assert_array_equal(one["keypoint_weights"], view.weights[row])
        assert one["num_keypoints"] == view.labelled[row].sum()
        left, top, width, height = one["bbox"]
        known = found[found[:, 2] > 0]
        assert (known[:, 0] >= left).all()
        assert (known[:, 1] <= top + height).all()
        assert one["area"] == pytest.approx(width * height, abs=0.01)


def test_lightning_pose_names_rows_by_paths(tmp_path: Path) -> None:
    files = write_labels(tmp_path, labels(), "lightning-pose")
    assert [file.name for file in files] == [
        "CollectedData_cam1.csv",
        "CollectedData_cam_2_left.csv",
    ]
    assert [row[0] for row in table(files[0])[:4]] == [
        "scorer",
        "bodyparts",
        "coords",
        "labeled-data/cam1/img0003.png",
    ]


def test_views_have_different_folders_whose_names_files_can_have() -> None:
    views = labels().views
    twice = [
        ViewLabels(name, FRAMES, views[0].keypoints, views[0].weights, views[0].detected)
        for name in ("a/b", "a b", "..", "a_b")
    ]
    assert Labels(tuple(twice), NAMES).folders == ("a_b", "a_b-2", "view", "a_b-3")


def test_the_same_labels_are_the_same_bytes(tmp_path: Path) -> None:
    for known in LABEL_FORMATS:
        first, second = (
            write_labels(tmp_path / known.name / part, labels(), known.name) for part in "ab"
        )
        assert [file.read_bytes() for file in first] == [file.read_bytes() for file in second]


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no format 'sleap' of labels; there are: dlc"):
        write_labels(tmp_path, labels(), "sleap")
    view = labels().views[0]
    with pytest.raises(ValueError, match=r"keypoints of cam1 must be \(3, 2, 2\)"):
        Labels((view,), ("a", "b"))
    with pytest.raises(ValueError, match="scorer"):
        Labels((view,), NAMES, scorer="../anna")
