"""Calibrations go through files unharmed, and those of other tools are understood."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fewview.calibration import Camera, read_cameras, write_cameras
from fewview.calibration.camera import from_model, rotation_matrix, rotation_vector
from fewview.errors import FormatError
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Float64 = NDArray[np.float64]
POINTS = np.random.default_rng(5).uniform(-1, 1, (40, 3))


def same(found: list[Camera], cameras: list[Camera]) -> bool:
    """Whether cameras show points at the same pixels, to the rounding of rotations."""
    return len(found) == len(cameras) and all(
        (one.name, one.size, one.fisheye) == (two.name, two.size, two.fisheye)
        and np.allclose(one.project(POINTS), two.project(POINTS), rtol=0, atol=1e-9)
        for one, two in zip(found, cameras, strict=True)
    )


@pytest.mark.parametrize("name", ["a.toml", "a.yml", "a.yaml", "a.json", "folder"])
def test_cameras_go_through_files_unharmed(
    name: str, tmp_path: Path, cameras: list[Camera]
) -> None:
    kind = "colmap" if name == "folder" else None
    path = write_cameras(tmp_path / name, cameras, format=kind)
    assert same(read_cameras(path), cameras)
    many = [replace(cameras[0], name=f"view{place}") for place in range(12)]
    assert same(read_cameras(write_cameras(tmp_path / name, many, format=kind)), many)


def test_a_camera_without_a_pose_has_a_lens(tmp_path: Path, cameras: list[Camera]) -> None:
    lens = replace(cameras[0], rotation=None, translation=None)
    assert read_cameras(write_cameras(tmp_path / "a.yml", [lens])) == [lens]
    (found,) = read_cameras(write_cameras(tmp_path / "folder", [lens], "colmap"))
    assert replace(found, name=lens.name).project(POINTS + 3).tolist() == (
        lens.project(POINTS + 3).tolist()
    )
    with pytest.raises(FormatError, match="pose"):
        write_cameras(tmp_path / "a.toml", [lens])
    with pytest.raises(FormatError, match="image size"):
        write_cameras(tmp_path / "a.toml", [replace(cameras[0], size=None)])


FLAVOURS = {
    "anipose": """
[cam_0]
name = "back"
size = [ 1280, 1024,]
matrix = [ [ 769.9, 0.0, 639.5,], [ 0.0, 769.9, 511.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.2, 0.0, 0.0, 0.0, 0.0,]
rotation = [ -0.5, -1.4, -2.6,]
translation = [ -117.0, -335.7, 87.8,]

[metadata]
adjusted = true
""",
    "pose2sim": """
[back]
name = "back"
size = [ 1280.0, 1024.0]
matrix = [ [ 769.9, 0.0, 639.5], [ 0.0, 769.9, 511.5], [ 0.0, 0.0, 1.0]]
distortions = [ -0.2, 0.0, 0.0, 0.0]
rotation = [ -0.5, -1.4, -2.6]
translation = [ -117.0, -335.7, 87.8]
fisheye = false

[metadata]
adjusted = false
error = 0.0
""",
    "caliscope": """
[cameras.back]
rotation_count = 0
error = 0.453
ignore = false
size = [1280, 1024]
matrix = [[769.9, 0.0, 639.5], [0.0, 769.9, 511.5], [0.0, 0.0, 1.0]]
distortions = [-0.2, 0.0, 0.0, 0.0, 0.0]
translation = [-117.0, -335.7, 87.8]
rotation = [-0.5, -1.4, -2.6]
""",
    "freemocap": """
[cam_0]
name = "back"
size = [1280, 1024]
matrix = [[769.9, 0.0, 639.5], [0.0, 769.9, 511.5], [0.0, 0.0, 1.0]]
distortions = [-0.2, 0.0, 0.0, 0.0, 0.0]
rotation = [-0.5, -1.4, -2.6]
translation = [-117.0, -335.7, 87.8]
world_orientation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
world_position = [0.0, 0.0, 0.0]

[metadata]
groundplane_calibration = true
""",
}


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_flavours_of_toml(flavour: str, tmp_path: Path) -> None:
    file = tmp_path / "calibration.toml"
    file.write_text(FLAVOURS[flavour])
    back = Camera(
        "back",
        np.array([[769.9, 0, 639.5], [0, 769.9, 511.5], [0, 0, 1]]),
        np.array([-0.2]),
        Rotation.from_rotvec([-0.5, -1.4, -2.6]).as_matrix(),
        np.array([-117.0, -335.7, 87.8]),
        (1280, 1024),
    )
    assert same(read_cameras(file), [back])


def test_numbered_sections_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    lens = "matrix = [[9, 0, 6], [0, 9, 5], [0, 0, 1]]\ntranslation = 'null'\nrotation = 'null'\n"
    file.write_text("".join(f"[cam_{n}]\nport = {n}\n{lens}" for n in (1, 10, 2)) + "[charuco]\n")
    assert [camera.name for camera in read_cameras(file)] == ["1", "2", "10"]
    assert read_cameras(file)[0].rotation is None


def test_opencv_files_of_one_camera_and_by_name(tmp_path: Path) -> None:
    one = tmp_path / "left.yml"
    one.write_text(
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 5.3e+02, 0., 3.2e+02, 0., 5.3e+02,\n       2.4e+02, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
        "   data: [ -.1, 0., 0., 0., 0. ]\n"
    )
    (camera,) = read_cameras(one)
    assert (camera.name, camera.size, camera.matrix[1, 2]) == ("left", (640, 480), 240)
    assert camera.distortion[0] == -0.1
    named = tmp_path / "rig.json"
    named.write_text(
        '{"a": {"K": [[5, 0, 3], [0, 5, 2], [0, 0, 1]], "R": [0, 0, 1.5], "T": [[1], [2], [3]]},'
        ' "units": "mm"}'
    )
    (camera,) = read_cameras(named)
    assert camera.translation is not None
    assert camera.vector is not None
    assert (camera.name, camera.translation.tolist()) == ("a", [1, 2, 3])
    np.testing.assert_allclose(camera.vector, [0, 0, 1.5])


@pytest.mark.parametrize("name", ["dist", "dist_coeff", "distCoef", "distCoeffs", "D"])
def test_names_of_distortion(name: str, tmp_path: Path) -> None:
    camera = {"mtx": [[5, 0, 3], [0, 5, 2], [0, 0, 1]], name: [[0.1, 0.2]], "resolution": [6, 4]}
    file = tmp_path / "rig.json"
    file.write_text(json.dumps([camera]))
    (found,) = read_cameras(file)
    assert found.distortion.tolist() == [0.1, 0.2, 0, 0, 0]
    assert found.size == (6, 4)


def test_a_lens_that_is_not_understood_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "head.yaml"
    text = "camera_matrix: [[5, 0, 3], [0, 5, 2], [0, 0, 1]]\n"
    file.write_text(f"{text}distortion_model: equidistant\nD: [0.1, 0, 0, 0]\n")
    assert read_cameras(file)[0].fisheye  # as ROS calls OpenCV's fisheye
    file.write_text(f"{text}distortion_model: plumb_bob\nD: [0.1, 0, 0, 0]\n")
    assert not read_cameras(file)[0].fisheye
    for other in ("distortion_model: double_sphere", "my_distances: [0.1, 0]"):
        file.write_text(f"{text}{other}\n")
        with pytest.raises(FormatError, match=r"not OpenCV's|not understood"):
            read_cameras(file)


def pose_of(file: Path, **parts: object) -> Camera:
    """Return the camera of a file that has a lens and these parts."""
    lens = {"K": [[5, 0, 3], [0, 5, 2], [0, 0, 1]], "dist": [0.1, 0.2]}
    file.write_text(json.dumps(lens | parts))
    (camera,) = read_cameras(file)
    return camera


@pytest.mark.parametrize(
    "names",
    [("extrinsics",), ("RT",), ("w2c",), ("rotation_vector", "translation_vector"), ("rot", "t")],
)
def test_names_of_poses(names: tuple[str, ...], tmp_path: Path, cameras: list[Camera]) -> None:
    camera = cameras[1]
    assert camera.rotation is not None
    assert camera.vector is not None
    assert camera.translation is not None
    pose = np.eye(4)
    pose[:3] = np.c_[camera.rotation, camera.translation]
    vectors = [[camera.vector.tolist(), camera.translation.tolist()]]
    for values in vectors if len(names) == 2 else ([pose.tolist()], [pose[:3].tolist()]):
        found = pose_of(tmp_path / "rig.json", **dict(zip(names, values, strict=True)))
        assert found.rotation is not None
        assert found.translation is not None
        np.testing.assert_allclose(found.rotation, camera.rotation, atol=1e-12)
        np.testing.assert_allclose(found.translation, camera.translation)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("extrinsics", np.eye(4)[:, :3].tolist()),
        ("extrinsics", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]),  # transposed
        ("extrinsics", {"rotation": [0, 0, 1], "translation": [1, 2, 3]}),
        ("c2w", np.eye(4).tolist()),
        ("camera_pose", np.eye(4).tolist()),
        ("rvec_world", [0, 0, 1]),
    ],
)
def test_a_pose_that_is_not_understood_is_refused(name: str, value: object, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=f"'{name}', which is not understood"):
        pose_of(tmp_path / "rig.json", **{name: value})


def test_poses_of_boards_are_not_those_of_a_camera(tmp_path: Path) -> None:
    """OpenCV's sample writes those of the boards that it found the lens with."""
    boards = {"extrinsic_parameters": [[0, 0, 1, 1, 2, 3]] * 4, "rvecs": [[0, 0, 1]] * 4}
    assert pose_of(tmp_path / "lens.json", **boards).rotation is None


def test_vectors_as_later_versions_of_opencv_write_them(tmp_path: Path) -> None:
    vector = "!!opencv-nd-matrix\n   sizes: [ 3 ]\n   dt: d\n   data: [ 1., 2., 3. ]\n"
    file = tmp_path / "rig.yml"
    file.write_text(
        "%YAML:1.0\n---\ncamera_matrix: [[5, 0, 3], [0, 5, 2], [0, 0, 1]]\n"
        f"rvec: {vector}tvec: {vector}"
    )
    (camera,) = read_cameras(file)
    assert camera.translation is not None
    assert camera.translation.tolist() == [1, 2, 3]


def test_colmap_counts_pixels_from_the_corner(tmp_path: Path, cameras: list[Camera]) -> None:
    write_cameras(tmp_path / "rig", cameras, "colmap")
    lines = (tmp_path / "rig/cameras.txt").read_text().splitlines()
    assert lines[1].split()[:8] == [
        "1",
        "OPENCV",
        "1280",
        "720",
        "900.0",
        "905.0",
        "631.75",
        "356.25",
    ]
    assert [line.split()[1] for line in lines[2:]] == ["FULL_OPENCV", "OPENCV_FISHEYE"]
    images = (tmp_path / "rig/images.txt").read_text().splitlines()
    message = images[1].split()
    turn = Rotation.from_quat(np.array(message[1:5], float), scalar_first=True).as_matrix()
    assert cameras[0].rotation is not None
    np.testing.assert_allclose(turn, cameras[0].rotation, atol=1e-12)
    assert images[2] == ""


def test_colmap_of_another_hand(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(
        "# Camera list\n7 SIMPLE_RADIAL 640 480 500 320 240 0.01\n8 RADIAL 64 48 50 32 24 0.1 0.2\n"
    )
    (tmp_path / "images.txt").write_text(
        "# Image list\n3 1 0 0 0 1 2 3 7 frame 1.jpg\n10.5 20.5 -1\n4 2 0 0 0 1 2 4 7 b.jpg\n"
    )
    first, second, third = read_cameras(tmp_path / "cameras.txt")
    assert [first.name, second.name, third.name] == ["frame 1.jpg", "b.jpg", "camera8"]
    assert first.matrix.tolist() == [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]
    assert first.distortion.tolist() == [0.01, 0, 0, 0, 0]
    assert third.distortion.tolist() == [0.1, 0.2, 0, 0, 0]
    assert third.rotation is None
    assert second.rotation is not None
    np.testing.assert_array_equal(second.rotation, np.eye(3))


def test_rotations_and_vectors() -> None:
    rng = np.random.default_rng(8)
    vectors = rng.normal(size=(50, 3))
    vectors *= (rng.uniform(0, np.pi, 50) / np.linalg.norm(vectors, axis=1))[:, None]
    for vector in (*vectors, np.zeros(3), np.array([0, np.pi, 0]), np.array([1e-9, 0, 0])):
        matrix = Rotation.from_rotvec(vector).as_matrix()
        np.testing.assert_allclose(rotation_matrix(vector), matrix, atol=1e-12)
        again = rotation_matrix(rotation_vector(matrix))
        np.testing.assert_allclose(again, matrix, atol=1e-12)


def test_what_a_model_found() -> None:
    view = {
        "index": 0,
        "camera": "fisheye",
        "focal": [500.0, 501.0],
        "principal_point": [320.0, 240.0],
        "distortion": [0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0],
        "rotation": np.eye(3).tolist(),
        "translation": [0.0, 0.0, 0.0],
    }
    moving = view | {"camera": "perspective", "rotation": None, "translation": None}
    first, second = from_model({"views": [view, moving]}, ["a", "b"], [(640, 480), None])
    assert (first.fisheye, first.distortion.tolist()) == (True, [0.1, 0, 0, 0.2])
    assert (second.fisheye, second.rotation, second.size) == (False, None, None)
    with pytest.raises(ValueError, match="weak perspective"):
        from_model({"views": [view | {"focal": None}]})


def test_what_is_no_calibration_is_refused(tmp_path: Path, cameras: list[Camera]) -> None:
    def refused(name: str, text: str, why: str) -> None:
        (tmp_path / name).write_text(text)
        with pytest.raises(FormatError, match=why):
            read_cameras(tmp_path / name)

    refused("a.toml", "x = 1", "no cameras")
    refused("a.toml", "x = ", "a.toml")
    refused("a.toml", "[a]\nmatrix = [1, 2]", "matrix must be")
    refused("a.json", "[1]", "a.json")
    refused("a.yml", "a: [", "a.yml")
    refused("a.yml", "- 1", "map")
    refused("a.xml", "", "no format of 'a.xml'")
    refused("cameras.txt", "1 THIN_PRISM_FISHEYE 1 1 0", "THIN_PRISM")
    for wrong, why in (
        ([], "no cameras"),
        ([cameras[0], cameras[0]], "differ"),
        ([replace(cameras[0], name="a b")], "blanks"),
        ([replace(cameras[0], matrix=np.array([[9, 1, 6], [0, 9, 5], [0, 0, 1.0]]))], "skew"),
    ):
        with pytest.raises(FormatError, match=why):
            write_cameras(tmp_path / "folder", wrong, "colmap")
    with pytest.raises(ValueError, match="4 distortion coefficients"):
        replace(cameras[2], distortion=np.ones(5))
