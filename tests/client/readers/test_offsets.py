"""Keypoints that count from a crop's corner, and cameras that started late: given where read."""

from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files
from .test_times import FAST, said, table


def test_keypoints_of_a_crop_count_from_the_image_s_corner(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        table(tmp_path / f"{name}.csv", FAST)
    capture = fewview.read(tmp_path, offset="b=560,180.5, c=-3,0")
    whole = FAST[..., :2]
    for view, corner in enumerate([(0, 0), (560, 180.5), (-3, 0)]):
        np.testing.assert_allclose(capture.keypoints[:, view], whole + corner, rtol=1e-4)
    assert "b: counted from (560, 180.5); put right" in said(capture)
    assert "a: counted" not in said(capture)
    all_of_them = fewview.read(tmp_path, offset="5,6,c=7,8").keypoints
    np.testing.assert_allclose(all_of_them[:, 0], whole + np.array([5, 6]), rtol=1e-4)
    np.testing.assert_allclose(all_of_them[:, 2], whole + np.array([7, 8]), rtol=1e-4)


def test_gaps_stay_gaps_and_shares_become_pixels_first(tmp_path: Path) -> None:
    labels = files.columns(files.NAMES)
    for v in range(2):
        share = FAST / (640, 480, 1)
        share[3, 0] = 0
        files.dlc_csv(tmp_path / f"cam{v}.csv", labels, share.reshape(len(share), -1))
    capture = fewview.read(tmp_path, image_size="640x480", offset="cam1=100,50")
    assert np.isnan(capture.keypoints[3, :, 0]).all()
    np.testing.assert_allclose(capture.keypoints[5, 1], FAST[5, :, :2] + (100, 50), rtol=1e-3)


@pytest.mark.parametrize("late", [0.5, -0.25])
def test_late_cameras_are_put_in_step(tmp_path: Path, late: float) -> None:
    """View b shows at its frame n + 60 late what the others show at n."""
    frames = round(60 * late)
    a = FAST[max(frames, 0) :]
    b = FAST[max(-frames, 0) :]
    table(tmp_path / "a.csv", a)
    table(tmp_path / "b.csv", b)
    capture = fewview.read(tmp_path, fps=60, offset_seconds=f"b={late}")
    both = np.isfinite(capture.keypoints).all((1, 2, 3))
    assert both.sum() == 60 - abs(frames)
    np.testing.assert_allclose(capture.keypoints[both, 0], capture.keypoints[both, 1], rtol=1e-4)
    when = "later" if late > 0 else "earlier"
    assert f"b: shows moments {abs(late):g} s {when}; put in step" in said(capture)


def test_what_cannot_be_is_refused_in_words(tmp_path: Path) -> None:
    for name in ("a", "b"):
        table(tmp_path / f"{name}.csv", FAST)
    for text in ("b=560", "b=x,y", "b=560,180,90", "b=nan,0", "b=1e9,0", ""):
        with pytest.raises(FormatError, match="expected X,Y in pixels, such as 560,180"):
            fewview.read(tmp_path, offset=text)
    for text in ("b=soon", "b=inf", ""):
        with pytest.raises(FormatError, match="no number of seconds"):
            fewview.read(tmp_path, offset_seconds=text)
    for option in ({"offset": "c=1,2"}, {"offset_seconds": "c=1", "fps": 60}):
        with pytest.raises(FormatError, match="no camera 'c'; there are a, b"):
            fewview.read(tmp_path, **option)
    with pytest.raises(FormatError, match="no times"):
        fewview.read(tmp_path, offset_seconds="b=4.2")
