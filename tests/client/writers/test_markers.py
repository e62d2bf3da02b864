"""TRC, by a parser that follows OpenSim's description, and C3D, by ezc3d."""

from dataclasses import replace
from pathlib import Path

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


def test_c3d(tmp_path: Path, animation: Animation) -> None:
    uneven = replace(animation, fps=None, times=np.arange(12) / 25 + 1e-3 * (np.arange(12) % 2))
    for told in (animation, uneven):
        file = ezc3d.c3d(str(write(tmp_path / "a.c3d", told)))
        point = file["parameters"]["POINT"]
        assert point["RATE"]["value"][0] == pytest.approx(told.rate, rel=1e-6)
        assert point["UNITS"]["value"] == ["m"]
        assert point["LABELS"]["value"] == list(told.names)
        np.testing.assert_allclose(
            file["data"]["points"][:3].transpose(2, 1, 0), told.points, rtol=1e-6
        )
        residuals = file["data"]["meta_points"]["residuals"][0].T
        np.testing.assert_array_equal(residuals, np.where(told.seen, 0, -1))


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
