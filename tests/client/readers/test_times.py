"""Which frames belong together where cameras have rates, clocks and numbers of their own."""

from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from numpy.typing import NDArray

from . import files

FAST = files.walk(60)  # 60 frames a second


def said(capture: fewview.Capture) -> str:
    return "\n".join(capture.notes)


def table(path: Path, body: NDArray[np.float64], **more: NDArray[np.float64]) -> Path:
    names = [f"{name}_{axis}" for name in files.NAMES for axis in ("x", "y", "confidence")]
    rows = [[*more, *names]]
    for n, frame in enumerate(body):
        rows.append(
            [f"{values[n]:.6g}" for values in more.values()] + [f"{v}" for v in frame.ravel()]
        )
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return path


def test_cameras_of_unlike_rates_are_joined_by_their_times(tmp_path: Path) -> None:
    fast = table(tmp_path / "a.csv", FAST, time=np.arange(60) / 60)
    slow = table(tmp_path / "b.csv", FAST[::2], time=np.arange(30) / 30)
    capture = fewview.read([fast, slow])
    np.testing.assert_allclose(capture.keypoints[::2, 1], FAST[::2, :, :2], rtol=1e-5)
    np.testing.assert_allclose(capture.keypoints[:, 0], FAST[..., :2], rtol=1e-5)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.arange(60) / 60, atol=1e-5)
    assert "joined by their times" in said(capture)
    by_row = fewview.read([fast, slow], align="index")
    assert np.isnan(by_row.keypoints[30:, 1]).all()


def test_rates_are_given_for_each_camera(tmp_path: Path) -> None:
    fast, slow = table(tmp_path / "a.csv", FAST), table(tmp_path / "b.csv", FAST[::2])
    assert "a has 2 times the frames of b" not in said(fewview.read([fast, fast]))
    capture = fewview.read([fast, slow], fps="a=60,b=30")
    np.testing.assert_allclose(capture.keypoints[::2, 1], FAST[::2, :, :2], rtol=1e-5)
    with pytest.raises(FormatError, match="no camera 'c'"):
        fewview.read([fast, slow], fps="c=60")


@pytest.mark.parametrize("first", [(0, 0), (1, 1), (1001, 1001), (200, 100)])
def test_frame_numbers_of_unlike_rates_are_of_one_clock(
    tmp_path: Path, first: tuple[int, int]
) -> None:
    """Files that count from 0, from 1, from a number of all, and of a part of a film."""
    table(tmp_path / "a.csv", FAST, frame=np.arange(60.0) + first[0])
    table(tmp_path / "b.csv", FAST[::2], frame=np.arange(30.0) + first[1])
    capture = fewview.read(tmp_path, fps="a=60,b=30")
    np.testing.assert_allclose(capture.keypoints[::2, 1], FAST[::2, :, :2], rtol=1e-5)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, np.arange(60) / 60, atol=1e-9)


def test_twice_the_frames_are_noticed(tmp_path: Path) -> None:
    body = files.walk(240)
    pair = [table(tmp_path / "a.csv", body), table(tmp_path / "b.csv", body[::2])]
    assert "a has 2 times the frames of b" in said(fewview.read(pair))


def test_rows_that_a_camera_dropped_are_found_by_its_clock(tmp_path: Path) -> None:
    clock = np.arange(60) / 60
    kept = np.delete(np.arange(60), [7, 8, 20])
    pair = [
        table(tmp_path / "a.csv", FAST, time=clock),
        table(tmp_path / "b.csv", FAST[kept], time=clock[kept] + 0.001),
    ]
    capture = fewview.read(pair)
    np.testing.assert_allclose(capture.keypoints[kept, 1], FAST[kept, :, :2], rtol=1e-5)
    assert np.isnan(capture.keypoints[[7, 8, 20], 1]).all()


def test_times_stay_where_a_camera_lacks_a_row(tmp_path: Path) -> None:
    clock, numbers = np.arange(60) / 60, np.arange(60.0)
    kept = np.delete(np.arange(60), [7, 8, 20])
    pair = [
        table(tmp_path / "a.csv", FAST, frame=numbers, time=clock),
        table(tmp_path / "b.csv", FAST[kept], frame=numbers[kept], time=clock[kept]),
    ]
    capture = fewview.read(pair)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, clock, atol=1e-5)
    late = table(tmp_path / "b.csv", FAST[kept], frame=numbers[kept], time=clock[kept] + 0.004)
    capture = fewview.read([pair[0], late])
    assert capture.times is not None
    np.testing.assert_allclose(capture.times[:, 1] - capture.times[:, 0], 0.004, atol=1e-5)
    alone = table(tmp_path / "b.csv", FAST[kept], frame=numbers[kept])
    capture = fewview.read([pair[0], alone])
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, clock, atol=1e-5)
    assert "times are those of a" in said(capture)


def test_holes_in_frame_numbers_stay(tmp_path: Path) -> None:
    numbers = np.r_[1001:1021, 1041:1081].astype(float)
    pair = [table(tmp_path / f"{name}.csv", FAST, frame=numbers) for name in "ab"]
    capture = fewview.read(pair)
    assert capture.numbers is not None
    np.testing.assert_array_equal(capture.numbers, numbers)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times, (numbers - 1001) / 30)
    assert "30 frames per second, as no rate is known" in said(capture)
    given = fewview.read(pair, fps=60)
    assert given.times is not None
    np.testing.assert_allclose(given.times, (numbers - 1001) / 60)
    np.savez(tmp_path / "kept.npz", **capture.arrays())  # type: ignore[arg-type]
    again = fewview.read(tmp_path / "kept.npz")
    assert again.numbers is not None
    np.testing.assert_array_equal(again.numbers, numbers)


def test_images_that_were_chosen_are_no_film(tmp_path: Path) -> None:
    numbers = np.cumsum(np.full(60, 100.0))
    assert fewview.read(table(tmp_path / "a.csv", FAST, frame=numbers)).times is None


def test_a_camera_that_counts_from_one_is_not_late(tmp_path: Path) -> None:
    frames = [[frame] for frame in files.walk(20, 25)]
    pair = [files.openpose(tmp_path / name, frames, first) for name, first in (("a", 0), ("b", 1))]
    capture = fewview.read(pair)
    np.testing.assert_array_equal(capture.keypoints[:, 0], capture.keypoints[:, 1])
    assert "b: frames are counted from 1" in said(capture)


@pytest.mark.parametrize(
    ("column", "cells"),
    [
        ("timestamp_ms", "{ms}"),
        ("time", "00:01:{s:09.6f}"),
        ("Time (s)", "{s}"),
        ("timestamp", "2024-05-01 12:00:{s:09.6f}"),
    ],
)
def test_clocks_in_many_spellings(tmp_path: Path, column: str, cells: str) -> None:
    path = table(tmp_path / "a.csv", FAST)
    header, *rows = path.read_text().splitlines()
    given = [cells.format(ms=1000 * n / 60, s=n / 60) for n in range(60)]
    rows = [f"{time},{row}" for time, row in zip(given, rows, strict=True)]
    path.write_text("\n".join([f"{column},{header}", *rows]))
    capture = fewview.read(path)
    assert capture.times is not None
    np.testing.assert_allclose(capture.times - capture.times[0], np.arange(60) / 60, atol=1e-5)
