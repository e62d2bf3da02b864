"""Reading captures: the error of a file is one line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from capture import Capture, CaptureError, hold_out, read_capture


def write_text(path: Path) -> None:
    path.write_text("frame,x,y\n1,2,3\n")


def write_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def write_cut_short(path: Path) -> None:
    np.savez(path, keypoints=np.zeros((9, 2, 8, 2)))
    path.write_bytes(path.read_bytes()[:900])


def write_empty(path: Path) -> None:
    path.touch()


def write_other_name(path: Path) -> None:
    np.savez(path, poses=np.zeros((9, 2, 8, 2)))


def write_three_axes(path: Path) -> None:
    np.savez(path, keypoints=np.zeros((9, 8, 2)))


def write_misfit(path: Path) -> None:
    np.savez(path, keypoints=np.zeros((9, 2, 8, 2)), confidence=np.zeros((9, 8)))


def write_pickle(path: Path) -> None:
    np.savez(path, keypoints=np.array([None]))


def write_nothing(_path: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (write_nothing, "no such file"),
        (write_text, "no .npz file"),
        (write_empty, "no .npz file"),
        (write_cut_short, "no .npz file"),
        (write_array, "a single array"),
        (write_other_name, "holds poses"),
        (write_three_axes, "(9, 8, 2)"),
        (write_misfit, "(9, 2, 8)"),
        (write_pickle, "cannot be read"),
    ],
)
def test_says_what_was_expected(tmp_path: Path, write: Callable[[Path], None], reason: str) -> None:
    write(tmp_path / "bad.npz")

    with pytest.raises(CaptureError) as caught:
        read_capture(tmp_path / "bad.npz")

    assert reason in str(caught.value)
    assert "expected an .npz file with `keypoints` (frames, views, keypoints, 2)" in str(
        caught.value
    )
    assert "\n" not in str(caught.value)


def test_holds_out_only_frames_that_show_something() -> None:
    keypoints = np.full((40, 2, 8, 2), np.nan, np.float32)
    keypoints[::4, 1, :4] = np.arange(8).reshape(4, 2)

    seen, unseen = hold_out(Capture(keypoints), 0.2, seed=1)

    assert (len(seen), len(unseen)) == (38, 2)
    assert unseen.observed().sum((1, 2)).tolist() == [4, 4]
    assert hold_out(Capture(keypoints), 0.2, seed=1)[1].keypoints.shape == (2, 2, 8, 2)


@pytest.mark.parametrize(("frames", "held_out"), [(1, 0), (2, 1), (3, 1), (15, 2)])
def test_holds_out_one_frame_at_least_but_never_all(frames: int, held_out: int) -> None:
    seen, unseen = hold_out(Capture(np.ones((frames, 2, 8, 2), np.float32)), 0.1, seed=0)

    assert len(unseen) == held_out
    assert len(seen) == frames - held_out
