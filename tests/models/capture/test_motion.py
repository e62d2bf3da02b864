"""Smoothing in time, against keypoints whose noise is known because it was added."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from models.capture.motion import LEAST_FRAMES, MotionModel, learn_motion
from models.capture.noise_removal import learn_noise_removal
from models.capture.observations import as_observations, pixels_of
from models.numerics.tensor_files import WeightsError
from tests.models.rigs import Float64

FRAMES, VIEWS, KEYPOINTS = 300, 2, 8
NOISE = 6.0
TIMES = np.arange(FRAMES) / 50


def film(times: Float64) -> Float64:
    """Keypoints (N, K, P, 2) that swing about with a few frequencies, at random places."""
    rng = np.random.default_rng(1)
    waves = np.sin(times[:, None] * rng.uniform(1, 6, 4) + rng.uniform(0, 6, 4))
    moves = waves @ rng.normal(0, 40, (4, VIEWS * KEYPOINTS * 2))
    return (moves + rng.uniform(100, 500, moves.shape[1])).reshape(FRAMES, VIEWS, KEYPOINTS, 2)


CLEAN = film(TIMES)
NOISY = CLEAN + np.random.default_rng(2).normal(0, NOISE, CLEAN.shape)


@pytest.fixture(scope="module")
def model() -> MotionModel:
    found = learn_motion(as_observations(NOISY), TIMES)
    assert found is not None
    return found


def left(model: MotionModel, keypoints: Float64, truth: Float64, times: Float64) -> float:
    """Return the noise that is left where something was observed."""
    seen, _ = model.smooth(as_observations(keypoints), times, range(keypoints.shape[1]))
    pixels, observed = pixels_of(seen)
    return float(np.sqrt(np.mean(np.square(pixels - truth)[observed])))


def test_noise_is_estimated_and_most_of_it_removed(model: MotionModel) -> None:
    assert np.sqrt(np.mean(model.noise**2)) == pytest.approx(NOISE, rel=0.03)
    remaining = left(model, NOISY, CLEAN, TIMES)
    assert remaining < 0.25 * NOISE
    assert model.left == pytest.approx(remaining, rel=0.25)


def test_every_keypoint_has_a_noise_of_its_own() -> None:
    levels = np.linspace(2, 10, KEYPOINTS)
    noise = np.random.default_rng(3).normal(size=CLEAN.shape) * levels[:, None]
    model = learn_motion(as_observations(CLEAN + noise), TIMES)
    assert model is not None
    np.testing.assert_allclose(model.noise, np.tile(levels, (VIEWS, 1)), rtol=0.2)


def test_times_need_not_be_even_and_frames_may_lack(model: MotionModel) -> None:
    kept = np.sort(np.random.default_rng(4).permutation(FRAMES)[: FRAMES * 2 // 3])
    assert left(model, NOISY[kept], CLEAN[kept], TIMES[kept]) < 0.3 * NOISE


def test_gaps_stay_gaps_and_everything_else_is_smoothed() -> None:
    hidden = np.random.default_rng(5).random(CLEAN.shape[:3]) < 0.1
    gappy = np.where(hidden[..., None], np.nan, NOISY)
    model = learn_motion(as_observations(gappy), TIMES)
    assert model is not None
    seen, _ = model.smooth(as_observations(gappy), TIMES, [0, 1])
    np.testing.assert_array_equal(seen.weights, as_observations(gappy).weights)
    assert left(model, gappy, CLEAN, TIMES) < 0.25 * NOISE


def test_one_of_the_views_is_smoothed_by_itself(model: MotionModel) -> None:
    seen, _ = model.smooth(as_observations(NOISY[:, [1]]), TIMES, [1])
    assert np.sqrt(np.mean(np.square(pixels_of(seen)[0] - CLEAN[:, [1]]))) < 0.3 * NOISE


def test_nothing_is_smoothed_across_a_cut_or_a_pause(model: MotionModel) -> None:
    elsewhere = CLEAN[150:250] + 700
    film_of_two = np.concatenate((CLEAN[:100], elsewhere))
    noisy = film_of_two + np.random.default_rng(6).normal(0, NOISE, film_of_two.shape)
    late = np.where(np.arange(200) < 100, 0, 60) + TIMES[:200]
    for times in (TIMES[:200], late):
        at_the_cut, _ = model.smooth(as_observations(noisy), times, [0, 1])
        pixels = pixels_of(at_the_cut)[0]
        before, _ = model.smooth(as_observations(noisy[:100]), times[:100], [0, 1])
        np.testing.assert_allclose(pixels[:100], pixels_of(before)[0], atol=1e-3)
        assert np.abs(pixels - film_of_two)[98:102].mean() < NOISE


def test_parts_of_a_capture_are_smoothed_alike(model: MotionModel) -> None:
    whole, _ = model.smooth(as_observations(NOISY), TIMES, [0, 1])
    part, _ = model.smooth(as_observations(NOISY[:250]), TIMES[:250], [0, 1])
    np.testing.assert_allclose(pixels_of(part)[0][:50], pixels_of(whole)[0][:50], atol=0.01 * NOISE)


def test_what_moves_in_a_new_way_is_not_smoothed_away(model: MotionModel) -> None:
    new = CLEAN.copy()
    new[100:150, :, 3, 0] += 60 * np.sin(np.arange(50) / 3)[:, None]
    noisy = new + np.random.default_rng(9).normal(0, NOISE, new.shape)
    seen, together = model.smooth(as_observations(noisy), TIMES, [0, 1])
    off = np.abs(pixels_of(seen)[0] - new)[100:150, :, 3]
    assert off.mean() < 2 * NOISE
    assert not together[105:145].any()
    assert together[:90].all()
    assert together[160:].all()


@pytest.mark.parametrize(
    ("keypoints", "times"),
    [
        pytest.param(CLEAN, TIMES, id="clear keypoints"),
        pytest.param(NOISY[: LEAST_FRAMES - 1], TIMES[: LEAST_FRAMES - 1], id="few frames"),
        pytest.param(
            CLEAN
            + (NOISY - CLEAN) * np.where(np.arange(FRAMES) % 100 < 10, 6, 1)[:, None, None, None],
            TIMES,
            id="noise that comes and goes",
        ),
        pytest.param(NOISY, np.arange(FRAMES) ** 5 * 1.0, id="pauses between all frames"),
        pytest.param(
            NOISY[np.random.default_rng(8).permutation(FRAMES)], TIMES, id="frames of no film"
        ),
    ],
)
def test_where_it_is_of_no_use_nothing_is_smoothed(keypoints: Float64, times: Float64) -> None:
    assert learn_motion(as_observations(keypoints), times) is None


def test_frames_without_neighbours_are_denoised_by_themselves() -> None:
    removal = learn_noise_removal(as_observations(NOISY), TIMES)
    assert removal.motion is not None
    assert removal.denoiser is not None
    seen = as_observations(NOISY)
    apart = removal.remove(seen, [0, 1], 60.0 * np.arange(FRAMES, dtype=np.float64))
    alone = removal.denoiser.denoise(seen, [0, 1])
    np.testing.assert_array_equal(apart.keypoints, alone.keypoints)


def test_a_file_that_contradicts_itself_is_refused(model: MotionModel) -> None:
    arrays = model.to_arrays()
    again = MotionModel.from_arrays(arrays)
    np.testing.assert_array_equal(again.covariance, model.covariance)
    damaged: tuple[tuple[str, ArrayLike], ...] = (("noise", model.noise[:1]), ("step", [0.0]))
    for name, value in damaged:
        wrong = arrays | {name: arrays[name].new_tensor(np.asarray(value))}
        with pytest.raises(WeightsError, match="contradicts itself"):
            MotionModel.from_arrays(wrong)
