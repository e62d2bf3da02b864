"""Folders in a zip are read as `fewview` reads them: a folder is a view, their parent a capture."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview.calibration import Camera, write_cameras
from fewview.readers import read
from starlette.testclient import TestClient

from tests.client.readers import files
from tests.service.conftest import problem, zip_of

NAMES = files.NAMES
VIEWS = [files.walk(10, start=100 + 60 * view, seed=view) for view in range(3)]
Layout = Callable[[Path], list[Path]]


def frame_files(folder: Path, values: files.Array, name: str = "") -> Path:
    """Write a JSON file a frame, as OpenPose does."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, frame in enumerate(values):
        people = [{"pose_keypoints_2d": frame.ravel().round(3).tolist()}]
        file = folder / f"{name}{n:012}_keypoints.json"
        file.write_text(json.dumps({"version": 1.3, "people": people}))
    return folder


def table(path: Path, values: files.Array) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return files.dlc_csv(path, files.columns(NAMES), values.reshape(len(values), -1))


def cameras(*names: str) -> list[Camera]:
    matrix = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    return [
        Camera(name, matrix, np.zeros(5), np.eye(3), np.array([0.3 * n, 0, 3.0]), (640, 480))
        for n, name in enumerate(names)
    ]


def four_openpose_folders(top: Path) -> list[Path]:
    return [frame_files(top / f"cam{v}", values) for v, values in enumerate(VIEWS)]


def a_parent_of_folders(top: Path) -> list[Path]:
    for v, values in enumerate(VIEWS):
        frame_files(top / "session" / f"cam{v}", values)
    return [top / "session"]


def pose2sim(top: Path) -> list[Path]:
    for v, values in enumerate(VIEWS):
        frame_files(top / "trial" / "pose" / f"cam{v}_json", values, f"cam{v}_")
    (top / "trial" / "calibration").mkdir()
    write_cameras(
        top / "trial" / "calibration" / "Calib.toml", cameras("cam0", "cam1", "cam2"), "anipose"
    )
    (top / "trial" / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    return [top / "trial"]


def pose2sim_cameras_apart(top: Path) -> list[Path]:
    for v, values in enumerate(VIEWS):
        frame_files(top / f"cam{v}" / "json", values)
    return [top / f"cam{v}" for v in range(3)]


def anipose(top: Path) -> list[Path]:
    for camera, values in zip("ABC", VIEWS, strict=True):
        table(top / "fly" / "pose-2d" / f"run1_cam{camera}.csv", values)
        table(top / "fly" / "pose-2d-filtered" / f"run1_cam{camera}.csv", values)
    (top / "fly" / "calibration").mkdir()
    write_cameras(top / "fly" / "calibration" / "calibration.toml", cameras("A", "B", "C"))
    return [top / "fly"]


def calibration_beside(top: Path) -> list[Path]:
    for v, values in enumerate(VIEWS):
        table(top / "walk" / f"cam{v}.csv", values)
    write_cameras(top / "walk" / "calibration.toml", cameras("cam2", "cam1", "cam0"), "anipose")
    return [top / "walk"]


def calibration_in_json_beside_frames(top: Path) -> list[Path]:
    paths = four_openpose_folders(top)
    write_cameras(top / "calib.json", cameras("cam0", "cam1", "cam2"), "opencv")
    return [*paths, top / "calib.json"]


def deeplabcut(top: Path) -> list[Path]:
    network = "DLC_resnet50_walkApr1shuffle1_50000"
    for v, values in enumerate(VIEWS):
        table(top / "videos" / f"cam{v}{network}.csv", values)
        table(top / "videos" / f"cam{v}{network}_filtered.csv", values)
    return [top / "videos"]


def a_file_for_each_camera(top: Path) -> list[Path]:
    for v, values in enumerate(VIEWS):
        table(top / "day" / f"view_{v}.csv", values)
    (top / "day" / "notes.md").write_text("sunny\n")
    return [top / "day"]


def one_camera_of_frames(top: Path) -> list[Path]:
    return [frame_files(top / "json", VIEWS[0])]


def files_and_folders(top: Path) -> list[Path]:
    return [frame_files(top / "left", VIEWS[0]), table(top / "right.csv", VIEWS[1][:, :4])]


def frames_one_by_one(top: Path) -> list[Path]:
    values = np.concatenate([VIEWS[0]] * 7)
    return sorted(frame_files(top, values).glob("*.json"))


LAYOUTS: dict[Layout, tuple[int, int]] = {  # views and frames
    four_openpose_folders: (3, 10),
    a_parent_of_folders: (3, 10),
    pose2sim: (3, 10),
    pose2sim_cameras_apart: (3, 10),
    anipose: (3, 10),
    calibration_beside: (3, 10),
    calibration_in_json_beside_frames: (3, 10),
    deeplabcut: (3, 10),
    a_file_for_each_camera: (3, 10),
    one_camera_of_frames: (1, 10),
    files_and_folders: (2, 10),
    frames_one_by_one: (1, 70),
}
CALIBRATED: dict[Layout, str] = {
    pose2sim: "Calib.toml",
    anipose: "calibration.toml",
    calibration_beside: "calibration.toml",
    calibration_in_json_beside_frames: "calib.json",
}


def packed(top: Path) -> list[tuple[str, tuple[str, bytes]]]:
    inside = {str(p.relative_to(top)): p.read_bytes() for p in top.rglob("*") if p.is_file()}
    return [("folders", ("folders.zip", zip_of(inside)))]


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.__name__)
def test_every_layout_is_what_the_command_line_reads(
    api: TestClient, layout: Layout, tmp_path: Path
) -> None:
    expected = read(layout(tmp_path))
    answer = api.post("/previews", files=packed(tmp_path))
    assert answer.status_code == 200, answer.text
    seen = answer.json()
    assert (seen["views"], seen["frames"]) == LAYOUTS[layout]
    assert (expected.views, expected.frames) == LAYOUTS[layout]
    if layout is not frames_one_by_one:  # named after a folder, which is not sent
        assert seen["view_names"] == list(expected.view_names or ())
    assert seen["notes"] == list(expected.notes)
    there = expected.keypoints[seen["frame"]]
    shown = [[point or [np.nan] * 2 for point in view] for view in seen["frame_keypoints"]]
    np.testing.assert_allclose(shown, there, atol=1e-3)
    calibration = seen["calibration"]
    assert (calibration and calibration["file"]) == CALIBRATED.get(layout)
    if expected.calibration is not None:
        assert calibration["names"] == list(expected.calibration.names)
        moved = [camera["translation"] for camera in expected.calibration.cameras]
        assert [camera["translation"] for camera in calibration["cameras"]] == moved


def stored(api: TestClient, top: Path) -> str:
    answer = api.post("/datasets", files=packed(top))
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def test_a_fit_may_use_the_calibration_that_came_with_the_dataset(
    api: TestClient, tmp_path: Path
) -> None:
    calibration_beside(tmp_path)
    dataset = stored(api, tmp_path)
    known = api.get(f"/datasets/{dataset}").json()["calibration"]
    assert known["names"] == ["cam0", "cam1", "cam2"]
    made = api.post("/fits", json={"dataset_id": dataset, "calibration": "dataset"})
    assert made.status_code == 202, made.text
    assert made.json()["config"]["calibration"] == known["cameras"]
    both = {"calibration": "dataset", "config": {"calibration": known["cameras"]}}
    answer = api.post("/fits", json={"dataset_id": dataset, **both})
    problem(answer, 422, "invalid_input", "/calibration")
    # The same in JSON, of which a dataset has one for each view or none.
    views = [[[1, 2]] * 4] * 3
    body = {"keypoints": [views], "calibration": known}
    made = api.post("/datasets", json=body)
    assert made.status_code == 201, made.text
    assert made.json()["calibration"] == known
    answer = api.post("/datasets", json=body | {"keypoints": [views[:2]]})
    problem(answer, 422, "invalid_input", "/calibration/cameras")
    bare = api.post("/datasets", json={"keypoints": [views[:2]]}).json()["id"]
    answer = api.post("/fits", json={"dataset_id": bare, "calibration": "dataset"})
    assert "came without" in problem(answer, 422, "invalid_input", "/calibration")


def test_a_calibration_file_is_read_for_the_views_of_a_dataset(
    api: TestClient, tmp_path: Path
) -> None:
    a_file_for_each_camera(tmp_path / "data")
    where = f"/previews/calibrations?dataset_id={stored(api, tmp_path / 'data')}"
    for name in ("rig.toml", "rig.yml", "rig.json"):
        kind = "anipose" if name.endswith("toml") else "opencv"
        file = write_cameras(tmp_path / name, cameras("one", "two", "three"), kind)
        answer = api.post(where, files=[("files", ("calibration_" + name, file.read_bytes()))])
        assert answer.status_code == 200, answer.text
        assert answer.json()["names"] == ["one", "two", "three"]
        assert answer.json()["cameras"][1]["translation"] == [0.3, 0, 3]
        assert "in the order of views" in answer.json()["notes"][0]
    two = write_cameras(tmp_path / "two.toml", cameras("one", "two"), "anipose").read_bytes()
    answer = api.post(where, files=[("files", ("two.toml", two))])
    assert "has 2 cameras (one, two), and there are 3" in problem(
        answer, 422, "invalid_input", "/files"
    )
    answer = api.post(where, files=[("files", ("notes.md", b"sunny"))])
    assert "no calibration that is known" in problem(answer, 422, "invalid_input", "/files")


def test_a_preview_shows_whom_each_view_shows(api: TestClient, tmp_path: Path) -> None:
    for v, (one, other) in enumerate([(0, 1), (1, 0)]):
        folder = tmp_path / f"cam{v}"
        folder.mkdir()
        for n in range(10):
            shown = [VIEWS[who][n] + (500 * who, 0, 0) for who in (one, other)]
            people = [{"pose_keypoints_2d": each.ravel().tolist()} for each in shown]
            (folder / f"{n:012}_keypoints.json").write_text(json.dumps({"people": people}))
    seen = api.post("/previews", files=packed(tmp_path)).json()
    assert [len(view["people"]) for view in seen["people"]] == [2, 2]
    assert all(one["frames"] == 10 for view in seen["people"] for one in view["people"])

    def left(view: dict[str, Any]) -> int:
        """Return the number of who is on the left."""
        return min(view["people"], key=lambda one: one["keypoints"][0][0])["index"]  # type: ignore[no-any-return]

    wanted = [left(view) for view in seen["people"]]
    person = ",".join(map(str, wanted))
    chosen = api.post("/previews", files=packed(tmp_path), data={"person": person}).json()
    picked = [
        [one["index"] for one in view["people"] if one["picked"]] for view in chosen["people"]
    ]
    assert picked == [[number] for number in wanted]
    places = np.array(chosen["frame_keypoints"])
    assert (places[..., 0] < 400).all()


def test_who_packs_folders_is_told_what_is_wrong(api: TestClient) -> None:
    def refused(data: bytes) -> str:
        answer = api.post("/previews", files=[("folders", ("folders.zip", data))])
        return problem(answer, 422, "invalid_input", "/files")

    assert "no files" in refused(zip_of({}))
    assert "no files" in refused(zip_of({"../../cam/0.json": b"{}"}))
    assert "folders within each other" in refused(zip_of({"a/" * 40 + "0.json": b"{}"}))
    assert "cannot be read" in refused(b"no zip")
    answer = api.post("/previews", files=[("folders", ("a.zip", b"")), ("files", ("b.csv", b"x"))])
    problem(answer, 400, "malformed_body")
