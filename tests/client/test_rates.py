"""Frames per second of times that files have to the millisecond."""

from pathlib import Path

import ezc3d
import fewview
import numpy as np
import pytest
from fewview import Animation, write


@pytest.mark.parametrize("fps", [23.976, 30, 59.94, 60, 119.88, 120])
@pytest.mark.parametrize("frames", [np.arange(600), np.r_[:200, 230:500, 501:600]])
def test_files_have_the_rate_of_times_to_the_millisecond(
    tmp_path: Path, fps: float, frames: "np.ndarray[tuple[int], np.dtype[np.int64]]"
) -> None:
    points = np.random.default_rng(1).normal(size=(len(frames), 3, 3))
    times = np.round(7 + frames / fps, 3)
    animation = Animation(points, unit="m", times=times, edges=((0, 1), (1, 2)))
    near = pytest.approx(fps, rel=3e-4)
    file = ezc3d.c3d(str(write(tmp_path / "a.c3d", animation)))
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == near
    shown = file["data"]["points"][:3].transpose(2, 1, 0)
    assert len(shown) == 600
    np.testing.assert_allclose(shown[frames], points, rtol=1e-6)
    trc = write(tmp_path / "a.trc", animation).read_text().split("\n")
    assert float(trc[2].split("\t")[0]) == near
    bvh = write(tmp_path / "a.bvh", animation).read_text()
    assert 1 / float(bvh.partition("Frame Time: ")[2].split()[0]) == near


def test_many_frames_that_were_dropped_leave_the_rate(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    kept = np.flatnonzero(rng.random(20_000) > 0.02)
    animation = Animation(np.zeros((len(kept), 1, 3)), unit="m", times=np.round(kept / 60, 3))
    file = ezc3d.c3d(str(write(tmp_path / "a.c3d", animation)))
    there = np.isfinite(file["data"]["points"][0, 0])
    np.testing.assert_array_equal(np.flatnonzero(there), kept - kept[0])


def test_times_to_the_millisecond_are_no_other_rate(tmp_path: Path) -> None:
    rows = [f"{n + 1},{2 * n + 9},0.9,{n + 7},{n + 9},0.8" for n in range(400)]
    names = "a_x,a_y,a_confidence,b_x,b_y,b_confidence"
    timed = [f"{round(n / 120, 3)},{row}" for n, row in enumerate(rows)]
    (tmp_path / "a.csv").write_text("\n".join([f"time,{names}", *timed]))
    (tmp_path / "b.csv").write_text("\n".join([names, *rows]))
    capture = fewview.read([tmp_path / "a.csv", tmp_path / "b.csv"], fps="b=120")
    assert not any("frames per second" in note for note in capture.notes)
    np.testing.assert_array_equal(capture.keypoints[:, 0], capture.keypoints[:, 1])
