"""NWB and movement's netCDF: as their own packages write them, and in small files made here."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import fewview
import h5py
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files

NAMES = ("tail", "nose", "paw", "ear")  # in no order of the alphabet
SIZE = (1280, 720)
WALKS = np.stack([files.walk(12, 4, seed=seed) for seed in (1, 2)])  # (views, frames, keypoints, 3)
WALKS[..., 0] += 640  # further right than the image is high
MATRIX = np.array([(900, 0, 640), (0, 900, 360), (0, 0, 1)], np.float32)


def as_written(capture: fewview.Capture) -> None:
    assert capture.keypoint_names == NAMES
    np.testing.assert_allclose(capture.keypoints, WALKS[..., :2].swapaxes(0, 1), rtol=1e-5)
    assert capture.confidence is not None
    np.testing.assert_allclose(capture.confidence, WALKS[..., 2].swapaxes(0, 1), rtol=1e-5)


def nwb(path: Path, *, sides: tuple[int, int] = SIZE, soft: str = "/general/devices") -> Path:
    """Write an NWB as pynwb does: series that link to each other's times, and to a device."""
    with h5py.File(path, "w") as file:
        file.attrs["neurodata_type"], file.attrs["namespace"] = "NWBFile", "core"
        file["identifier"], file["session_description"] = "1", "walk"
        file.attrs[".specloc"] = file.create_group("specifications").ref
        for view, walk in enumerate(WALKS):
            camera = file.create_group(f"general/devices/cam{view + 1}")
            camera.attrs["neurodata_type"] = "CalibratedCamera"
            camera["intrinsic_matrix"] = MATRIX
            camera["rotation_matrix"] = np.eye(3, dtype=np.float32)
            camera["translation_vector"] = np.array([view, 0, 0], np.float32)
            pose = file.create_group(f"processing/behavior/3D/Estimate{view}")
            pose.attrs["neurodata_type"] = "PoseEstimation"
            pose["dimensions"] = np.array([sides], np.uint16)
            pose["device"] = h5py.SoftLink(f"{soft}/cam{view + 1}")
            pose["rat"] = h5py.SoftLink("/processing/behavior/Skeletons/rat")
            for place, name in enumerate(NAMES):
                series = pose.create_group(name)
                series.attrs["neurodata_type"] = "PoseEstimationSeries"
                series["data"], series["confidence"] = walk[:, place, :2], walk[:, place, 2]
                if place:
                    series["timestamps"] = h5py.SoftLink(f"{pose.name}/{NAMES[0]}/timestamps")
                else:
                    series["timestamps"] = np.arange(12) / 25
        rat = file.create_group("processing/behavior/Skeletons/rat")
        rat.attrs["neurodata_type"] = "Skeleton"
        rat["nodes"], rat["edges"] = np.array(NAMES, "S"), np.array([[0, 1], [1, 2]], np.uint8)
        file["electrodes"] = np.full(3, rat.ref, h5py.ref_dtype)
    return path


@pytest.mark.parametrize("sides", [SIZE, SIZE[::-1]])
def test_nwb(tmp_path: Path, sides: tuple[int, int]) -> None:
    capture = fewview.read(nwb(tmp_path / "a.nwb", sides=sides), untrusted=True)
    as_written(capture)
    assert capture.view_names == ("cam1", "cam2")
    assert capture.image_sizes == (SIZE, SIZE)
    assert capture.edges == ((0, 1), (1, 2))
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.arange(12) / 25)
    assert capture.calibration is not None
    assert capture.calibration.names == ("cam1", "cam2")
    assert capture.calibration.cameras[1]["intrinsics"]["fx"] == 900


def test_nwb_whose_links_lead_elsewhere(tmp_path: Path) -> None:
    path = nwb(tmp_path / "a.nwb", soft="/nowhere")
    assert fewview.read(path).calibration is None
    with h5py.File(path, "r+") as file:
        del file["processing/behavior/3D/Estimate0/tail"]
        other = h5py.ExternalLink("b.nwb", "/processing/behavior/3D/Estimate0/tail")
        file["general/other"] = other
        file["processing/behavior/3D/Estimate0/tail"] = h5py.SoftLink("/general/other")
    nwb(tmp_path / "b.nwb")
    with pytest.raises(FormatError, match="link"):
        fewview.read(path)


def test_two_subjects_of_one_camera(tmp_path: Path) -> None:
    path = nwb(tmp_path / "a.nwb")
    with h5py.File(path, "r+") as file:
        link = h5py.SoftLink("/general/devices/cam1")
        del file["processing/behavior/3D/Estimate1/device"]
        file["processing/behavior/3D/Estimate1/device"] = link
    capture = fewview.read(path, person="Estimate1")
    np.testing.assert_allclose(capture.keypoints[:, 0], WALKS[1, ..., :2], rtol=1e-5)


def netcdf(
    path: Path, position: Any, confidence: Any, *, views: bool = False, plural: str = ""
) -> Path:
    """Write a file as netCDF 4 lays it out, with scales of its dimensions."""
    coordinates: dict[str, Any] = {"view": np.array(["left", "right"], "S")} if views else {}
    coordinates["time"] = np.arange(12) / 25
    coordinates["space"] = np.array(["x", "y"], "S")
    coordinates[f"keypoint{plural}"] = np.array(NAMES, "S")
    coordinates[f"individual{plural}"] = np.array(["rat"], "S")
    with h5py.File(path, "w") as file:
        file.attrs.update(fps=25.0, time_unit="seconds", ds_type="poses")
        for name, values in coordinates.items():
            file[name] = values
            file[name].make_scale(name)
        axes = list(coordinates)
        for name, values in (("position", position), ("confidence", confidence)):
            file[name] = values
            absent = ("space", f"keypoint{plural}")[: len(axes) - values.ndim]
            for place, axis in enumerate(axis for axis in axes if axis not in absent):
                file[name].dims[place].attach_scale(file[axis])
    return path


@pytest.mark.parametrize("plural", ["", "s"])  # before version 0.17
def test_netcdf_of_movement(tmp_path: Path, plural: str) -> None:
    position = np.swapaxes(WALKS[..., :2], 2, 3)[..., None]
    confidence = WALKS[..., 2][..., None]
    for view in range(2):
        path = tmp_path / f"cam{view + 1}.nc"
        netcdf(path, position[view], confidence[view], plural=plural)
    apart = fewview.read(tmp_path, untrusted=True)
    as_written(apart)
    assert apart.view_names == ("cam1", "cam2")
    assert apart.fps == 25
    together = fewview.read(
        netcdf(tmp_path / "views.nc", position, confidence, views=True, plural=plural)
    )
    as_written(together)
    assert together.view_names == ("left", "right")


def test_movement_may_be_sure_of_individuals_alone(tmp_path: Path) -> None:
    walk, sure = WALKS[0], np.linspace(0.2, 0.9, 12)
    path = tmp_path / "cam1.nc"
    netcdf(path, np.swapaxes(walk[..., :2], 1, 2)[..., None], sure[:, None])
    confidence = fewview.read(path).confidence
    assert confidence is not None
    np.testing.assert_allclose(confidence[:, 0], np.repeat(sure[:, None], 4, 1), rtol=1e-6)


def test_nwb_that_pynwb_wrote(tmp_path: Path) -> None:
    pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed")
    ndx_pose = pytest.importorskip("ndx_pose", reason="ndx-pose is not installed")
    session = pynwb.NWBFile("walk", "1", datetime(2025, 1, 1, tzinfo=UTC))
    behaviour = session.create_processing_module("behavior", "poses")
    edges = np.array([[0, 1], [1, 2]], "uint8")
    skeleton = ndx_pose.Skeleton(name="rat", nodes=list(NAMES), edges=edges)
    behaviour.add(ndx_pose.Skeletons(skeletons=[skeleton]))
    estimates = []
    for view, walk in enumerate(WALKS):
        camera = ndx_pose.CalibratedCamera(
            name=f"cam{view + 1}",
            intrinsic_matrix=MATRIX,
            rotation_matrix=np.eye(3, dtype=np.float32),
            translation_vector=np.array([view, 0, 0], np.float32),
            distortion_coefficients=np.zeros(5, np.float32),
        )
        session.add_device(camera)
        series = [
            ndx_pose.PoseEstimationSeries(
                name=name,
                data=walk[:, place, :2],
                confidence=walk[:, place, 2],
                unit="pixels",
                reference_frame="top left",
                rate=25.0,
            )
            for place, name in enumerate(NAMES)
        ]
        estimates.append(
            ndx_pose.PoseEstimation(
                name=f"view{view}", pose_estimation_series=series, skeleton=skeleton, device=camera
            )
        )
    behaviour.add(
        ndx_pose.MultiCameraPoseEstimation(
            pose_estimation_series=[], pose_estimations=estimates, skeleton=skeleton
        )
    )
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "w") as file:
        file.write(session)
    capture = fewview.read(tmp_path / "a.nwb")
    as_written(capture)
    assert capture.fps == 25
    assert capture.view_names == ("cam1", "cam2")
    assert capture.calibration is not None


def test_estimates_in_3d_are_left_out(tmp_path: Path) -> None:
    path = nwb(tmp_path / "a.nwb")
    with h5py.File(path, "r+") as file:
        room = file.create_group("processing/behavior/3D/Room")
        room.attrs["neurodata_type"] = "PoseEstimation"
        series = room.create_group("nose")
        series.attrs["neurodata_type"] = "PoseEstimationSeries"
        series["data"] = np.zeros((12, 3))
    capture = fewview.read(path)
    as_written(capture)
    assert any("Room left out" in note for note in capture.notes)
    with h5py.File(path, "r+") as file:
        del file["processing/behavior/3D/Estimate0"], file["processing/behavior/3D/Estimate1"]
    with pytest.raises(FormatError, match="give the 2D keypoints"):
        fewview.read(path)


def poses(view: int, *, plural: str = "") -> Any:
    """Return a camera's dataset of poses, with the variables and attributes that movement gives."""
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    keypoint, individual = f"keypoint{plural}", f"individual{plural}"
    position = np.swapaxes(WALKS[view, ..., :2], 1, 2)[..., None]
    return xarray.Dataset(
        {
            "position": (("time", "space", keypoint, individual), position),
            "confidence": (("time", keypoint, individual), WALKS[view, ..., 2:]),
        },
        {"time": np.arange(12) / 25, "space": ["x", "y"], keypoint: list(NAMES), individual: ["r"]},
        {"fps": 25.0, "time_unit": "seconds", "ds_type": "poses", "source_software": "DeepLabCut"},
    )


def test_netcdf_that_xarray_wrote(tmp_path: Path) -> None:
    both = [poses(view) for view in range(2)]
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    packed = {"position": {"dtype": "int32", "scale_factor": 1e-5, "_FillValue": -1}}
    packed["confidence"] = {
        "add_offset": 0.5,
        "dtype": "int32",
        "scale_factor": 1e-6,
        "_FillValue": -1,
    }
    for view, each in enumerate(both):
        folder = tmp_path / "files"
        folder.mkdir(exist_ok=True)
        path = folder / f"cam{view + 1}.nc"
        each.isel(individual=0).to_netcdf(path, engine="h5netcdf", encoding=packed)
    as_written(fewview.read(tmp_path / "files"))
    cameras = xarray.DataArray(["left", "right"], dims="rig", name="rig")
    together = xarray.concat(both, cameras).transpose("keypoint", "time", "rig", "space", ...)
    together.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding={"position": {"zlib": True}})
    with h5py.File(tmp_path / "a.nc", "r+") as file:
        del file["position"].attrs["DIMENSION_LIST"]  # references, which nobody follows
    capture = fewview.read(tmp_path / "a.nc")
    as_written(capture)
    assert capture.view_names == ("left", "right")


def test_gaps_of_packed_netcdf(tmp_path: Path) -> None:
    some = poses(0, plural="s")
    some["position"][3, :, 1] = np.nan
    packed = {"position": {"dtype": "int16", "scale_factor": 0.05, "_FillValue": -32768}}
    some.to_netcdf(tmp_path / "cam1.nc", engine="h5netcdf", encoding=packed)
    capture = fewview.read(tmp_path / "cam1.nc")
    expected = WALKS[0, ..., :2].copy()
    expected[3, 1] = np.nan
    np.testing.assert_allclose(capture.keypoints[:, 0], expected, atol=0.026)


def test_what_to_do_with_netcdf_3(tmp_path: Path) -> None:
    pytest.importorskip("scipy", reason="scipy is not installed")
    poses(0).to_netcdf(tmp_path / "cam1.nc", engine="scipy")
    with pytest.raises(FormatError, match="write netCDF 4"):
        fewview.read(tmp_path / "cam1.nc")


def test_netcdf_that_movement_wrote(tmp_path: Path) -> None:
    load_poses = pytest.importorskip("movement.io.load_poses", reason="movement is not installed")
    for view, walk in enumerate(WALKS):
        load_poses.from_numpy(
            position_array=np.swapaxes(walk[..., :2], 1, 2)[..., None],
            confidence_array=walk[..., 2][..., None],
            keypoint_names=list(NAMES),
            fps=25,
            source_software="DeepLabCut",
        ).to_netcdf(tmp_path / f"cam{view + 1}.nc", engine="h5netcdf")
    as_written(fewview.read(tmp_path))
