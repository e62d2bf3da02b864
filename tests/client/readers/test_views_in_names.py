"""Keypoints whose names have cameras in them are several views."""

from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError

from . import files

XYZ = files.walk(6)


def csv(path: Path, names: Any = files.NAMES, values: Any = XYZ) -> Path:
    return files.dlc_csv(path, files.columns(names), values.reshape(len(values), 3 * len(names)))


def test_cameras_in_the_names_of_keypoints_are_views(tmp_path: Path) -> None:
    other = XYZ + np.array((300, 20, 0))
    both = np.concatenate([XYZ, other], axis=1)
    for names in (
        [f"real_{name}" for name in files.NAMES] + [f"mirror_{name}" for name in files.NAMES],
        [f"{name}-view" for name in files.NAMES] + [f"{name}-mirror" for name in files.NAMES],
        [f"real.{name}" for name in files.NAMES] + [f"left_mirror.{name}" for name in files.NAMES],
    ):
        path = csv(tmp_path / "a.csv", names, both)
        capture = fewview.read(path, image_size=(800, 600))
        assert capture.keypoint_names == files.NAMES
        np.testing.assert_allclose(capture.keypoints[:, 0], XYZ[..., :2], rtol=1e-6)
        turned = (799, 0) + other[..., :2] * (-1, 1)
        np.testing.assert_allclose(capture.keypoints[:, 1], turned, rtol=1e-6)
        assert "in their names" in "".join(capture.notes)
        assert fewview.read(path, views_in_names="none").keypoints.shape == (6, 1, 8, 2)
    first, second = csv(tmp_path / "b.csv"), csv(tmp_path / "c.csv", values=other)
    split = fewview.read([first, second], image_size=(800, 600), mirror="c")
    np.testing.assert_array_equal(capture.keypoints, split.keypoints)


def test_a_file_that_is_called_a_mirror_is_a_mirror_image(tmp_path: Path) -> None:
    real, mirror = csv(tmp_path / "rat_real.csv"), csv(tmp_path / "rat_mirror.csv")
    seen = fewview.read([real, mirror], image_size=(800, 600))
    asked = fewview.read([real, mirror], image_size=(800, 600), mirror="mirror")
    np.testing.assert_array_equal(seen.keypoints, asked.keypoints)
    np.testing.assert_allclose(seen.keypoints[:, 1, :, 0], 799 - XYZ[..., 0], rtol=1e-6)
    assert "--mirror none" in "".join(seen.notes)
    for names, given in (
        (("rat_real", "rat_mirror"), "none"),
        (("real", "mirror_flipped"), None),
        (("mirrorless", "dslr"), None),
        (("mirror1", "mirror2"), None),
    ):
        paths = [csv(tmp_path / f"{name}.csv") for name in names]
        capture = fewview.read(paths, image_size=(800, 600), mirror=given)
        np.testing.assert_allclose(capture.keypoints[:, 1], XYZ[..., :2], rtol=1e-6)


def test_words_of_cameras_may_be_given(tmp_path: Path) -> None:
    other = XYZ + np.array((300, 20, 0))
    both = np.concatenate([XYZ, other], axis=1)
    names = [f"Upper{name}" for name in files.NAMES] + [f"low {name}" for name in files.NAMES]
    path = csv(tmp_path / "a.csv", names, both)
    assert fewview.read(path).views == 1
    capture = fewview.read(path, views_in_names="low,upper")
    assert capture.view_names == ("low", "upper")
    np.testing.assert_allclose(capture.keypoints[:, 0], other[..., :2], rtol=1e-6)
    with pytest.raises(FormatError, match="do not begin or end with east") as raised:
        fewview.read(path, views_in_names=["east", "west"])
    assert raised.value.option == "views_in_names"


@pytest.mark.parametrize("words", [("left", "right"), ("front", "hind"), ("thumb", "index")])
def test_words_of_body_parts_are_no_cameras(tmp_path: Path, words: tuple[str, str]) -> None:
    names = [f"{word}_{name}" for word in words for name in files.NAMES]
    values = np.concatenate([XYZ, XYZ], axis=1)
    assert fewview.read(csv(tmp_path / "a.csv", names, values)).views == 1
