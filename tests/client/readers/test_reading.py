"""What all formats share: people, gaps, matching of cameras, refusals, the real samples."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from fewview.readers.skeletons import SKELETONS

from . import files

XYZ = files.walk(6)


def notes_of(capture: fewview.Capture) -> str:
    return "\n".join(capture.notes)


def csv(path: Path, names: Any = files.NAMES, values: Any = XYZ) -> Path:
    return files.dlc_csv(path, files.columns(names), values.reshape(len(values), 3 * len(names)))


def test_somebody_is_followed_through_lists_in_any_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    one, other = files.walk(20, 25), files.walk(20, 25, start=400, seed=2)
    other[..., 2] = 0.3
    frames: list[Any] = []
    for a, b in zip(one, other, strict=True):
        people = [a, b] if rng.random() < 0.5 else [b, a]
        frames.append(people)
    frames[7] = [other[7]]
    capture = fewview.read(files.openpose(tmp_path / "cam", frames))
    expected = one[..., :2].copy()
    expected[7] = np.nan
    np.testing.assert_allclose(capture.keypoints[:, 0], expected, rtol=1e-6)
    assert "through 19 of the 20 frames" in notes_of(capture)


def test_places_are_people_where_empty_entries_hold_them(tmp_path: Path) -> None:
    one, other = files.walk(6, 25), files.walk(6, 25, start=300, seed=2)
    first: list[Any] = [[a, b] for a, b in zip(one, other, strict=True)]
    second: list[Any] = [[a, b] for a, b in zip(one, other, strict=True)]
    first[0] = [None, other[0]]
    files.openpose(tmp_path / "cam1", first)
    files.openpose(tmp_path / "cam2", second)
    capture = fewview.read(tmp_path, person=1)
    for view in (0, 1):
        np.testing.assert_allclose(capture.keypoints[:, view], other[..., :2], rtol=1e-6)
    assert np.isnan(fewview.read(tmp_path, person=0).keypoints[0, 0]).all()
    with pytest.raises(FormatError, match="no person 5"):
        fewview.read(tmp_path, person=5)


def test_weak_detections_are_gaps_and_confidences_are_clipped(tmp_path: Path) -> None:
    values = XYZ.copy()
    values[0, 0, 2], values[1, 1, 2], values[2, 2, 2] = 1.05, 0.2, np.nan
    capture = fewview.read(csv(tmp_path / "a.csv", values=values), min_confidence=0.3)
    assert capture.confidence is not None
    assert capture.confidence[0, 0, 0] == 1
    assert "1.050 were clipped" in notes_of(capture)
    assert np.isnan(capture.keypoints[1, 0, 1]).all()
    assert capture.confidence[1, 0, 1] == 0
    assert "1 detections below 0.3" in notes_of(capture)
    assert capture.confidence[2, 0, 2] == 1
    values[0, 0, 2] = 50
    capture = fewview.read(csv(tmp_path / "a.csv", values=values))
    assert "divided" in notes_of(capture)
    assert capture.confidence is not None
    assert capture.confidence.max() == 1


def test_all_keypoints_of_all_cameras_are_matched_by_name(tmp_path: Path) -> None:
    turned = XYZ[:, [2, 1, 0, 3]]
    first = csv(tmp_path / "a.csv")
    second = csv(tmp_path / "b.csv", ("Paw", "tail", "nose", "whisker"), turned)
    capture = fewview.read([first, second])
    assert capture.keypoint_names == (*files.NAMES, "whisker")
    np.testing.assert_array_equal(capture.keypoints[:, 0, :3], capture.keypoints[:, 1, :3])
    np.testing.assert_allclose(capture.keypoints[:, 0, 3], XYZ[:, 3, :2], rtol=1e-6)
    np.testing.assert_allclose(capture.keypoints[:, 1, 4], XYZ[:, 3, :2], rtol=1e-6)
    assert not capture.observed()[:, [0, 1], [4, 3]].any()
    assert "a alone has ear" in notes_of(capture)
    assert "b alone has whisker" in notes_of(capture)
    with pytest.raises(FormatError, match="same name"):
        fewview.read([first, csv(tmp_path / "c.csv", "qrst")])


def test_shorter_files_are_padded(tmp_path: Path) -> None:
    capture = fewview.read([csv(tmp_path / "a.csv"), csv(tmp_path / "b.csv", values=XYZ[:4])])
    assert capture.keypoints.shape == (6, 2, 4, 2)
    assert np.isnan(capture.keypoints[4:, 1]).all()
    assert "b: has 4 of the 6 frames" in notes_of(capture)


def test_frame_numbers_count_unless_they_do_not_overlap(tmp_path: Path) -> None:
    body = files.walk(6, 25)
    frames = [[frame] for frame in body]
    first = files.openpose(tmp_path / "a", frames)
    later = files.openpose(tmp_path / "b", frames, 2)
    capture = fewview.read([first, later])
    assert capture.frames == 8
    assert np.isnan(capture.keypoints[:2, 1]).all()
    far = files.openpose(tmp_path / "c", frames, 1000)
    capture = fewview.read([first, far])
    assert capture.frames == 6
    assert "hardly overlap" in notes_of(capture)


def test_frames_are_aligned_by_time(tmp_path: Path) -> None:
    slow, fast = tmp_path / "slow.npz", tmp_path / "fast.npz"
    x = np.arange(10.0)
    keypoints = np.broadcast_to(x[:, None, None, None] + 1, (10, 1, 4, 2))
    np.savez(fast, keypoints=keypoints, times=x / 100)
    np.savez(slow, keypoints=keypoints[::2], times=x[::2] / 100 + 0.001)
    capture = fewview.read([fast, slow], align="time")
    np.testing.assert_array_equal(capture.keypoints[::2, 0], capture.keypoints[::2, 1])
    assert np.isnan(capture.keypoints[1::2, 1]).all()
    with pytest.raises(FormatError, match="fps"):
        fewview.read([csv(tmp_path / "a.csv"), fast], align="time", skeleton=None)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "empty"),
        (b"\x00\x00\x00\x18ftypmp42", "video"),
        (b"PathFileType\t4\t(X/Y/Z)\n", "TRC"),
        (b'[{"bbox": [1, 2, 3, 4]}]', "boxes"),
        (b'{"a": 1}', "JSON with a"),
        (b'{"a": 1', "broken JSON"),
        (b"hello\n", "text that begins"),
        (b"[cam_0]\nname = 'left'\n", "a TOML file"),
        (b"\x80\x04N.", "pickle"),
        (b"PK\x03\x04", "zip"),
    ],
)
def test_what_is_no_known_format_is_refused(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=expected):
        fewview.read(path)
    with pytest.raises(FormatError, match="no file of a known format"):
        fewview.read(tmp_path)


def test_a_table_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="without a single frame"):
        fewview.read(csv(tmp_path / "a.csv", values=XYZ[:0]))


def test_what_is_asked_wrongly_is_refused(tmp_path: Path) -> None:
    path = csv(tmp_path / "a.csv")
    with pytest.raises(FormatError, match="no such file"):
        fewview.read(tmp_path / "b.csv")
    with pytest.raises(FormatError, match="no format"):
        fewview.read(path, format="dlc")
    with pytest.raises(FormatError, match="min_confidence"):
        fewview.read(path, min_confidence=2)
    with pytest.raises(FormatError, match="no skeleton"):
        fewview.read(path, skeleton="cat")
    with pytest.raises(FormatError, match="17 keypoints, not 4"):
        fewview.read(path, skeleton="coco-17")


def test_large_files_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fewview.readers.sources.MAX_JSON", 100)
    (tmp_path / "a.json").write_text(json.dumps({"annotations": [0] * 1000}))
    with pytest.raises(FormatError, match="MiB"):
        fewview.read(tmp_path / "a.json")


def test_skeletons_have_names_in_any_spelling(tmp_path: Path) -> None:
    folder = files.openpose(tmp_path / "cam", [[body] for body in files.walk(4, 25)])
    for name in ("body-25b", "BODY_25B", "body25b"):
        assert "Head" in (fewview.read(folder, skeleton=name).keypoint_names or ())
    assert "may be body-25 or body-25b" in notes_of(fewview.read(folder))


def test_skeletons() -> None:
    counts = {"coco-17": 17, "body-25": 25, "body-25b": 25, "coco-133": 133, "h36m-17": 17,
              "halpe-26": 26, "mediapipe-33": 33, "hands-21": 21}  # fmt: skip
    assert {name: len(known.names) for name, known in SKELETONS.items()} == counts
    for known in SKELETONS.values():
        assert len(set(known.names)) == len(known.names)
        assert len(set(known.edges)) == len(known.edges)
        joined = {k for edge in known.edges for k in edge}
        assert joined == set(range(len(known.names))), known.title


def test_importing_the_client_stays_light() -> None:
    code = "import sys, fewview; print({'h5py', 'ezc3d', 'fewview.readers'} & sys.modules.keys())"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout == "set()\n"


def test_convert(tmp_path: Path) -> None:
    from fewview.cli import app
    from typer.testing import CliRunner

    csv(tmp_path / "a.csv")
    csv(tmp_path / "b.csv", values=XYZ[:3])
    out = tmp_path / "out.npz"
    command = ["convert", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "-o", str(out)]
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == 0
    assert "50.0% gaps" in shown.stdout
    assert f"wrote {out}" in shown.stdout
    assert fewview.read(out).keypoints.shape == (6, 2, 4, 2)
    answer = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert [camera["gaps"] for camera in answer["cameras"]] == [0, 0.5]
    assert answer["keypoint_names"] == list(files.NAMES)
    for wrong in ([*command[:-1], str(tmp_path / "x.csv")], ["convert", "nowhere.csv"]):
        refused = CliRunner().invoke(app, wrong)
        assert refused.exit_code == 2
        assert len(refused.stderr.splitlines()) == 1


needs_samples = pytest.mark.skipif(not files.RAW.is_dir(), reason=f"no samples in {files.RAW}")


@needs_samples
def test_real_openpose_follows_whom_pose2sim_associated() -> None:
    capture = fewview.read(files.RAW / "pose2sim_openpose" / "pose", skeleton="body-25b")
    with np.load(files.REAL / "pose2sim_balancing.npz") as known:
        np.testing.assert_allclose(capture.keypoints, known["keypoints"][:30], atol=1e-3)


@needs_samples
def test_real_sleap_says_the_same_in_both_formats() -> None:
    folder = files.RAW / "sleap"
    views = ("back", "mid", "side", "top")
    projects = fewview.read([folder / f"minimal_{v}_proofread.slp" for v in views])
    analyses = fewview.read([folder / f"minimal_{v}_proofread.analysis.h5" for v in views])
    np.testing.assert_array_equal(projects.keypoints, analyses.keypoints)
    assert projects.keypoints.shape == (120, 4, 15, 2)
    assert projects.view_names == views
    assert sorted(projects.edges or ()) == sorted(analyses.edges or ())


@needs_samples
def test_real_deeplabcut() -> None:
    capture = fewview.read(files.RAW / "dlc2kinematics" / "reachingDEMO_2D.h5")
    assert capture.keypoints.shape == (800, 1, 33, 2)
    np.testing.assert_allclose(capture.keypoints[0, 0, 0], [397.562252, 114.544481], rtol=1e-6)
    rig = fewview.read(files.RAW / "anipose_let_it_be_3D")  # cameras have columns in unlike order
    assert rig.keypoints.shape == (1, 6, 15, 2)
    with pytest.raises(FormatError, match="3D points"):
        fewview.read(files.RAW / "dlc2kinematics" / "reachingDEMO_3D.h5")


@needs_samples
@pytest.mark.parametrize(("name", "points"), [("test_coco", 17), ("test_coco_wholebody", 133)])
def test_real_coco(name: str, points: int) -> None:
    capture = fewview.read(files.RAW / "coco_mmpose" / f"{name}.json")
    assert capture.keypoints.shape == (4, 1, points, 2)
    assert capture.keypoint_names is not None
    assert capture.keypoint_names[0] == "nose"
