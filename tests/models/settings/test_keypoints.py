import re

import numpy as np
import pytest

from models.capture.observations import as_observations


def _views(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1000, (*shape, 2)).astype(np.float32)


def test_views_are_centred_sized_and_recoverable() -> None:
    pixels = _views(3, 2, 7)
    pixels[0, 1, 2] = np.nan
    seen = as_observations(pixels)
    assert seen.weights[0, 1].tolist() == [1, 1, 0, 1, 1, 1, 1]
    observed = np.delete(seen.keypoints[0, 1], 2, axis=0)
    np.testing.assert_allclose(observed.mean(0), 0, atol=1e-6)
    assert np.square(observed).sum(-1).mean() == pytest.approx(1, rel=1e-5)
    back = seen.keypoints * seen.sizes[..., None, None] + seen.centres[:, :, None]
    np.testing.assert_allclose(back[seen.weights > 0], pixels[seen.weights > 0], atol=1e-3)


def test_confidence_weights_the_centre_and_zero_hides() -> None:
    pixels = _views(1, 1, 6)
    confidence = np.array([1, 0.5, 0.25, 0, np.nan, 1], np.float32)[None, None]
    seen = as_observations(pixels, confidence)
    weights = np.nan_to_num(confidence)[0, 0]
    np.testing.assert_allclose(seen.weights[0, 0], weights)
    expected = np.average(pixels[0, 0], axis=0, weights=weights)
    np.testing.assert_allclose(seen.centres[0, 0], expected, rtol=1e-5)
    moved = pixels.copy()
    moved[0, 0, 3:5] = 9999  # what has no confidence is not looked at
    np.testing.assert_array_equal(as_observations(moved, confidence).keypoints, seen.keypoints)


@pytest.mark.parametrize("case", ["all hidden", "three keypoints", "one place"])
def test_views_that_show_no_shape_are_not_usable(case: str) -> None:
    pixels = _views(1, 2, 6)
    if case == "all hidden":
        pixels[0, 0] = np.nan
    elif case == "three keypoints":
        pixels[0, 0, 3:, 0] = np.nan  # half a keypoint is none
    else:
        pixels[0, 0] = 512.0
    seen = as_observations(pixels)
    assert seen.usable.tolist() == [[False, True]]
    assert not seen.weights[0, 0].any()
    assert not seen.keypoints[0, 0].any()


@pytest.mark.parametrize(
    ("keypoints", "confidence", "message"),
    [
        (np.zeros((4, 6, 2)), None, "got (4, 6, 2)"),
        (np.zeros((4, 1, 6, 3)), None, "got (4, 1, 6, 3)"),
        (np.zeros((1, 0, 6, 2)), None, "1 to 64 views, got 0"),
        (np.zeros((1, 1, 3, 2)), None, "at least 4 keypoints per view, got 3"),
        (np.full((1, 1, 6, 2), np.inf), None, "write NaN"),
        (np.full((1, 1, 6, 2), 1e7), None, "within 1e+06 pixels"),
        ([[[[1, 2], [3]]]], None, "array of numbers"),
        (np.zeros((1, 1, 6, 2)), np.ones((1, 6)), "expected"),
        (np.zeros((1, 1, 6, 2)), np.full((1, 1, 6), 100.0), "lie in [0, 1], got 100 to 100; clip"),
    ],
)
def test_errors_name_what_was_given(keypoints: object, confidence: object, message: str) -> None:
    if message == "expected":
        message = "(frames, views, keypoints) = (1, 1, 6)"
    with pytest.raises(ValueError, match=re.escape(message)):
        as_observations(keypoints, confidence)  # type: ignore[arg-type]
