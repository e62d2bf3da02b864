"""TRC, by a parser that follows OpenSim's description, and C3D, by ezc3d."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import ezc3d
import numpy as np
import pytest
from fewview import Animation, write
from fewview.errors import FormatError
from numpy.typing import NDArray


def read_trc(
    path: Path,
) -> tuple[dict[str, str], list[str], NDArray[np.float64], NDArray[np.float64]]:
    """Return header, names, times and points (N, P, 3), as OpenSim's TRCFileAdapter does."""
    lines = path.read_text(encoding="utf-8").split("\n")
    assert lines[0].startswith("PathFileType\t4\t(X/Y/Z)\t")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    columns = lines[3].split("\t")
    assert columns[:2] == ["Frame#", "Time"]
    count = int(header["NumMarkers"])
    names = columns[2::3]
    assert len(names) == count
    assert lines[4].split("\t") == ["", "", *[f"{a}{n + 1}" for n in range(count) for a in "XYZ"]]
    assert lines[5] == ""
    rows = [line.split("\t") for line in lines[6:-1]]
    assert all(len(row) == 2 + 3 * count for row in rows)
    assert [row[0] for row in rows] == [str(n + 1) for n in range(int(header["NumFrames"]))]
    numbers = np.array([[float(value or "nan") for value in row[1:]] for row in rows])
    return header, names, numbers[:, 0], numbers[:, 1:].reshape(len(rows), count, 3)


def test_trc(tmp_path: Path, animation: Animation) -> None:
    header, names, times, points = read_trc(write(tmp_path / "a.trc", animation))
    assert header["Units"] == "m"
    assert header["DataRate"] == header["CameraRate"] == header["OrigDataRate"] == "25"
    assert names == list(animation.names)
    np.testing.assert_allclose(times, animation.seconds)
    np.testing.assert_allclose(points, animation.points, rtol=1e-8)


def test_a_trc_with_gaps_anywhere_has_all_its_fields(tmp_path: Path, animation: Animation) -> None:
    """OpenSim refuses a line that ends in empty fields: it has fewer than the header, then."""
    points = animation.points.copy()
    points[5], points[6, -1], points[7, 0] = np.nan, 1.0, np.nan
    path = write(tmp_path / "a.trc", replace(animation, points=points))
    for line in path.read_text(encoding="utf-8").split("\n")[6:-1]:
        assert len(line.rstrip("\t").split("\t")) == 17
    np.testing.assert_allclose(read_trc(path)[3], points, rtol=1e-8)


def test_opensim_loads_a_trc_with_gaps_anywhere(tmp_path: Path, animation: Animation) -> None:
    opensim = pytest.importorskip("opensim", reason="OpenSim is not installed")
    points = animation.points.copy()
    points[5], points[6, -1], points[7, 0] = np.nan, 1.0, np.nan
    path = write(tmp_path / "a.trc", replace(animation, points=points))
    table = opensim.TimeSeriesTableVec3(str(path))
    rows = [table.getRowAtIndex(n) for n in range(table.getNumRows())]
    loaded = [[row.getElt(0, n).to_numpy() for n in range(points.shape[1])] for row in rows]
    np.testing.assert_allclose(loaded, points, rtol=1e-6)


JOINTS = {"LHip": "femur_l", "right_knee": "tibia_r", "leftWrist": "hand_l", "LHeel": "calcn_l"}


def test_markers_of_a_trc_have_places_in_models_of_opensim(
    tmp_path: Path, animation: Animation
) -> None:
    named = replace(animation, keypoint_names=("nose", *JOINTS))
    path = write(tmp_path / "a.markers.xml", named)
    found = ElementTree.parse(path).getroot().iter("Marker")  # noqa: S314 (our own)
    places = {marker.get("name"): [part.text for part in marker] for marker in found}
    assert places == {
        name: [f"/bodyset/{body}", "0 0 0", "false" if name == "LHeel" else "true"]
        for name, body in JOINTS.items()
    }
    for names, words in ((("a", "b", "c", "d", "e"), "no keypoint"), (animation.names, "blanks")):
        with pytest.raises(FormatError, match=words):
            write(tmp_path / "b.markers.xml", replace(animation, keypoint_names=names))
    assert not (tmp_path / "b.markers.xml").exists()


def test_opensim_puts_the_markers_on_bodies(tmp_path: Path, animation: Animation) -> None:
    opensim = pytest.importorskip("opensim", reason="OpenSim is not installed")
    path = write(tmp_path / "a.markers.xml", replace(animation, keypoint_names=("nose", *JOINTS)))
    model = opensim.Model()
    for place, name in enumerate(JOINTS.values()):
        body = opensim.Body(name, 1, opensim.Vec3(0), opensim.Inertia(1, 1, 1))
        model.addBody(body)
        at = opensim.Vec3(place, 0, 0), opensim.Vec3(0)
        ends = model.getGround(), *at, body, opensim.Vec3(0), opensim.Vec3(0)
        model.addJoint(opensim.WeldJoint(f"{name}_joint", *ends))
    model.updateMarkerSet(opensim.MarkerSet(str(path)))
    state = model.initSystem()
    markers = model.getMarkerSet()
    found = [markers.get(name).getLocationInGround(state).get(0) for name in JOINTS]
    assert found == [0, 1, 2, 3]


def test_a_hole_in_the_frame_numbers_stays(tmp_path: Path, animation: Animation) -> None:
    numbers = np.r_[1001:1007, 1010:1016]
    holed = replace(animation, numbers=numbers, times=(numbers - 1001) / 25)
    trc = write(tmp_path / "a.trc", holed).read_text().split("\n")
    assert [int(line.split("\t")[0]) for line in trc[6:-1]] == numbers.tolist()
    assert trc[2].split("\t")[6] == "1001"
    csv = write(tmp_path / "a.csv", holed).read_text().splitlines()
    assert [int(line.split(",")[0]) for line in csv[1:]] == numbers.tolist()
    assert float(csv[7].split(",")[1]) == pytest.approx(9 / 25)
    file = ezc3d.c3d(str(write(tmp_path / "a.c3d", holed)))  # which has a constant rate
    shown = file["data"]["points"][:3].transpose(2, 1, 0)
    assert len(shown) == 15
    assert np.isnan(shown[6:9]).all()
    np.testing.assert_allclose(shown[9:], holed.points[6:], rtol=1e-6)
    assert "Frames: 15" in write(tmp_path / "a.bvh", holed).read_text()


def test_c3d(tmp_path: Path, animation: Animation) -> None:
    uneven = replace(animation, fps=None, times=np.arange(12) / 25 + 1e-3 * (np.arange(12) % 2))
    for given in (animation, uneven):
        file = ezc3d.c3d(str(write(tmp_path / "a.c3d", given)))
        point = file["parameters"]["POINT"]
        assert point["RATE"]["value"][0] == pytest.approx(given.rate, rel=1e-6)
        assert point["UNITS"]["value"] == ["m"]
        assert point["LABELS"]["value"] == list(given.names)
        np.testing.assert_allclose(
            file["data"]["points"][:3].transpose(2, 1, 0), given.points, rtol=1e-6
        )
        residuals = file["data"]["meta_points"]["residuals"][0].T
        np.testing.assert_array_equal(residuals, np.where(given.seen, 0, -1))


def words_of(path: Path, frames: int, count: int) -> tuple[float, NDArray[np.int16]]:
    """Return the scale of a C3D file of floats, and the fourth words (N, P) by the guide."""
    content = path.read_bytes()
    place = 512 * (int.from_bytes(content[16:18], "little") - 1)
    (scale,) = np.frombuffer(content, "<f4", count=1, offset=12)
    points = np.frombuffer(content, "<f4", count=frames * count * 4, offset=place)
    return float(scale), points.reshape(frames, count, 4)[..., 3].astype(np.int16)


def test_residuals_of_c3d_are_how_far_points_may_be_off(
    tmp_path: Path, animation: Animation, doubted: Animation
) -> None:
    """By the guide's rules: residuals in the lower byte, in steps of the scale; no camera's bit."""
    path = write(tmp_path / "a.c3d", doubted)
    scale, words = words_of(path, 12, 5)
    assert scale < 0  # of floats
    assert ezc3d.c3d(str(path))["parameters"]["POINT"]["SCALE"]["value"] == [scale]
    np.testing.assert_array_equal(words == -1, ~doubted.seen)
    known = words > 0
    assert doubted.points_sd is not None
    np.testing.assert_array_equal(known, np.isfinite(doubted.points_sd))
    assert words[7, 1] == 0
    assert words.max() == 255
    np.testing.assert_allclose(
        -scale * (words[known] & 255), doubted.points_sd[known], atol=-0.501 * scale
    )
    unknown, words = words_of(write(tmp_path / "b.c3d", animation), 12, 5)
    np.testing.assert_array_equal(words, np.where(animation.seen, 0, -1))
    most = np.abs(animation.points[animation.seen]).max()
    assert -unknown == pytest.approx(most / 32000)  # a file of integers can hold all points


def test_a_gap_in_the_times_is_one_of_the_residuals(tmp_path: Path, doubted: Animation) -> None:
    late = replace(doubted, fps=None, times=np.r_[:6, 8:14] / 25)
    _, words = words_of(write(tmp_path / "a.c3d", late), 14, 5)
    assert (words[6:8] == -1).all()
    assert (words[8:, 0] > 0).all()


def test_c3d_of_many_points_and_frames(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(2, 300, 3))
    file = ezc3d.c3d(str(write(tmp_path / "wide.c3d", Animation(points, fps=100))))
    np.testing.assert_allclose(file["data"]["points"][:3].transpose(2, 1, 0), points, rtol=1e-6)
    with pytest.raises(FormatError, match="65535 frames"):
        write(tmp_path / "long.c3d", Animation(np.zeros((65_536, 1, 3))))


def test_what_markers_cannot_say_is_refused(tmp_path: Path, animation: Animation) -> None:
    with pytest.raises(FormatError, match="unit="):
        write(tmp_path / "a.trc", replace(animation, unit=None))
    with pytest.raises(FormatError, match="tab"):
        write(tmp_path / "a.trc", replace(animation, keypoint_names=("a\tb", "c", "d", "e", "f")))
    with pytest.raises(FormatError, match="uneven"):
        write(tmp_path / "a.c3d", replace(animation, fps=None, times=np.arange(12.0) ** 2))
    with pytest.raises(FormatError, match="127"):
        write(tmp_path / "a.c3d", replace(animation, keypoint_names=("a" * 128, *"bcde")))
    with pytest.raises(FormatError, match="one frame"):
        write(tmp_path / "a.c3d", Animation(np.empty((0, 3, 3))))
    assert not list(tmp_path.iterdir())
