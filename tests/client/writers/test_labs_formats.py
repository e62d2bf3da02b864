"""Formats of laboratories: opened by their own libraries where these are installed."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from fewview import Animation, write
from fewview.calibration import Camera
from fewview.readers.hdf5 import opened
from fewview.readers.pandas_h5 import read_table
from fewview.readers.sources import Source
from numpy.typing import NDArray

MATRIX = np.array([(900.0, 0, 640), (0, 900, 360), (0, 0, 1)])


def sure_as_deviations_are(confidence: NDArray[np.float64], animation: Animation) -> None:
    """Confidences (N, P) fall with deviations, are 0 of missing points, 1 of unknown ones."""
    assert (confidence[~animation.seen] == 0).all()
    assert animation.points_sd is not None
    known = np.isfinite(animation.points_sd)
    assert (confidence[animation.seen & ~known] == 1).all()
    order = np.argsort(animation.points_sd[known])
    assert (np.diff(confidence[known][order]) < 0).all()
    assert 0 < confidence[known].min() < confidence[known].max() < 1


def test_netcdf_of_movement(tmp_path: Path, doubted: Animation) -> None:
    path = write(tmp_path / "a.nc", doubted)
    with opened(path) as file:
        np.testing.assert_array_equal(file["position"][..., 0].swapaxes(1, 2), doubted.points)
        sure_as_deviations_are(file["confidence"][..., 0], doubted)
        np.testing.assert_array_equal(file["sd"][..., 0], doubted.points_sd)
        axes = [dimension[0].name for dimension in file["position"].dims]
        assert axes == ["/time", "/space", "/keypoint", "/individual"]
        np.testing.assert_allclose(file["time"][()], np.arange(12) / 25)


def test_netcdf_that_movement_opens(tmp_path: Path, doubted: Animation) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    with xarray.open_dataset(write(tmp_path / "a.nc", doubted), engine="h5netcdf") as poses:
        assert dict(poses.sizes) == {"time": 12, "space": 3, "keypoint": 5, "individual": 1}
        assert poses.attrs["fps"] == 25
        assert poses.attrs["ds_type"] == "poses"
        assert poses.attrs["time_unit"] == "seconds"
        nose = poses.position.sel(keypoint="nose", individual="subject")
        np.testing.assert_array_equal(nose.to_numpy(), doubted.points[:, 0])
        reason = "movement takes half a gigabyte"
        validators = pytest.importorskip("movement.validators.datasets", reason=reason)
        if (
            "keypoint" in validators.ValidPosesInputs.DIM_NAMES
        ):  # since version 0.17, of Python 3.12
            validators.ValidPosesInputs.validate(poses)
        else:
            plural = {"keypoint": "keypoints", "individual": "individuals"}
            validators.ValidPosesInputs.validate(poses.rename(plural))


def test_table_of_deeplabcut(tmp_path: Path, animation: Animation) -> None:
    path = write(tmp_path / "a.dlc3d.h5", animation)
    columns, levels, values, *_ = read_table(Source(path))
    assert list(levels) == ["scorer", "bodyparts", "coords"]
    assert list(columns[:3]) == [("Fewview", "nose", axis) for axis in "xyz"]
    np.testing.assert_array_equal(values, animation.points.reshape(12, -1))
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    pytest.importorskip("tables", reason="PyTables is not installed")
    read = pandas.read_hdf(path)
    np.testing.assert_array_equal(read["Fewview"]["knee é"].to_numpy(), animation.points[:, 2])


def test_analysis_of_sleap(tmp_path: Path, doubted: Animation) -> None:
    path = write(tmp_path / "a.analysis.h5", doubted)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["tracks"][0].transpose(2, 1, 0), doubted.points)
        assert [name.decode() for name in file["node_names"]] == list(doubted.names)
        assert file["track_occupancy"].shape == (12, 1)
        sure_as_deviations_are(np.nan_to_num(file["point_scores"][0].T), doubted)
    sleap_io = pytest.importorskip("sleap_io", reason="sleap-io is not installed")
    labels = sleap_io.load_analysis_h5(str(path))
    points = labels.numpy()[:, 0]  # (frames, nodes, 2): it knows two axes
    np.testing.assert_allclose(points, doubted.points[..., :2])


def test_nwb_that_pynwb_opens(tmp_path: Path, doubted: Animation) -> None:
    pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed")
    pytest.importorskip("ndx_pose", reason="ndx-pose is not installed")
    posed = Camera("cam/1", MATRIX, np.zeros(5), np.eye(3), np.array([1.0, 2, 3]), (1280, 720))
    moving = Camera("cam2", MATRIX)
    path = write(tmp_path / "a.nwb", replace(doubted, cameras=(posed, moving)))
    assert pynwb.validate(path=str(path)) == []
    with pynwb.NWBHDF5IO(str(path), "r") as file:
        session = file.read()
        behaviour = session.processing["behavior"]
        pose = behaviour["MultiCameraPoseEstimation"]
        knee = pose.pose_estimation_series["knee é"]
        np.testing.assert_array_equal(knee.data[:], doubted.points[:, 2])
        np.testing.assert_allclose(knee.timestamps[:], np.arange(12) / 25)
        assert knee.unit == "meters"
        assert list(pose.skeleton.nodes[:]) == list(doubted.names)
        np.testing.assert_array_equal(pose.skeleton.edges[:], doubted.edges)
        np.testing.assert_array_equal(behaviour["points_sd"].data[:], doubted.points_sd)
        np.testing.assert_array_equal(
            session.devices["cam_1"].translation_vector[:], posed.translation
        )
        assert session.devices["cam2"].rotation_matrix is None
        assert len(pose.pose_estimations) == 2


def test_bvh_of_apple_vision(tmp_path: Path, animation: Animation) -> None:
    identifiers = (
        *("left_shoulder_1_joint", "right_shoulder_1_joint", "left_upLeg_joint"),
        *("right_upLeg_joint", "left_leg_joint"),
    )
    points = np.random.default_rng(4).normal(size=(12, 5, 3))
    body = replace(animation, points=points, keypoint_names=identifiers, edges=())
    text = write(tmp_path / "a.bvh", body).read_text()
    assert text.count("JOINT") == 6  # of the five and the neck; the hips are the root
    assert text.index("left_upLeg_joint") < text.index("left_leg_joint")
