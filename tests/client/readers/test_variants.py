"""Layouts of one format that differ by its version, and what would be misread without a word."""

import json
from pathlib import Path
from typing import Any

import fewview
import h5py
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files

XYZ = files.walk(6)
TWO = np.stack([XYZ, files.walk(6, start=300, seed=2)])
AXES = ("frame", "track", "node", "xy")


def assert_shows(capture: fewview.Capture, *views: Any, atol: float = 1e-4) -> None:
    """Compare with views (N, P, 3) of x, y, confidence."""
    expected = np.stack(views, axis=1)
    np.testing.assert_allclose(capture.keypoints, expected[..., :2], atol=atol)
    if capture.confidence is not None:
        np.testing.assert_allclose(capture.confidence, expected[..., 2], atol=1e-6)


def said(capture: fewview.Capture) -> str:
    return "\n".join(capture.notes)


def csv(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def wide(frame: Any, between: str = ",") -> str:
    return between.join(map(str, np.ravel(frame)))


HEADER = ",".join(f"{n}.x,{n}.y,{n}.score" for n in files.NAMES)


@pytest.mark.parametrize("layout", [AXES, ("track", "xy", "node", "frame"), AXES[::-1]])
def test_axes_of_sleap_analysis_are_those_that_it_names(
    tmp_path: Path, layout: tuple[str, ...]
) -> None:
    path = files.sleap_analysis(tmp_path / "a.analysis.h5", TWO, ["one", "two"])
    values = TWO.transpose(1, 0, 2, 3)
    with h5py.File(path, "a") as file:
        for name, own, array in (
            ("tracks", AXES, values[..., :2]),
            ("point_scores", AXES[:3], values[..., 2]),
        ):
            del file[name]
            axes = [axis for axis in layout if axis in own]
            file[name] = array.transpose([own.index(axis) for axis in axes])
            file[name].attrs["dims"] = json.dumps(axes)
    assert_shows(fewview.read(path, person="two"), TWO[1])


def test_sleap_analysis_that_was_not_transposed(tmp_path: Path) -> None:
    path = files.sleap_analysis(tmp_path / "a.analysis.h5", TWO, ["one", "two"])
    with h5py.File(path, "a") as file:
        for name, axes in (("tracks", (3, 2, 1, 0)), ("point_scores", (2, 1, 0))):
            values = file[name][()]
            del file[name]
            file[name] = values.transpose(axes)
    assert_shows(fewview.read(path, person="one"), TWO[0])


def test_analysis_files_are_called_as_sleap_calls_its_videos(tmp_path: Path) -> None:
    paths = [
        files.sleap_analysis(tmp_path / f"labels.v001.00{n}_{name}.analysis.h5", TWO, ["a", "b"])
        for n, name in enumerate(("left.cam", "right"))
    ]
    assert fewview.read(paths, person="a").view_names == ("left.cam", "right")


def test_videos_of_a_sleap_project_have_names(tmp_path: Path) -> None:
    path = files.slp(tmp_path / "a.slp", XYZ[None])
    with h5py.File(path, "a") as file:
        table = file["frames"][()]
        table["video"][3:], table["frame_idx"] = 1, [0, 1, 2] * 2
        file["frames"][...] = table
        del file["videos_json"]
        named: list[Any] = [["cams/left/0.png", "cams/left/1.png"], "."]
        texts = [json.dumps({"backend": {"filename": name}}) for name in named]
        file["videos_json"] = np.array(texts, "S")
    assert fewview.read(path).view_names == ("left", "video1")


@pytest.mark.parametrize("write", [files.dlc_csv, files.dlc_h5_fixed, files.dlc_h5_table])
def test_points_of_no_animal_are_left_out(tmp_path: Path, write: Any) -> None:
    labels = files.columns(files.NAMES, ("mouse",)) + files.columns(("corner",), ("single",))
    values = np.concatenate([XYZ.reshape(6, -1), np.full((6, 3), 9.0)], axis=1)
    capture = fewview.read(write(tmp_path / f"a.{write.__name__[4:6]}", labels, values))
    assert_shows(capture, XYZ)
    assert capture.keypoint_names == files.NAMES
    assert "corner left out" in said(capture)


def test_columns_that_hold_no_numbers_are_left_out(tmp_path: Path) -> None:
    path = files.dlc_csv(tmp_path / "a.csv", files.columns(files.NAMES), XYZ.reshape(6, -1))
    heads = ["set", "", ""]
    lines = path.read_text().splitlines()
    ends = [*heads, *["train"] * 6]
    csv(path, [f"{line},{end}" for line, end in zip(lines, ends, strict=True)])
    assert_shows(fewview.read(path), XYZ)


def test_a_frame_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = files.dlc_csv(tmp_path / "a.csv", files.columns(files.NAMES), XYZ.reshape(6, -1))
    lines = path.read_text().splitlines()
    with pytest.raises(FormatError, match="frame 5 twice"):
        fewview.read(csv(path, [*lines, lines[-1]]))


def rows_called(path: Path, values: Any, names: list[str]) -> Path:
    """Write a table as DeepLabCut does, whose rows have these names."""
    files.dlc_csv(path, files.columns(files.NAMES), values.reshape(len(values), -1))
    lines = path.read_text().splitlines()
    rows = [f"{name},{line.partition(',')[2]}" for name, line in zip(names, lines[3:], strict=True)]
    return csv(path, [*lines[:3], *rows])


@pytest.mark.parametrize("called", ["{}", "labeled-data/walk/img{}.png"])
def test_rows_in_any_order_keep_their_frame_numbers(tmp_path: Path, called: str) -> None:
    body = files.walk(12)
    as_text = sorted(range(12), key=str)
    appended = [n for n in range(12) if n not in (1, 5)] + [5]
    for camera, order in (("a", as_text), ("b", appended)):
        names = [called.format(n) for n in order]
        rows_called(tmp_path / f"{camera}.csv", body[order], names)
    capture = fewview.read(tmp_path)
    absent = body.copy()
    absent[1] = (np.nan, np.nan, 0)
    assert_shows(capture, body, absent)


def test_rows_of_h5_in_any_order_keep_their_frame_numbers(tmp_path: Path) -> None:
    order = [4, 0, 5, 2, 1, 3]
    labels = files.columns(files.NAMES)
    files.dlc_h5_fixed(tmp_path / "a.h5", labels, XYZ.reshape(6, -1))
    path = files.dlc_h5_fixed(tmp_path / "b.h5", labels, XYZ[order].reshape(6, -1))
    with h5py.File(path, "a") as file:
        file["df_with_missing/axis1"][...] = order
    assert_shows(fewview.read(tmp_path), XYZ, XYZ)


def test_images_of_a_table_are_ordered_by_their_numbers(tmp_path: Path) -> None:
    order = [3, 0, 4, 1, 2]
    rows = [f"{'ba'[n % 2]}_{n + 10}.png,{wide(XYZ[n])}" for n in order]
    capture = fewview.read(csv(tmp_path / "a.csv", [f"frame,{HEADER}", *rows]))
    assert_shows(capture, XYZ[:5])


def test_filtered_files_stand_for_those_beside_them(tmp_path: Path) -> None:
    labels = files.columns(files.NAMES)
    for camera in ("cam1", "cam2"):
        for end in ("", "_filtered", "_skeleton"):
            values = XYZ + (end == "_filtered")
            values[..., 2] = XYZ[..., 2]
            files.dlc_csv(tmp_path / f"{camera}DLC_net{end}.csv", labels, values.reshape(6, -1))
    capture = fewview.read(tmp_path)
    assert_shows(capture, *[XYZ + np.array((1, 1, 0))] * 2)
    assert capture.view_names == ("cam1", "cam2")
    assert "cam1DLC_net.csv was left out for cam1DLC_net_filtered.csv" in said(capture)


def test_cameras_are_called_as_their_folders(tmp_path: Path) -> None:
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        labels = files.columns(files.NAMES)
        files.dlc_csv(tmp_path / camera / "pose.csv", labels, XYZ.reshape(6, -1))
    assert fewview.read(tmp_path).view_names == ("left", "right")


def test_rows_that_name_nobody_are_several_animals(tmp_path: Path) -> None:
    lines = [f"track,frame_idx,instance.score,{HEADER}"]
    for n in range(6):
        turn = (1, 0) if n % 2 else (0, 1)
        lines += [f",{n},0.9,{wide(TWO[who, n])}" for who in turn]
    capture = fewview.read(csv(tmp_path / "a.csv", lines), person=0)
    right = TWO[np.argmax(TWO[..., 2].sum((1, 2)))]
    assert_shows(capture, right)
    assert "up to 2 people" in said(capture)


def test_a_person_given_twice_is_refused(tmp_path: Path) -> None:
    row = f"t0,0,{wide(XYZ[0])}"
    with pytest.raises(FormatError, match="'t0' twice"):
        fewview.read(csv(tmp_path / "a.csv", [f"track,frame,{HEADER}", row, row]))


def test_columns_of_several_animals(tmp_path: Path) -> None:
    names = [f"inst{who}.{cell}" for who in (0, 1) for cell in HEADER.split(",")]
    lines = [",".join(["frame_idx", "inst0.track", "inst0.score", *names])]
    lines += [f"{n},a,0.9,{wide(TWO[0, n])},{wide(TWO[1, n])}" for n in range(6)]
    capture = fewview.read(csv(tmp_path / "a.csv", lines), person=1)
    assert_shows(capture, TWO[np.argmin(TWO[..., 2].sum((1, 2)))])
    assert capture.keypoint_names == files.NAMES


def test_columns_without_an_x_and_y_are_no_keypoints(tmp_path: Path) -> None:
    lines = [f"frame,track_score,bbox,{HEADER}"]
    lines += [f"{n},0.5,7,{wide(frame)}" for n, frame in enumerate(XYZ)]
    capture = fewview.read(csv(tmp_path / "a.csv", lines))
    assert_shows(capture, XYZ)
    assert "not understood: bbox" in said(capture)


@pytest.mark.parametrize("between", [";", "\t"])
def test_decimal_commas(tmp_path: Path, between: str) -> None:
    lines = [between.join(["frame", *HEADER.split(",")])]
    lines += [f"{n}{between}{wide(f, between)}".replace(".", ",") for n, f in enumerate(XYZ)]
    path = csv(tmp_path / "a.csv", ["\ufeff" + lines[0], *lines[1:]])
    assert_shows(fewview.read(path), XYZ)


@pytest.mark.parametrize("cell", ["", " ", "NaN", "NA", "None", "-1"])
def test_cells_that_say_nothing_are_gaps(tmp_path: Path, cell: str) -> None:
    values = [wide(frame).split(",") for frame in XYZ]
    values[2][:2] = [cell, cell]
    path = csv(tmp_path / "a.csv", [HEADER, *map(",".join, values)])
    capture = fewview.read(path)
    assert np.isnan(capture.keypoints[2, 0, 0]).all()
    np.testing.assert_allclose(capture.keypoints[2, 0, 1:], XYZ[2, 1:, :2], rtol=1e-6)
    assert np.isfinite(capture.keypoints[[0, 1, 3, 4, 5]]).all()


def test_times_are_frames_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    times = [0.05, 0.1, 0.9, 1, 9.5, 10]
    lines = ["time,keypoint,x,y,confidence"]
    for time, frame in reversed(list(zip(times, XYZ, strict=True))):
        lines += [f"{time},{n},{wide(f)}" for n, f in zip(files.NAMES, frame, strict=True)]
    capture = fewview.read(csv(tmp_path / "a.csv", lines))
    assert_shows(capture, XYZ)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.array(times))
    with pytest.raises(FormatError, match="no column `frame`"):
        fewview.read(csv(tmp_path / "b.csv", ["keypoint,x,y", "nose,1,2"]))


def test_a_row_for_each_video(tmp_path: Path) -> None:
    lines = [f"frame,video_path,{HEADER}"]
    lines += [f"{n},v/cam{v}.mp4,{wide(f)}" for n, f in enumerate(XYZ) for v in (1, 2)]
    assert fewview.read(csv(tmp_path / "a.csv", lines)).view_names == ("cam1", "cam2")


def test_early_openpose(tmp_path: Path) -> None:
    body = files.walk(6, 25)
    folder = files.openpose(tmp_path / "cam", [[frame] for frame in body])
    for path in folder.iterdir():
        path.write_text(path.read_text().replace("pose_keypoints_2d", "pose_keypoints"))
    assert_shows(fewview.read(folder), body)


def test_shares_of_the_image_are_never_taken_for_pixels(tmp_path: Path) -> None:
    body = files.walk(6, 25)
    body[2, 3, :2] = 0
    folder = files.openpose(tmp_path / "cam", [[f * (1 / 640, 1 / 480, 1)] for f in body])
    with pytest.raises(FormatError, match="image_size"):
        fewview.read(folder)
    capture = fewview.read(folder, image_size=(640, 480))
    body[2, 3] = (np.nan, np.nan, 0)
    assert_shows(capture, body, atol=1e-3)
    middle = files.openpose(tmp_path / "b", [[f * (1 / 320, 1 / 240, 1) - (1, 1, 0)] for f in body])
    with pytest.raises(FormatError, match="between -1 and 1"):
        fewview.read(middle)


@pytest.mark.parametrize("far", [3.2, -3.2])
def test_a_landmark_far_outside_leaves_the_others_shares(tmp_path: Path, far: float) -> None:
    body = files.walk(6, 25)
    body[2, 3, :2] = far * 640, far * 480
    folder = files.openpose(tmp_path / "cam", [[f * (1 / 640, 1 / 480, 1)] for f in body])
    assert_shows(fewview.read(folder, image_size=(640, 480)), body, atol=1e-3)


def test_few_coordinates_near_the_edge_leave_the_others_pixels(tmp_path: Path) -> None:
    body = files.walk(6, 25)
    body[:, :12, :2] /= 300
    folder = files.openpose(tmp_path / "cam", [[frame] for frame in body])
    assert_shows(fewview.read(folder, image_size=(640, 480)), body)


def test_a_first_image_that_shows_nobody(tmp_path: Path) -> None:
    body = files.walk(6, 17)
    for n, frame in enumerate(body):
        one = {"keypoints": frame[:, :2].tolist(), "keypoint_scores": frame[:, 2].tolist()}
        (tmp_path / f"{n:06d}.json").write_text(json.dumps([one] if n else []))
    capture = fewview.read(tmp_path)
    assert np.isnan(capture.keypoints[0]).all()
    np.testing.assert_allclose(capture.keypoints[1:, 0], body[1:, :, :2], rtol=1e-6)


def landmarks(frame: Any, **more: Any) -> list[dict[str, Any]]:
    return [{"id": i, "x": x, "y": y, "vis": v, **more} for i, (x, y, v) in enumerate(frame)]


def test_mediapipe_keeps_frame_numbers_and_the_order_of_landmarks(tmp_path: Path) -> None:
    body = files.walk(6, 33)
    numbers = [0, 1, 4, 5, 6, 9]
    frames = [
        {"frame": n, "landmarks": landmarks(frame)[::-1]}
        for n, frame in zip(numbers, body, strict=True)
    ]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(frames))
    capture = fewview.read(path, fps=1)
    assert_shows(capture, body)
    np.testing.assert_array_equal(capture.times, numbers)
    frames[2]["landmarks"] = [{**point, "id": 40} for point in landmarks(body[2])]
    path.write_text(json.dumps(frames))
    with pytest.raises(FormatError, match="unlike id"):
        fewview.read(path)


def test_mediapipe_with_a_file_for_each_frame(tmp_path: Path) -> None:
    body = files.walk(6, 33)
    for n, frame in enumerate(body):
        (tmp_path / f"frame_{n * 2:05d}.json").write_text(
            json.dumps({"landmarks": landmarks(frame)})
        )
    capture = fewview.read(tmp_path, fps=1)
    assert_shows(capture, body)
    np.testing.assert_array_equal(capture.times, np.arange(6) * 2)


def test_arrays_whose_frames_come_first_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((100, 2, 4, 2), 50.0))
    with pytest.raises(FormatError, match="swap its first two axes"):
        fewview.read(tmp_path / "a.npy")
