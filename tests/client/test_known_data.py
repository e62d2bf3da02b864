"""Data sets of the literature, from files written as their own tools write them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview.errors import FormatError
from fewview.known_data import freihand, human36m, openmonkeystudio
from scipy.io import savemat

RNG = np.random.default_rng(3)


class Trap:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        return (open, (str(self.path), "w"))


def save_h36m(folder: Path, keypoints: Any, truth: Any) -> tuple[Path, Path]:
    # As data/prepare_data_h36m.py does; positions of other actions are beside those.
    seen = {"S1": {"Walking 1": keypoints, "Eating": keypoints}, "S5": {}}
    about: Any = {"positions_2d": seen, "metadata": {"num_joints": 17}}
    np.savez_compressed(folder / "data_2d_h36m_gt", **about)
    about = {"positions_3d": {"S1": {"Walking 1": truth}}}
    np.savez_compressed(folder / "data_3d_h36m", **about)
    return folder / "data_2d_h36m_gt.npz", folder / "data_3d_h36m.npz"


def test_human36m(tmp_path: Path) -> None:
    truth = RNG.standard_normal((7, 32, 3)).astype(np.float32)
    views = [RNG.uniform(0, 1000, (7 + v, 17, 2)).astype(np.float32) for v in range(4)]
    files = save_h36m(tmp_path, views, truth)
    found = human36m(*files, subject="S1", action="Walking 1")
    assert found.keypoints.shape == (7, 4, 17, 2)
    for view, expected in enumerate(views):
        np.testing.assert_array_equal(found.keypoints[:, view], expected[:7])
    assert found.points3d is not None
    assert found.keypoint_names is not None
    # Names of VideoPose3D's joints: 0 hip, 3 right foot, 8 left foot, 15 head, 27 right wrist.
    for name, joint in (("pelvis", 0), ("right_ankle", 3), ("left_ankle", 8), ("head", 15)):
        at = found.keypoint_names.index(name)
        np.testing.assert_array_equal(found.points3d[:, at], truth[:, joint])
    np.testing.assert_array_equal(found.points3d[:, -1], truth[:, 27])
    assert found.view_names == ("54138969", "55011271", "58860488", "60457274")
    assert found.times is not None
    assert found.times[5] == pytest.approx(0.1)

    with pytest.raises(FormatError, match="there is no 'Sitting', but Walking 1, Eating"):
        human36m(*files, subject="S1", action="Sitting")
    with pytest.raises(FormatError, match="there is no 'S9', but S1, S5"):
        human36m(*files, subject="S9", action="Eating")
    with pytest.raises(FormatError, match="positions_3d"):
        human36m(files[0], files[0], subject="S1", action="Walking 1")


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    trapped = [Trap(tmp_path / "sprung")]
    files = save_h36m(tmp_path, trapped, np.zeros((1, 32, 3), np.float32))
    with pytest.raises(FormatError, match="only arrays and plain containers"):
        human36m(*files, subject="S1", action="Walking 1")
    assert not (tmp_path / "sprung").exists()


def test_freihand(tmp_path: Path) -> None:
    points = RNG.uniform((-0.1, -0.1, 0.5), (0.1, 0.1, 0.9), (5, 21, 3))
    lenses = np.array([[[480.0 + n, 0, 112], [0, 479, 110], [0, 0, 1]] for n in range(5)])
    for what, array in (("K", lenses), ("xyz", points)):
        (tmp_path / f"training_{what}.json").write_text(json.dumps(array.tolist()))
    found = freihand(tmp_path)
    assert found.keypoints.shape == (5, 1, 21, 2)
    x, y, z = points[3, 8]
    assert found.keypoints[3, 0, 8] == pytest.approx([483 * x / z + 112, 479 * y / z + 110])
    assert found.points3d is not None
    np.testing.assert_allclose(found.points3d, points, rtol=1e-6)
    assert found.keypoint_names is not None
    assert found.keypoint_names[0] == "wrist"

    (tmp_path / "training_xyz.json").write_text(json.dumps(points[:4].tolist()))
    with pytest.raises(FormatError, match="expected matrices"):
        freihand(tmp_path)
    (tmp_path / "training_K.json").write_text('[{"a": 1}]')
    with pytest.raises(FormatError, match="list of lists"):
        freihand(tmp_path)


def save_oms(folder: Path, points: Any, shown: dict[tuple[str, int, int], Any]) -> None:
    """Write what the README of OMS_Data describes: labels (13, 2) of crops by their image."""
    batch = folder / "Batch9a"
    batch.mkdir(parents=True, exist_ok=True)
    rows = [[frame, *point] for frame, pose in points.items() for point in pose]
    savemat(batch / "coords_3D.mat", {"coords": np.array(rows)})
    crops = [[f, c, 100 * c % 700, 7 * f, 381, 382] for name, f, c in shown if name == "9a"]
    savemat(batch / "crop_para.mat", {"crop": np.array(crops, np.float64)})
    names = [f"batch{name}_{frame:09d}_{camera:08d}.jpg" for name, frame, camera in shown]
    labels = [[0, 0, 382, 381, *pose[:, ::-1].ravel()] for pose in shown.values()]
    cells = np.array(names, dtype=object)[:, None]
    savemat(folder / "Data.mat", {"T": {"name": cells, "data": np.array(labels)}})


def test_openmonkeystudio(tmp_path: Path) -> None:
    points = {3120: RNG.standard_normal((13, 3)), 3160: RNG.standard_normal((13, 3))}
    images = [("9a", 3120, 18064162), ("9a", 3160, 18064162), ("9a", 3160, 17158703)]
    others = [("9", 3120, 18064162), ("9a", 3200, 18064162)]  # another batch, no 3D
    shown = {key: RNG.uniform(0, 380, (13, 2)) for key in (*images, *others)}
    save_oms(tmp_path, points, shown)
    found = openmonkeystudio(tmp_path, batch="9a")
    assert found.keypoints.shape == (2, 2, 13, 2)
    assert found.view_names == ("17158703", "18064162")
    assert np.isnan(found.keypoints[0, 0]).all()
    for (_, frame, camera), pose in list(shown.items())[:3]:
        corner = np.array([100 * camera % 700, 7 * frame])
        view = found.view_names.index(str(camera))
        place = list(points).index(frame)
        np.testing.assert_allclose(found.keypoints[place, view], pose + corner, atol=1e-2)
    assert found.points3d is not None
    np.testing.assert_allclose(found.points3d, list(points.values()), atol=1e-6)
    assert found.keypoint_names is not None
    assert (found.keypoint_names[3], found.keypoint_names[12]) == ("right_shoulder", "tail")

    with pytest.raises(FormatError, match=r"Batch7.*no such file"):
        openmonkeystudio(tmp_path, batch="7")
    savemat(tmp_path / "Data.mat", {"T": 3})
    with pytest.raises(FormatError, match="OMS_Data"):
        openmonkeystudio(tmp_path, batch="9a")
