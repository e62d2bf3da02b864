"""Animations as tables and arrays, read back by other means."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fewview import Animation, write
from fewview.errors import FormatError
from fewview.writers import FORMATS
from safetensors import safe_open


def test_a_wide_table(tmp_path: Path, animation: Animation) -> None:
    path = write(tmp_path / "a.csv", animation)
    with path.open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert head[:3] == ["frame", "time", "nose_x"]
    assert rows[3][:2] == ["3", "0.12"]
    assert rows[3][2 + 6 : 2 + 9] == ["", "", ""]
    numbers = np.array([[float(x or "nan") for x in row[2:]] for row in rows]).reshape(12, 5, 3)
    np.testing.assert_allclose(numbers, animation.points, rtol=1e-8)


def test_a_tidy_table(tmp_path: Path, animation: Animation) -> None:
    path = write(tmp_path / "a.tidy.csv", replace(animation, fps=None))
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["frame", "keypoint", "x", "y", "z"]
    assert [row["keypoint"] for row in rows[:5]] == list(animation.names)
    numbers = np.array([[float(row[axis] or "nan") for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(numbers.reshape(12, 5, 3), animation.points, rtol=1e-8)


def test_json_lines(tmp_path: Path, animation: Animation) -> None:
    path = write(tmp_path / "a.jsonl", animation)
    head, *frames = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert head == {
        "unit": "m",
        "fps": 25,
        "keypoint_names": list(animation.names),
        "edges": [list(edge) for edge in animation.edges],
    }
    assert [frame["frame"] for frame in frames] == list(range(12))
    assert frames[2]["time"] == pytest.approx(0.08)
    assert frames[0]["points"][2] is frames[4]["points"][4] is None
    points = [[point or [np.nan] * 3 for point in frame["points"]] for frame in frames]
    np.testing.assert_array_equal(points, animation.points)


def test_arrays(tmp_path: Path, animation: Animation) -> None:
    path = write(tmp_path / "a.npz", animation)
    with np.load(path, allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["points"], animation.points)
        assert set(arrays) == {"points", "unit", "fps", "keypoint_names", "edges"}
        again = Animation(**{name: arrays[name][()] for name in arrays if name != "unit"})
        assert str(arrays["unit"]) == "m"
    assert (again.names, again.edges) == (animation.names, animation.edges)


def test_safetensors(tmp_path: Path, animation: Animation) -> None:
    with safe_open(write(tmp_path / "a.safetensors", animation), "numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        about = file.metadata()
    np.testing.assert_array_equal(arrays["points"], animation.points)
    assert about.pop("unit") == "m"
    again = Animation(**arrays, **{name: json.loads(text) for name, text in about.items()})
    assert (again.names, again.edges, again.fps) == (animation.names, animation.edges, 25)
    timed = replace(animation, fps=None, times=np.arange(12.0) ** 2, keypoint_names=None)
    with safe_open(write(tmp_path / "a.safetensors", timed), "numpy") as file:
        np.testing.assert_array_equal(file.get_tensor("times"), timed.times)
        assert set(file.metadata()) == {"unit"}


def test_parquet(tmp_path: Path, animation: Animation) -> None:
    reader = pytest.importorskip("pyarrow.parquet", reason="pyarrow is large, and an extra")
    table = reader.read_table(write(tmp_path / "a.parquet", animation))
    assert table.column_names == ["frame", "time", "keypoint", "x", "y", "z"]
    assert table["keypoint"].to_pylist()[:5] == list(animation.names)
    assert table["x"].null_count == (~animation.seen).sum()
    numbers = np.array([table[axis].to_pylist() for axis in "xyz"], dtype=float).T
    np.testing.assert_array_equal(numbers.reshape(12, 5, 3), animation.points)
    assert json.loads(table.schema.metadata[b"fewview"])["unit"] == "m"


def test_tables_have_how_far_points_may_be_off(tmp_path: Path, doubted: Animation) -> None:
    with write(tmp_path / "a.csv", doubted).open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert head[2:7] == ["nose_x", "nose_y", "nose_z", "nose_sd", "left hip_x"]
    wide = np.array([[float(cell or "nan") for cell in row[2:]] for row in rows]).reshape(12, 5, 4)
    with write(tmp_path / "a.tidy.csv", doubted).open(newline="", encoding="utf-8") as file:
        tidy = [[row[name] for name in ("x", "y", "z", "sd")] for row in csv.DictReader(file)]
    assert doubted.points_sd is not None
    for numbers in (wide, np.array([[float(x or "nan") for x in row] for row in tidy])):
        values = numbers.reshape(12, 5, 4)
        np.testing.assert_allclose(values[..., :3], doubted.points, rtol=1e-8)
        np.testing.assert_allclose(values[..., 3], doubted.points_sd, rtol=1e-8)


def test_arrays_and_lines_have_how_far_points_may_be_off(
    tmp_path: Path, doubted: Animation
) -> None:
    lines = write(tmp_path / "a.jsonl", doubted).read_text(encoding="utf-8").splitlines()[1:]
    listed = [[sd or np.nan for sd in json.loads(line)["points_sd"]] for line in lines]
    np.testing.assert_array_equal(listed, doubted.points_sd)
    with np.load(write(tmp_path / "a.npz", doubted), allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["points_sd"], doubted.points_sd)
    with safe_open(write(tmp_path / "a.safetensors", doubted), "numpy") as file:
        np.testing.assert_array_equal(file.get_tensor("points_sd"), doubted.points_sd)


def test_parquet_has_how_far_points_may_be_off(tmp_path: Path, doubted: Animation) -> None:
    reader = pytest.importorskip("pyarrow.parquet", reason="pyarrow is large, and an extra")
    table = reader.read_table(write(tmp_path / "a.parquet", doubted))
    assert table.column_names[-1] == "sd"
    assert doubted.points_sd is not None
    assert table["sd"].null_count == np.isnan(doubted.points_sd).sum() > 0
    numbers = np.array(table["sd"].to_pylist(), dtype=float).reshape(12, 5)
    np.testing.assert_array_equal(numbers, doubted.points_sd)


@pytest.mark.parametrize("name", ["trc", "bvh", "glb"])
def test_formats_without_a_place_for_it_stay_as_they_are(
    name: str, tmp_path: Path, animation: Animation, doubted: Animation
) -> None:
    known, unknown = (tmp_path / part / f"a.{name}" for part in ("known", "unknown"))
    known.parent.mkdir()
    unknown.parent.mkdir()
    assert write(known, doubted).read_bytes() == write(unknown, animation).read_bytes()


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.name)
def test_a_format_can_be_named_whatever_the_file_is_called(
    known: object, tmp_path: Path, animation: Animation
) -> None:
    name = getattr(known, "name", "")
    if name == "parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is large, and an extra")
    if name == "nwb":
        pytest.importorskip("ndx_pose", reason="ndx-pose is an extra")
    if name == "opensim-markers":  # has no blanks in names
        animation = replace(animation, keypoint_names=("a", "b", "left_hip", "d", "e"))
    path = write(tmp_path / "motion", animation, format=name)
    assert path.stat().st_size > 100
    assert [file.name for file in tmp_path.iterdir()] == ["motion"]


def test_other_formats_are_refused_with_a_list(tmp_path: Path, animation: Animation) -> None:
    with pytest.raises(FormatError, match=r"'a\.fbx'.*glb"):
        write(tmp_path / "a.fbx", animation)
    with pytest.raises(FormatError, match="no format 'fbx'"):
        write(tmp_path / "a.csv", animation, format="fbx")
    assert not list(tmp_path.iterdir())


def test_an_animation_checks_itself(animation: Animation) -> None:
    assert np.isnan(animation.points[0, 2]).all()
    for wrong in (
        {"points": np.zeros((3, 2))},
        {"unit": "cm"},
        {"fps": 0},
        {"times": np.zeros(12)},
        {"times": np.arange(3)},
        {"keypoint_names": ("a", "a", "b", "c", "d")},
        {"edges": ((0, 5),)},
        {"points_sd": np.ones((12, 4))},
        {"points_sd": np.full((12, 5), -1.0)},
    ):
        with pytest.raises(ValueError, match=next(iter(wrong)).split("_")[0].rstrip("s")):
            replace(animation, **wrong)
    assert replace(animation, keypoint_names=None).names[4] == "point5"
    assert replace(animation, points_sd=np.full((12, 5), np.nan)).points_sd is None
    known = replace(animation, points_sd=np.ones((12, 5))).points_sd
    assert known is not None
    np.testing.assert_array_equal(np.isnan(known), ~animation.seen)
    assert replace(animation, fps=None).rate == 30
    uneven = replace(animation, fps=None, times=np.arange(12.0) ** 2)
    assert not uneven.even
    assert replace(animation, times=np.arange(12) / 25 + 3).even


def test_a_part_of_an_animation_has_what_is_known_of_its_frames(animation: Animation) -> None:
    sds, numbers = np.ones((12, 5)), np.arange(100, 112)
    whole = replace(animation, points_sd=sds, numbers=numbers, times=np.arange(12) / 25)
    part = whole.part(slice(3, 7))
    np.testing.assert_array_equal(part.points, whole.points[3:7])
    np.testing.assert_array_equal(part.numbers, [103, 104, 105, 106])
    np.testing.assert_array_equal(part.times, np.arange(3, 7) / 25)
    assert part.points_sd is not None
    assert part.points_sd.shape == (4, 5)
    assert (part.names, part.edges, part.fps) == (whole.names, whole.edges, whole.fps)
    assert animation.part(slice(2)).times is None
