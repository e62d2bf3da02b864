"""Accepted keypoints: where they are, what they weigh, and what is left out."""

import numpy as np
import pytest

from models.labelling.accepted import accept
from tests.models.labelling.films import FRAMES, SIZES, filmed, walked
from tests.models.walk import walk


def test_labels_are_where_the_detector_or_the_fit_shows_keypoints() -> None:
    points, keypoints = walked()
    film, evidence = filmed(points, keypoints)
    detected = accept(film, evidence, SIZES, "keypoints")
    kept = detected.weights > 0
    assert kept.mean() > 0.99
    np.testing.assert_allclose(detected.keypoints[kept], keypoints[kept], atol=1e-3)
    shown = accept(film, evidence, SIZES, "reprojections")
    off = np.linalg.norm(shown.keypoints - film.reprojections, axis=-1)
    assert np.nanmax(off) < 1e-2
    assert np.isfinite(off).mean() > 0.99
    np.testing.assert_array_equal(np.isfinite(off), shown.weights > 0)
    np.testing.assert_array_equal(np.isfinite(detected.keypoints).all(-1), kept)


def test_a_wrong_keypoint_is_put_right_by_the_others() -> None:
    points, keypoints = walked()
    true = keypoints[100, 1, 6].copy()
    keypoints[100, 1, 6] += [40.0, 0.0]
    film, evidence = filmed(points, keypoints)
    assert accept(film, evidence, SIZES, "keypoints").weights[100, 1, 6] == 0
    shown = accept(film, evidence, SIZES, "reprojections")
    assert np.linalg.norm(shown.keypoints[100, 1, 6] - true) < 5
    assert not shown.detected[100, 1, 6]
    assert 0 < shown.weights[100, 1, 6] < shown.weights[90, 1, 6]


def test_weights_grow_with_the_views_that_agree() -> None:
    points, keypoints = walked()
    hidden = keypoints.copy()
    hidden[:, 2:, 5] = np.nan
    few, many = (
        accept(*filmed(points, seen), SIZES, "reprojections").weights[:, 0, 5]
        for seen in (hidden, keypoints)
    )
    assert np.median(few) == pytest.approx(np.median(many) * (1 - 1 / 4) / (1 - 1 / 16), rel=0.05)
    hidden[:, 1, 5] = np.nan  # one view alone: that point has no place for the others
    alone = accept(*filmed(points, hidden), SIZES, "reprojections").weights
    assert (alone[:, 1:, 5] == 0).all()
    assert (alone[:, 0, 5] > 0).mean() > 0.99


def test_what_is_outside_the_image_is_no_label() -> None:
    points, keypoints = walked()
    film, evidence = filmed(points, keypoints)
    narrow: list[tuple[int, int] | None] = [(640, 1024), None, None, None]
    shown = accept(film, evidence, narrow, "reprojections")
    assert np.nanmax(shown.keypoints[:, 0, :, 0]) <= 639
    assert (shown.weights[:, 1] > 0).mean() > 0.99


def test_labels_of_a_late_view_are_of_its_own_frames() -> None:
    points, keypoints = walked(late=6.5)
    frames = np.repeat(np.arange(float(FRAMES))[:, None], 4, axis=1)
    frames[:, 3] += 6.5
    frames[frames > FRAMES - 1] = np.nan
    film, evidence = filmed(points, keypoints, frames=frames)
    shown = accept(film, evidence, SIZES, "reprojections")
    off = np.linalg.norm(shown.keypoints - keypoints, axis=-1)[:, 3]
    assert np.isnan(off[:6]).all()  # before the others began
    assert np.nanmedian(off[8:]) < 2.0
    assert np.isfinite(off[8:]).mean() > 0.99
    assert walk(np.array([40.0])).shape[1] == off.shape[1]


def test_views_that_judged_outliers_weigh_less() -> None:
    points, keypoints = walked()
    judged = np.zeros(keypoints.shape[:3], np.float32)
    judged[:, 0, 0] = 0.4
    judged[:, 0, 1] = 0.6
    found = {"outlier_probability": judged}
    weights = accept(*filmed(points, keypoints, found=found), SIZES, "keypoints").weights[:, 0]
    usual = np.median(weights[:, 2])
    assert np.median(weights[:, 0]) == pytest.approx(0.6 * usual, rel=0.05)
    assert (weights[:, 1] == 0).all()
