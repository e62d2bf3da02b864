"""What the readers of the rarer formats make of a small file, number by number."""

import json
import pickle
from pathlib import Path
from typing import Any

import ezc3d
import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files

XYZ = files.walk(6)
BODY = files.walk(6, 17)


def assert_shows(capture: fewview.Capture, *views: Any, atol: float = 1e-4) -> None:
    """Compare with views (N, P, 3) of x, y, confidence."""
    expected = np.stack(views, axis=1)
    np.testing.assert_allclose(capture.keypoints, expected[..., :2], atol=atol)
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence, expected[..., 2], atol=1e-6)


def instances(frame: Any) -> list[dict[str, Any]]:
    return [{"keypoints": frame[:, :2].tolist(), "keypoint_scores": frame[:, 2].tolist()}]


@pytest.mark.parametrize("described", [False, True])
def test_mmpose_of_a_video(tmp_path: Path, described: bool) -> None:
    records: Any = [{"frame_id": n, "instances": instances(BODY[n])} for n in range(6)]
    if described:
        names = {str(i): f"k{i}" for i in range(17)}
        meta = {"keypoint_id2name": names, "skeleton_links": [[0, 1]]}
        records = {"meta_info": meta, "instance_info": records}
    (tmp_path / "results_cam1.json").write_text(json.dumps(records))
    capture = fewview.read(tmp_path / "results_cam1.json")
    assert_shows(capture, BODY)
    assert capture.keypoint_names is not None
    assert capture.keypoint_names[0] == ("k0" if described else "nose")
    assert not described or capture.edges == ((0, 1),)


def test_mmpose_of_images(tmp_path: Path) -> None:
    for camera in ("a", "b"):
        (tmp_path / camera).mkdir()
        for n, frame in enumerate(BODY):
            (tmp_path / camera / f"img_{n}.json").write_text(json.dumps(instances(frame)))
    assert_shows(fewview.read(tmp_path), BODY, BODY)


def test_mmpose_in_3d_is_refused(tmp_path: Path) -> None:
    one = {"keypoints": [[1, 2, 3]] * 17, "keypoint_scores": [1.0] * 17}
    (tmp_path / "a.json").write_text(json.dumps([{"frame_id": 0, "instances": [one]}]))
    with pytest.raises(FormatError, match="not 2D"):
        fewview.read(tmp_path / "a.json")


def test_mediapipe(tmp_path: Path) -> None:
    body = files.walk(6, 33)
    frames = [
        {"pose_landmarks": [{"x": x / 640, "y": y / 480, "visibility": v} for x, y, v in frame]}
        for frame in body
    ]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(frames))
    with pytest.raises(FormatError, match="image_size"):
        fewview.read(path)
    capture = fewview.read(path, image_size=(640, 480))
    assert_shows(capture, body, atol=1e-3)
    assert capture.keypoint_names is not None
    assert capture.keypoint_names[11] == "left_shoulder"
    path.write_text(json.dumps({"width": 640, "height": 480, "fps": 10, "frames": frames}))
    given = fewview.read(path)
    np.testing.assert_array_equal(given.keypoints, capture.keypoints)
    assert (given.fps, given.times) == (10, None)
    assert given.image_sizes == ((640, 480),)


def test_lightning_pose_parts_the_views_of_one_image(tmp_path: Path) -> None:
    labels = [
        ("heatmap_tracker", f"{name}_{view}", axis)
        for view in ("top", "bot")
        for name in files.NAMES
        for axis in ("x", "y", "likelihood")
    ]
    values = np.concatenate([XYZ.reshape(6, -1), XYZ.reshape(6, -1)], axis=1)
    path = files.dlc_csv(tmp_path / "a.csv", list(labels), values)
    capture = fewview.read(path)
    assert_shows(capture, XYZ, XYZ)
    assert capture.keypoint_names == files.NAMES
    assert capture.view_names == ("top", "bot")


def test_npy_of_freemocap(tmp_path: Path) -> None:
    path = tmp_path / "mediapipe2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy"
    views = np.stack([files.walk(6, 553), files.walk(6, 553, seed=2)])
    np.save(path, views[..., :2])
    np.save(tmp_path / "mediapipe3dData_numFrames_numTrackedPoints_spatialXYZ.npy", views[0])
    capture = fewview.read(tmp_path)
    np.testing.assert_allclose(capture.keypoints, views[..., :2].swapaxes(0, 1), rtol=1e-6)
    assert capture.keypoint_names is not None
    assert capture.keypoint_names[33] == "right_hand_wrist"
    assert capture.confidence is None
    np.save(path, views)
    assert_shows(fewview.read(path), *views)
    np.save(path, np.full((6, 4, 3), 7.0))
    with pytest.raises(FormatError, match="3D points"):
        fewview.read(path)


def test_c3d(tmp_path: Path) -> None:
    content = ezc3d.c3d()
    content["parameters"]["POINT"]["RATE"]["value"] = [50]
    content["parameters"]["POINT"]["LABELS"]["value"] = list(files.NAMES)
    points = np.zeros((4, 4, 6))
    points[:2] = XYZ[..., :2].transpose(2, 1, 0)
    content["data"]["points"] = points
    content.write(str(tmp_path / "a.c3d"))
    capture = fewview.read(tmp_path / "a.c3d")
    np.testing.assert_allclose(capture.keypoints[:, 0], XYZ[..., :2], rtol=1e-5)
    assert capture.keypoint_names == files.NAMES
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.arange(6) / 50)
    points[2] = 3
    content["data"]["points"] = points
    content.write(str(tmp_path / "b.c3d"))
    with pytest.raises(FormatError, match="3D points"):
        fewview.read(tmp_path / "b.c3d")


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_pickles_of_the_authors(tmp_path: Path, protocol: int) -> None:
    truth = np.random.default_rng(0).normal(size=(6, 4, 3))
    for camera in (1, 2):
        frames = [
            {"W_GT": xy, "S_GT": s, "confidence": np.bool_(n != 2)}
            for n, (xy, s) in enumerate(zip(XYZ[..., :2] + camera, truth, strict=True))
        ]
        (tmp_path / f"CAM_{camera}.pkl").write_bytes(pickle.dumps(frames, protocol))
    capture = fewview.read(tmp_path)
    expected = np.stack([XYZ[..., :2] + 1, XYZ[..., :2] + 2], axis=1)
    expected[2] = np.nan
    np.testing.assert_allclose(capture.keypoints, expected, rtol=1e-6)
    assert capture.points3d is not None
    np.testing.assert_allclose(capture.points3d, truth, rtol=1e-6)


class Harm:
    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("harm",))


@pytest.mark.parametrize("held", [Harm(), np.ndarray, np.array([Harm()]), np.zeros(2, "i4,i4")])
def test_other_pickles_are_refused(
    tmp_path: Path, held: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([{"W_GT": held}]))
    with pytest.raises(FormatError, match=r"a\.pkl"):
        fewview.read(tmp_path / "a.pkl")
    assert not capsys.readouterr().out


def test_wide_csv(tmp_path: Path) -> None:
    header = "frame,time," + ",".join(f"{n}_x,{n}_y,{n}_confidence" for n in files.NAMES)
    rows = [[n, n / 10, *frame.ravel()] for n, frame in enumerate(XYZ)]
    text = "\n".join([header, *(",".join(map(str, row)) for row in rows)])
    (tmp_path / "a.csv").write_text(text)
    capture = fewview.read(tmp_path / "a.csv")
    assert_shows(capture, XYZ)
    assert capture.keypoint_names == files.NAMES
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.arange(6) / 10)


def test_csv_of_sleap_has_a_row_for_each_track(tmp_path: Path) -> None:
    header = "track,frame_idx,instance.score," + ",".join(
        f"{n}.x,{n}.y,{n}.score" for n in files.NAMES
    )
    lines = [header]
    for n, frame in enumerate(XYZ):
        lines.append(",".join(["t0", str(n + 3), "0.9", *map(str, frame.ravel())]))
        if n < 2:
            lines.append(",".join(["t1", str(n + 3), "0.9", *map(str, frame.ravel() + 0.001)]))
    (tmp_path / "a.csv").write_text("\n".join(lines))
    assert_shows(fewview.read(tmp_path / "a.csv"), XYZ)


def test_tidy_csv_with_cameras(tmp_path: Path) -> None:
    lines = ["frame;camera;keypoint;x;y;confidence"]
    for n, frame in enumerate(XYZ):
        for camera in ("left", "right"):
            for name, (x, y, c) in zip(files.NAMES, frame, strict=True):
                lines.append(f"{n};{camera};{name};{x};{y};{c}")
    (tmp_path / "a.csv").write_text("\n".join(lines))
    capture = fewview.read(tmp_path / "a.csv")
    assert_shows(capture, XYZ, XYZ)
    assert capture.view_names == ("left", "right")


@pytest.mark.parametrize(
    "text", ["nose_x,nose_y\n1\n", "nose_x,nose_y\n1,b\n", "nose_x,nose_y,nose_z\n1,2,3\n"]
)
def test_broken_csv_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(FormatError, match=r"a\.csv"):
        fewview.read(tmp_path / "a.csv")


@pytest.mark.skipif(not files.RAW.is_dir(), reason=f"no samples in {files.RAW}")
def test_real_samples() -> None:
    mirrors = fewview.read(files.RAW / "lightningpose" / "CollectedData.csv")
    assert mirrors.keypoints.shape == (90, 2, 10, 2)  # of which each view has some alone
    np.testing.assert_allclose(mirrors.keypoints[0, :, 0], [[77.25, 36.25], [83.75, 270.25]])
    for path in ("c3d/Optotrak.c3d", "dlc2kinematics/runway03.c3d"):
        with pytest.raises(FormatError, match="3D points"):
            fewview.read(files.RAW / path)
