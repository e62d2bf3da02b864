"""What each format's reader makes of a small file, number by number."""

import contextlib
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from fewview.readers.skeletons import SKELETONS

from . import files

XYZ = files.walk(6)
SHIFT = np.array([7.0, 0, 0])


def flat(values: Any) -> Any:
    return values.reshape(len(values), -1)


def assert_shows(capture: fewview.Capture, *views: Any) -> None:
    """Compare with views (N, P, 3) of x, y, confidence."""
    expected = np.stack(views, axis=1)
    np.testing.assert_allclose(capture.keypoints, expected[..., :2], rtol=1e-6)
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence, expected[..., 2], rtol=1e-6)


def test_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    keypoints = np.stack([XYZ[..., :2], XYZ[..., :2] + 5], axis=1)
    keypoints[0, 0, 0] = np.nan
    truth = np.random.default_rng(0).normal(size=(6, 4, 3))
    others: dict[str, Any] = {
        "edges": [[0, 1]],
        "keypoint_names": files.NAMES,
        "image_sizes": [[640, 480]] * 2,
    }
    np.savez(path, keypoints=keypoints, points3d=truth, fps=50, other=np.ones(3), **others)
    capture = fewview.read(path)
    np.testing.assert_allclose(capture.keypoints, keypoints, rtol=1e-6)
    assert capture.confidence is None
    assert capture.points3d is not None
    np.testing.assert_allclose(capture.points3d, truth, rtol=1e-6)
    assert (capture.fps, capture.times) == (50, None)
    assert capture.keypoint_names == files.NAMES
    assert capture.edges == ((0, 1),)
    assert capture.image_sizes == ((640, 480), (640, 480))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"keypoints": np.zeros((3, 2, 5))}, "keypoints"),
        ({"keypoints": np.zeros((3, 2, 5, 2)), "confidence": np.zeros((3, 2, 4))}, "confidence"),
        ({"keypoints": np.array([{}], object)}, "cannot be read"),
    ],
)
def test_npz_that_does_not_fit_together(tmp_path: Path, wrong: Any, message: str) -> None:
    np.savez(tmp_path / "a.npz", **wrong)
    with pytest.raises(FormatError, match=message):
        fewview.read(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'shape': (",
        "{'descr': (), 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 2, 4, 2), }",
        "{**{}}",
        "'\ud7ff",
    ],
)
def test_npz_with_a_malformed_header(tmp_path: Path, header: str) -> None:
    text = header.encode()
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        size = len(text).to_bytes(2, "little")
        file.writestr("keypoints.npy", b"\x93NUMPY\x01\x00" + size + text + b"1" * 64)
    with pytest.raises(FormatError, match="malformed header"):
        fewview.read(tmp_path / "a.npz")


@pytest.mark.parametrize("write", ["csv", "fixed", "pickled", "table"])
def test_deeplabcut_of_one_animal(tmp_path: Path, write: str) -> None:
    labels = files.columns(files.NAMES)
    paths = []
    for camera, shift in (("cam1", 0.0), ("cam2", 7.0)):
        stem, values = tmp_path / f"{camera}DLC_resnet50", flat(XYZ + np.array([shift, 0, 0]))
        if write == "csv":
            paths.append(files.dlc_csv(stem.with_suffix(".csv"), labels, values))
        elif write == "table":
            paths.append(files.dlc_h5_table(stem.with_suffix(".h5"), labels, values))
        else:
            path = stem.with_suffix(".h5")
            paths.append(files.dlc_h5_fixed(path, labels, values, pickled=write == "pickled"))
    capture = fewview.read(paths)
    assert_shows(capture, XYZ, XYZ + SHIFT)
    assert capture.keypoint_names == files.NAMES
    assert capture.view_names == ("cam1", "cam2")
    assert_shows(fewview.read(tmp_path), XYZ, XYZ + SHIFT)


@pytest.mark.parametrize("write", [files.dlc_csv, files.dlc_h5_fixed, files.dlc_h5_table])
def test_deeplabcut_of_several_animals(tmp_path: Path, write: Any) -> None:
    other = files.walk(6, start=300, seed=2)
    other[2:] = np.nan
    values = np.concatenate([flat(other), flat(XYZ)], axis=1)
    path = write(tmp_path / "a", files.columns(files.NAMES, ["anna", "bert"]), values)
    capture = fewview.read(path)
    assert_shows(capture, XYZ)
    assert "'bert' was taken" in " ".join(capture.notes)
    anna = fewview.read(path, person="anna")
    np.testing.assert_allclose(anna.keypoints[:2, 0], other[:2, :, :2], rtol=1e-6)
    np.testing.assert_array_equal(anna.keypoints, fewview.read(path, person=0).keypoints)
    with pytest.raises(FormatError, match="anna, bert"):
        fewview.read(path, person="carl")


def test_labelled_images_keep_their_numbers(tmp_path: Path) -> None:
    header = "scorer,,,me,me\nbodyparts,,,nose,nose\ncoords,,,x,y\n"
    path = tmp_path / "CollectedData_me.csv"
    path.write_text(header + "labeled-data,v,img03.png,10,20\nlabeled-data,v,img10.png,,\n")
    capture = fewview.read(path, fps=10)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, [0, 0.7])
    assert np.isnan(capture.keypoints[1]).all()
    assert capture.confidence is None


def test_a_table_of_3d_points_is_refused(tmp_path: Path) -> None:
    labels: list[tuple[str, ...]] = [("net", n, c) for n in files.NAMES for c in "xyz"]
    path = files.dlc_csv(tmp_path / "3d.csv", labels, flat(XYZ))
    with pytest.raises(FormatError, match="3D points"):
        fewview.read(path)


def test_openpose(tmp_path: Path) -> None:
    body = files.walk(6, 25)
    body[1, 3] = 0  # how OpenPose writes what it did not see
    for camera in ("cam1", "cam2"):
        files.openpose(tmp_path / f"{camera}_json", [[frame] for frame in body])
    capture = fewview.read(tmp_path)
    body[1, 3, :2] = np.nan
    assert_shows(capture, body, body)
    assert capture.view_names == ("cam1", "cam2")
    assert capture.keypoint_names is None
    assert "body-25 or body-25b" in " ".join(capture.notes)
    named = fewview.read(tmp_path, skeleton="BODY_25B")
    assert named.keypoint_names is not None
    assert named.keypoint_names[17] == "Neck"


@pytest.mark.parametrize("skeleton", ["body-25", "body-25b"])
def test_openpose_of_a_body_whose_hips_have_a_middle(skeleton: str, tmp_path: Path) -> None:
    # A standing body, in the order of one skeleton or the other.
    places = {"Nose": (0, 0), "Neck": (0, 20), "MidHip": (1, 60), "Head": (0, -10)}
    for side, x in (("L", 10), ("R", -10)):
        for y, joint in enumerate(("Eye", "Ear", "Shoulder", "Elbow", "Wrist", "Hip", "Knee")):
            places[f"{side}{joint}"] = (x, 12 * y - 2)
        for joint in ("Ankle", "BigToe", "SmallToe", "Heel"):
            places[f"{side}{joint}"] = (x, 120)
    body = np.array([(*places[name], 0.9) for name in SKELETONS[skeleton].names])
    body[:, :2] += 300
    moved = [body + np.array((n, 2 * n, 0)) for n in range(6)]
    for camera in ("cam1", "cam2"):
        files.openpose(tmp_path / camera, [[frame] for frame in moved])
    names = fewview.read(tmp_path).keypoint_names
    assert names == (SKELETONS[skeleton].names if skeleton == "body-25" else None)


def test_openpose_frames_of_all_cameras_in_one_folder(tmp_path: Path) -> None:
    body = files.walk(6, 25)
    for camera in ("left", "right"):
        folder = files.openpose(tmp_path / camera, [[frame] for frame in body])
        for path in folder.iterdir():
            path.rename(tmp_path / path.name)
        folder.rmdir()
    assert_shows(fewview.read(tmp_path), body, body)


def test_sleap(tmp_path: Path) -> None:
    other = files.walk(6, start=300, seed=2)
    other[:, :, 2] *= 0.5
    both = np.stack([other, XYZ])
    for camera in ("back", "top"):
        files.sleap_analysis(tmp_path / f"{camera}.analysis.h5", both, ["t0", "t1"])
    capture = fewview.read(tmp_path)
    assert_shows(capture, XYZ, XYZ)
    assert capture.keypoint_names == files.NAMES
    assert capture.edges == ((0, 1), (0, 2))
    for camera in ("back", "top"):
        files.slp(tmp_path / f"{camera}.slp", both)
    project = fewview.read(tmp_path)
    np.testing.assert_array_equal(project.keypoints, capture.keypoints)
    assert project.edges == capture.edges
    assert project.keypoint_names == files.NAMES
    assert "back.analysis.h5 was left out for back.slp" in project.notes
    early = files.slp(tmp_path / "early.slp", both, format_id=1.0)
    np.testing.assert_allclose(fewview.read(early).keypoints[:, 0], XYZ[..., :2] - 0.5, rtol=1e-5)


def test_coco(tmp_path: Path) -> None:
    body = files.walk(6, 17)
    body[..., 2] = 2
    body[0, 0] = 0
    images = [
        {"id": v * 6 + n, "file_name": f"cam{v}/{n:04d}.jpg", "width": 640, "height": 480}
        for v in (1, 2)
        for n in range(6)
    ]
    annotations = [
        {"image_id": image["id"], "keypoints": body[i % 6].ravel().tolist()}
        for i, image in enumerate(images)
    ]
    categories = [{"keypoints": [f"k{i}" for i in range(17)], "skeleton": [[1, 2]]}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (tmp_path / "coco.json").write_text(json.dumps(content))
    capture = fewview.read(tmp_path / "coco.json")
    body[0, 0] = np.nan
    for view in (0, 1):
        np.testing.assert_allclose(capture.keypoints[:, view], body[..., :2], rtol=1e-6)
    assert capture.view_names == ("cam1", "cam2")
    assert capture.image_sizes == ((640, 480),) * 2
    assert capture.keypoint_names is not None
    assert capture.keypoint_names[0] == "k0"
    assert capture.edges == ((0, 1),)


def test_coco_results(tmp_path: Path) -> None:
    body = files.walk(6, 17)
    records = [
        {"image_id": n, "keypoints": body[n].ravel().tolist(), "score": 1.0, "category_id": 1}
        for n in range(6)
    ]
    (tmp_path / "results.json").write_text(json.dumps(records))
    capture = fewview.read(tmp_path / "results.json")
    assert_shows(capture, body)
    assert capture.keypoint_names is not None
    assert capture.keypoint_names[5] == "left_shoulder"


@pytest.mark.parametrize("name", ["a.slp", "a.analysis.h5", "a.h5", "a.csv", "a.npz"])
def test_broken_files_say_so(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    labels, values = files.columns(files.NAMES), flat(XYZ)
    if name == "a.slp":
        files.slp(path, XYZ[None])
    elif name == "a.analysis.h5":
        files.sleap_analysis(path, XYZ[None], ["t0"])
    elif name == "a.h5":
        files.dlc_h5_fixed(path, labels, values)
    elif name == "a.csv":
        files.dlc_csv(path, labels, values)
    else:
        np.savez(path, keypoints=XYZ[:, None, :, :2])
    whole = path.read_bytes()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        broken = bytearray(whole[: rng.integers(len(whole) // 2, len(whole))])
        for place in rng.integers(0, len(broken), 8):
            broken[place] = rng.integers(256)
        path.write_bytes(broken)
        with contextlib.suppress(FormatError):  # and nothing else
            fewview.read(path)


class Harm:
    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("harm",))


def test_nothing_but_arrays_is_unpickled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import h5py

    path = files.dlc_h5_table(tmp_path / "a.h5", files.columns(files.NAMES), flat(XYZ))
    with h5py.File(path, "a") as file:
        stored = file["df_with_missing/table"].attrs
        stored["values_block_0_kind"] = np.bytes_(pickle.dumps([Harm()], 0))
    with pytest.raises(FormatError, match="only arrays"):
        fewview.read(path)
    assert not capsys.readouterr().out
