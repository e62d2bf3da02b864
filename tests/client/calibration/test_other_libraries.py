"""What others make of the files that are written here: OpenCV and aniposelib.

They are only asked where they are installed: aniposelib brings a second OpenCV with it. Without
them, projections are held against formulae in the words of COLMAP's documentation.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview.calibration import Camera, write_cameras
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
POINTS = np.random.default_rng(6).uniform(-1, 1, (30, 3))
LARGE = "OpenCV is large, and only needed here"


@pytest.mark.parametrize("ending", ["yml", "json"])
def test_opencv_reads_the_file_and_sees_the_same(
    ending: str, tmp_path: Path, cameras: list[Camera]
) -> None:
    cv2: Any = pytest.importorskip("cv2", reason=LARGE)
    path = write_cameras(tmp_path / f"rig.{ending}", cameras)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    listed = storage.getNode("cameras")
    assert listed.size() == 3
    for place, camera in enumerate(cameras):
        node = listed.at(place)
        assert node.getNode("name").string() == camera.name
        assert int(node.getNode("image_width").real()) == 1280
        parts = ("camera_matrix", "distortion_coefficients", "rotation", "translation")
        matrix, distortion, rotation, translation = (node.getNode(part).mat() for part in parts)
        vector = cv2.Rodrigues(rotation)[0]
        lens = cv2.fisheye if node.getNode("fisheye").real() else cv2
        points = POINTS.reshape(-1, 1, 3)
        pixels = lens.projectPoints(points, vector, translation, matrix, distortion)[0]
        np.testing.assert_allclose(pixels.reshape(-1, 2), camera.project(POINTS), atol=1e-8)


def test_aniposelib_triangulates_the_same_points(tmp_path: Path, cameras: list[Camera]) -> None:
    reason = "aniposelib is not installed: it needs a second OpenCV"
    library: Any = pytest.importorskip("aniposelib.cameras", reason=reason)
    group = library.CameraGroup.load(str(write_cameras(tmp_path / "rig.toml", cameras)))
    assert group.get_names() == [camera.name for camera in cameras]
    np.testing.assert_allclose(
        group.project(POINTS).reshape(3, -1, 2),
        [camera.project(POINTS) for camera in cameras],
        atol=1e-8,
    )
    pixels = np.stack([camera.project(POINTS) for camera in cameras])
    found = group.triangulate(pixels, progress=False)
    np.testing.assert_allclose(found, POINTS, atol=2e-3)  # it undistorts in a few iterations


def test_files_of_aniposelib_are_read(tmp_path: Path, cameras: list[Camera]) -> None:
    reason = "aniposelib is not installed: it needs a second OpenCV"
    library: Any = pytest.importorskip("aniposelib.cameras", reason=reason)
    from fewview.calibration import read_cameras

    written = write_cameras(tmp_path / "rig.toml", cameras)
    library.CameraGroup.load(str(written)).dump(str(tmp_path / "again.toml"))
    for one, two in zip(read_cameras(tmp_path / "again.toml"), cameras, strict=True):
        assert (one.name, one.size, one.fisheye) == (two.name, two.size, two.fisheye)
        np.testing.assert_allclose(one.project(POINTS), two.project(POINTS), atol=1e-8)


def test_projections_follow_the_formulae_of_colmap(tmp_path: Path, cameras: list[Camera]) -> None:
    """A pixel of COLMAP is half a pixel further right and down than OpenCV's."""
    write_cameras(tmp_path / "rig", cameras, "colmap")
    lenses = (tmp_path / "rig/cameras.txt").read_text().splitlines()[1:]
    images = (tmp_path / "rig/images.txt").read_text().splitlines()[1::2]
    for camera, lens, image in zip(cameras, lenses, images, strict=True):
        model = lens.split()[1]
        fx, fy, cx, cy, *k = (float(value) for value in lens.split()[4:])
        w, *axis = (float(value) for value in image.split()[1:5])
        shift = np.array([float(value) for value in image.split()[5:8]])
        twice = 2 * np.cross(axis, POINTS)  # a quaternion turns a vector so
        u, v, depth = (POINTS + w * twice + np.cross(axis, twice) + shift).T
        u, v = u / depth, v / depth
        r = np.hypot(u, v)
        if model == "OPENCV_FISHEYE":
            t = np.arctan(r)
            grown = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) / r
            x, y = u * grown, v * grown
        else:
            k += [0.0] * (8 - len(k))
            grown = (1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6) / (
                1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6
            )
            x = u * grown + 2 * k[2] * u * v + k[3] * (r**2 + 2 * u**2)
            y = v * grown + 2 * k[3] * u * v + k[2] * (r**2 + 2 * v**2)
        pixels = np.stack((fx * x + cx, fy * y + cy), -1)
        np.testing.assert_allclose(pixels - 0.5, camera.project(POINTS), atol=1e-9)
