"""Curves through poses, on a film whose frames are shuffled, and against sums written out."""

import numpy as np
import pytest
from scipy.special import softmax

from models.capture.denoising import Denoiser, learn_denoiser
from models.capture.heavy_tails import learn_tails
from models.capture.observations import as_observations
from models.capture.principal_curves import expect_on_curves_into, learn_curves, no_curves
from models.numerics.tensor_files import WeightsError
from tests.models.rigs import Float64

FRAMES, VIEWS, KEYPOINTS = 600, 2, 10
NOISE = 12.0


@pytest.fixture(scope="module")
def clean() -> Float64:
    """Keypoints (N, K, P, 2) that swing in many ways at once and never come back to a place."""
    rng = np.random.default_rng(1)
    size = VIEWS * KEYPOINTS * 2
    times = np.linspace(0, 1, FRAMES)[:, None]
    swings = np.sin(2 * np.pi * (times * rng.uniform(0.5, 3, 8) + rng.random(8)))
    ways = rng.normal(0, 30, (8, size)) * 0.8 ** np.arange(8)[:, None]
    film = swings @ ways + rng.uniform(100, 500, size)
    return np.asarray(rng.permutation(film).reshape(FRAMES, VIEWS, KEYPOINTS, 2))


@pytest.fixture(scope="module")
def noisy(clean: Float64) -> Float64:
    return clean + np.random.default_rng(2).normal(0, NOISE, clean.shape)


@pytest.fixture(scope="module")
def model(noisy: Float64) -> Denoiser:
    found = learn_denoiser(as_observations(noisy))
    assert found is not None
    return found


def left(truth: Float64, keypoints: Float64, model: Denoiser) -> float:
    """Root mean square of the noise that denoising leaves, pixels, of what was observed."""
    seen = model.denoise(as_observations(keypoints), range(VIEWS))
    pixels = seen.keypoints * seen.sizes[..., None, None] + seen.centres[..., None, :]
    there = np.isfinite(keypoints).all(-1)
    return float(np.sqrt(np.square(pixels - truth)[there].mean()))


def without_curves(model: Denoiser) -> Denoiser:
    return model._replace(curves=no_curves(VIEWS, KEYPOINTS))


def test_a_shuffled_film_is_denoised_better_with_curves(
    clean: Float64, noisy: Float64, model: Denoiser
) -> None:
    assert 0.5 < model.curves.share <= 1
    assert left(clean, noisy, model) < 0.9 * left(clean, noisy, without_curves(model))


def test_so_are_its_frames_with_gaps(clean: Float64, noisy: Float64) -> None:
    hidden = np.random.default_rng(3).random(clean.shape[:3]) < 0.15
    gappy = np.where(hidden[..., None], np.nan, noisy)
    model = learn_denoiser(as_observations(gappy))
    assert model is not None
    assert left(clean, gappy, model) < 0.9 * left(clean, gappy, without_curves(model))


def test_so_are_errors_with_heavy_tails(clean: Float64) -> None:
    rng = np.random.default_rng(4)
    tails = np.sqrt(rng.chisquare(3, (*clean.shape[:3], 1)) / 3)
    noisy = clean + NOISE / 2 * rng.standard_normal(clean.shape) / tails
    model = learn_denoiser(as_observations(noisy))
    assert model is not None
    assert model.tails > 0
    assert left(clean, noisy, model) < 0.9 * left(clean, noisy, without_curves(model))
    assert left(clean, noisy, model) < 0.95 * left(clean, noisy, model._replace(tails=0.0))


def test_what_is_learnt_does_not_depend_on_the_order_of_the_frames(
    noisy: Float64, model: Denoiser
) -> None:
    order = np.random.default_rng(5).permutation(FRAMES)
    shuffled = learn_denoiser(as_observations(noisy[order]))
    assert shuffled is not None
    for name, array in model.to_arrays().items():
        np.testing.assert_array_equal(array, shuffled.to_arrays()[name], err_msg=name)


def test_poses_that_follow_no_curve_are_left_to_the_mixture() -> None:
    rng = np.random.default_rng(6)
    size = VIEWS * KEYPOINTS * 2
    clean = rng.normal(size=(FRAMES, 6)) @ rng.normal(0, 40, (6, size)) + 300
    clean = clean.reshape(FRAMES, VIEWS, KEYPOINTS, 2)
    noisy = clean + rng.normal(0, NOISE, clean.shape)
    model = learn_denoiser(as_observations(noisy))
    assert model is not None
    assert model.curves.share < 0.2
    assert left(clean, noisy, model) < 1.03 * left(clean, noisy, without_curves(model))


@pytest.mark.parametrize("tails", [0.0, 0.25])
def test_what_is_expected_is_the_mean_of_probable_points(tails: float) -> None:
    rng = np.random.default_rng(7)
    points, heights = rng.normal(0, 2, (8, 30)), rng.normal(size=30)
    rows = np.array([2, 3, 6, 7])
    offsets = rng.normal(0, 3, (20, 4))
    observed = np.repeat(rng.random((20, 2)) < 0.7, 2, axis=1)
    found = np.empty((20, 4))
    expect_on_curves_into(points, heights, rows, offsets, observed, tails, found)
    for offset, seen, mean in zip(offsets, observed, found, strict=True):
        clipped = offset.copy()
        for _ in range(4 if tails else 1):
            squares = np.square(clipped - points[rows].T)[:, seen].sum(1)
            expected = softmax(heights - squares / 2) @ points[rows].T
            # The score of Student's t of two coordinates, over that of a Gaussian.
            residuals = (offset - expected).reshape(2, 2)
            factor = (1 + 2 * tails) / (1 + tails * np.square(residuals).sum(1, keepdims=True))
            clipped = expected + (residuals * np.minimum(factor, 1)).ravel()
        np.testing.assert_allclose(mean, expected, atol=1e-9)


def test_too_few_frames_are_on_no_curve() -> None:
    few = np.random.default_rng(8).normal(size=(12, 20))
    assert learn_curves(few, few, 2) is None


def test_degrees_of_freedom_of_errors_are_found() -> None:
    rng = np.random.default_rng(9)
    errors = np.square(rng.standard_normal((50_000, 2))).sum(1)
    assert learn_tails(errors) == 0
    heavy = errors / (rng.chisquare(5, 50_000) / 5)
    assert learn_tails(heavy) == pytest.approx(1 / 5, rel=0.25)


def test_a_file_without_curves_is_read(noisy: Float64, model: Denoiser) -> None:
    arrays = {n: a for n, a in model.to_arrays().items() if not n.startswith("curves_")}
    assert set(arrays) == set(Denoiser.shapes(KEYPOINTS, "levels"))
    before = Denoiser.from_arrays(arrays)
    expected = without_curves(model).denoise(as_observations(noisy), range(VIEWS))
    found = before.denoise(as_observations(noisy), range(VIEWS))
    np.testing.assert_array_equal(found.keypoints, expected.keypoints)


def test_curves_come_back_from_a_file_as_they_were(model: Denoiser) -> None:
    again = Denoiser.from_arrays(model.to_arrays())
    for before, after in zip(model.curves, again.curves, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("name", ["curves_points", "curves_heights"])
def test_curves_that_contradict_themselves_are_refused(model: Denoiser, name: str) -> None:
    arrays = model.to_arrays()
    arrays[name] = arrays[name][..., :-1]
    with pytest.raises(WeightsError, match="curves"):
        Denoiser.from_arrays(arrays)


def test_curves_with_a_share_that_is_none_are_refused(model: Denoiser) -> None:
    arrays = model.to_arrays()
    arrays["curves_share"] = arrays["curves_share"] + 1
    with pytest.raises(WeightsError, match="curves"):
        Denoiser.from_arrays(arrays)
