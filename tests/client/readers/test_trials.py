"""Files of several trials, detectors and cameras in folders: separated, or asked for."""

from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files


def lay_out(folder: Path, *paths: str) -> None:
    """Write a table at each path; what it shows begins at 100 times its place."""
    labels = files.columns(files.NAMES)
    for place, path in enumerate(paths):
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        files.dlc_csv(file, labels, files.walk(6, start=100.0 * place).reshape(6, -1))


def starts(capture: fewview.Capture) -> list[int]:
    return [round(float(np.nanmin(view)) / 100) for view in capture.keypoints.swapaxes(0, 1)]


def test_files_of_one_name_are_called_as_their_folders(tmp_path: Path) -> None:
    paths = [f"cam{n}/predictions.csv" for n in (1, 2, 10)]
    lay_out(tmp_path, *paths)
    for given in (tmp_path, [tmp_path / path for path in paths]):
        assert fewview.read(given).view_names == ("cam1", "cam2", "cam10")
    lay_out(tmp_path / "deep", *(f"rec/{side}/out/pose.csv" for side in ("left", "right")))
    assert fewview.read(tmp_path / "deep").view_names == ("left", "right")


GRIDS = {
    "folders": ["t1/cam1.csv", "t1/cam2.csv", "t2/cam1.csv", "t2/cam2.csv"],
    "names": ["t1_cam1.csv", "t1_cam2.csv", "t2_cam1.csv", "t2_cam2.csv"],
    "cameras first": ["cam1/t1.csv", "cam2/t1.csv", "cam1/t2.csv", "cam2/t2.csv"],
    "numbers apart": ["t1 cam 1.csv", "t1 cam 2.csv", "t2 cam 1.csv", "t2 cam 2.csv"],
    "not all": ["t1/cam1.csv", "t1/cam2.csv", "t2/cam1.csv", "t2/cam2.csv", "t2/cam3.csv"],
}


@pytest.mark.parametrize("grid", GRIDS)
def test_trials_are_asked_for(tmp_path: Path, grid: str) -> None:
    lay_out(tmp_path, *GRIDS[grid])
    with pytest.raises(FormatError, match=r"2 trials or detectors \(t1, t2\).*give trial='t1'"):
        fewview.read(tmp_path)
    capture = fewview.read(tmp_path, trial="t2")
    assert capture.view_names == ("cam1", "cam2", "cam3")[: len(GRIDS[grid]) - 2]
    assert starts(capture) == list(range(2, len(GRIDS[grid])))
    assert "t2 was taken" in "\n".join(capture.notes)
    with pytest.raises(FormatError, match="no trial 't3'"):
        fewview.read(tmp_path, trial="t3")


def test_two_networks_of_one_video_are_no_cameras(tmp_path: Path) -> None:
    networks = ("DLC_resnet50_walkJan1shuffle1_1000", "DLC_hrnet_w32_walkJan1shuffle1_500")
    lay_out(tmp_path, *(f"cam{v}{network}.csv" for network in networks for v in (1, 2)))
    with pytest.raises(FormatError, match="2 trials or detectors"):
        fewview.read(tmp_path)
    assert starts(fewview.read(tmp_path, trial="hrnet")) == [2, 3]


def test_two_networks_of_one_video_alone(tmp_path: Path) -> None:
    lay_out(tmp_path, "walkDLC_resnet50_a.csv", "walkDLC_hrnet_a.csv")
    with pytest.raises(FormatError, match="2 trials or detectors"):
        fewview.read(tmp_path)
    assert starts(fewview.read(tmp_path, trial="hrnet")) == [1]


def test_versions_are_no_cameras(tmp_path: Path) -> None:
    lay_out(tmp_path, "cam1_v2.csv", "cam2_v2.csv")
    assert fewview.read(tmp_path).view_names == ("cam1", "cam2")


def test_a_format_chooses_among_the_files_of_a_folder(tmp_path: Path) -> None:
    lay_out(tmp_path, "cam1.csv", "cam2.csv")
    for camera in ("cam1", "cam2"):
        (tmp_path / f"{camera}_wide.csv").write_text("nose_x,nose_y,ear_x,ear_y\n10,20,30,40\n")
    with pytest.raises(FormatError, match="several formats"):
        fewview.read(tmp_path)
    assert fewview.read(tmp_path, format="deeplabcut-csv").frames == 6
    assert fewview.read(tmp_path, format="csv").frames == 1


def test_a_grid_that_names_no_cameras_is_ambiguous(tmp_path: Path) -> None:
    lay_out(tmp_path, "anna/x.csv", "anna/y.csv", "berta/x.csv", "berta/y.csv")
    with pytest.raises(FormatError, match="2 x 2: anna, berta and x, y,"):
        fewview.read(tmp_path)
    assert fewview.read(tmp_path / "anna").view_names == ("x", "y")
    with pytest.raises(FormatError, match="of one trial"):
        fewview.read(tmp_path / "anna", trial="x")


def test_results_in_3d_beside_the_cameras_are_left_out(tmp_path: Path) -> None:
    lay_out(tmp_path, "cam1/pose.csv", "cam2/pose.csv")
    rng = np.random.default_rng(0)
    np.save(tmp_path / "truth.npy", rng.normal(size=(6, 4, 3)))
    header = "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\n30\nFrame#\tTime\tnose\n\t\tX1\tY1\tZ1\n"
    (tmp_path / "room.trc").write_text(header + "\n1\t0\t0.1\t0.2\t0.3\n")
    assert fewview.read(tmp_path).view_names == ("cam1", "cam2")
    for name in ("truth.npy", "room.trc"):
        with pytest.raises(FormatError, match="3D points"):
            fewview.read(tmp_path / name)


def test_cameras_are_chosen_by_name(tmp_path: Path) -> None:
    lay_out(tmp_path, "cam1.csv", "cam2.csv", "cam3.csv")
    capture = fewview.read(tmp_path, cameras="cam3,cam1")
    assert capture.view_names == ("cam3", "cam1")
    assert starts(capture) == [2, 0]
    with pytest.raises(FormatError, match="no camera 'cam4'; there are cam1, cam2, cam3"):
        fewview.read(tmp_path, cameras="cam4")
    for option in ({"cameras": "cam1,cam3,cam1"}, {"mirror": ["cam1", "cam1"]}):
        with pytest.raises(FormatError, match="'cam1' is named twice"):
            fewview.read(tmp_path, **option)


def test_sizes_are_given_by_name(tmp_path: Path) -> None:
    labels, body = files.columns(files.NAMES), files.walk(6)
    for v, (width, height) in enumerate([(640, 480), (480, 640)]):
        share = body / (width, height, 1)
        files.dlc_csv(tmp_path / f"cam{v}.csv", labels, share.reshape(6, -1))
    with pytest.raises(FormatError, match="cam0=WIDTHxHEIGHT,cam1=WIDTHxHEIGHT"):
        fewview.read(tmp_path)
    with pytest.raises(FormatError, match="cam1: coordinates are shares"):
        fewview.read(tmp_path, image_size="cam0=640x480")
    for sizes in (
        "640x480,cam1=480x640",
        "cam1=480x640,cam0=640x480",
        [(640, 480), (480, 640)],
        {"cam0": (640, 480), "cam1": (480, 640), "cam2": (1, 1)},
    ):
        capture = fewview.read(tmp_path, image_size=sizes)
        assert capture.image_sizes == ((640, 480), (480, 640))
        for view in range(2):
            np.testing.assert_allclose(capture.keypoints[:, view], body[..., :2], rtol=1e-4)
    with pytest.raises(FormatError, match="no camera 'cam7'"):
        fewview.read(tmp_path, image_size="640x480,cam7=480x640")
    with pytest.raises(FormatError, match="WIDTHxHEIGHT, such as"):
        fewview.read(tmp_path, image_size="cam1=480")
