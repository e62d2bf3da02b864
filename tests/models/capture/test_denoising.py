"""Denoising, against keypoints whose noise is known because it was added."""

import numpy as np
import pytest
import torch

from models.capture.denoising import LEAST_FRAMES, Denoiser, learn_denoiser
from models.capture.metrics import pa_mpjpe
from models.capture.observations import as_observations
from models.capture.principal_curves import no_curves
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from models.training.trainer import fit
from tests.models.rigs import Float64

FRAMES, VIEWS, KEYPOINTS, MODES = 400, 2, 12, 5
NOISE = 15.0


@pytest.fixture(scope="module")
def clean() -> Float64:
    """Keypoints (N, K, P, 2) that a few modes explain."""
    rng = np.random.default_rng(1)
    size = VIEWS * KEYPOINTS * 2
    modes = rng.normal(size=(FRAMES, MODES)) @ rng.normal(0, 40, (MODES, size))
    return (modes + rng.uniform(100, 500, size)).reshape(FRAMES, VIEWS, KEYPOINTS, 2)


@pytest.fixture(scope="module")
def noisy(clean: Float64) -> Float64:
    return clean + np.random.default_rng(2).normal(0, NOISE, clean.shape)


@pytest.fixture(scope="module")
def model(noisy: Float64) -> Denoiser:
    found = learn_denoiser(as_observations(noisy))
    assert found is not None
    return found


def root_mean_square(values: Float64) -> float:
    return float(np.sqrt(np.mean(values**2)))


def pixels(keypoints: Float64, model: Denoiser, views: list[int]) -> Float64:
    seen = model.denoise(as_observations(keypoints[:, views]), views)
    return np.asarray(
        seen.keypoints * seen.sizes[..., None, None] + seen.centres[..., None, :], np.float64
    )


def test_noise_and_modes_are_distinguished(model: Denoiser) -> None:
    assert root_mean_square(model.noise) == pytest.approx(NOISE, rel=0.03)
    assert model.noise == pytest.approx(NOISE, rel=0.1)
    assert model.basis.shape == (VIEWS, KEYPOINTS, 2, MODES)
    assert model.tails == 0


def test_the_noise_left_is_as_predicted(clean: Float64, noisy: Float64, model: Denoiser) -> None:
    left = np.sqrt(np.mean((pixels(noisy, model, [0, 1]) - clean) ** 2))
    # Five modes of 48 coordinates keep a third of the noise's standard deviation.
    assert left < 0.4 * NOISE
    assert model.remaining_noise == pytest.approx(left, rel=0.1)


def test_one_of_the_views_is_denoised_by_itself(
    clean: Float64, noisy: Float64, model: Denoiser
) -> None:
    left = np.sqrt(np.mean((pixels(noisy, model, [1]) - clean[:, [1]]) ** 2))
    assert left < 0.6 * NOISE


def test_gaps_stay_gaps_and_everything_else_is_denoised(clean: Float64, noisy: Float64) -> None:
    hidden = np.random.default_rng(3).random(clean.shape[:3]) < 0.2
    gappy = np.where(hidden[..., None], np.nan, noisy)
    model = learn_denoiser(as_observations(gappy))
    assert model is not None
    seen = model.denoise(as_observations(gappy), [0, 1])
    np.testing.assert_array_equal(seen.weights > 0, ~hidden)
    left = (pixels(gappy, model, [0, 1]) - clean)[~hidden]
    assert np.sqrt(np.mean(left**2)) < 0.5 * NOISE


def test_a_view_that_shows_nothing_changes_nothing(
    clean: Float64, noisy: Float64, model: Denoiser
) -> None:
    more = np.concatenate((noisy, np.full_like(noisy, np.nan)), 1)
    found = learn_denoiser(as_observations(more))
    assert found is not None
    left = root_mean_square(pixels(more, found, [0, 1, 2, 3])[:, :VIEWS] - clean)
    assert left < 1.05 * root_mean_square(pixels(noisy, model, [0, 1]) - clean)


def test_noise_of_each_keypoint_in_each_view_is_found(clean: Float64) -> None:
    rng = np.random.default_rng(9)
    levels = NOISE * np.exp(rng.normal(0, 0.5, clean.shape[1:3]))
    noisy = clean + levels[..., None] * rng.standard_normal(clean.shape)
    model = learn_denoiser(as_observations(noisy))
    assert model is not None
    np.testing.assert_allclose(model.noise, levels, rtol=0.15)
    left = pixels(noisy, model, [0, 1]) - clean
    # Those with least noise predict those with most.
    assert root_mean_square(left) < 0.3 * root_mean_square(noisy - clean)
    assert model.remaining_noise == pytest.approx(root_mean_square(left), rel=0.15)


def test_noise_with_heavy_tails_is_removed_better_than_by_squares(
    clean: Float64,
) -> None:
    rng = np.random.default_rng(10)
    tails = rng.chisquare(3, (*clean.shape[:3], 1)) / 3
    noisy = clean + NOISE / 2 * rng.standard_normal(clean.shape) / np.sqrt(tails)
    model = learn_denoiser(as_observations(noisy))
    assert model is not None
    left = root_mean_square(pixels(noisy, model, [0, 1]) - clean)
    gaussian = model._replace(tails=0.0)
    assert left < 0.85 * root_mean_square(pixels(noisy, gaussian, [0, 1]) - clean)


def test_clear_keypoints_are_left_alone(clean: Float64) -> None:
    rng = np.random.default_rng(4)
    assert learn_denoiser(as_observations(clean + rng.normal(0, 0.2, clean.shape))) is None


def test_detail_is_not_taken_for_noise(clean: Float64) -> None:
    """As with cameras that move: ever smaller components, none of them noise."""
    rng = np.random.default_rng(5)
    size = clean[0].size
    detail = rng.normal(size=(FRAMES, size)) * 60 * 0.9 ** np.arange(size)
    turned = detail @ np.linalg.qr(rng.normal(size=(size, size)))[0]
    assert learn_denoiser(as_observations(clean + turned.reshape(clean.shape))) is None


def test_fewer_frames_than_coordinates_are_enough() -> None:
    rng = np.random.default_rng(7)
    clean = rng.normal(size=(70, MODES)) @ rng.normal(0, 40, (MODES, 120)) + 500
    clean = clean.reshape(70, VIEWS, 30, 2)
    noisy = clean + rng.normal(0, NOISE, clean.shape)
    model = learn_denoiser(as_observations(noisy))
    assert model is not None
    assert root_mean_square(model.noise) == pytest.approx(NOISE, rel=0.05)
    assert np.sqrt(np.mean((pixels(noisy, model, [0, 1]) - clean) ** 2)) < 0.5 * NOISE


def test_very_few_frames_are_left_alone(noisy: Float64) -> None:
    assert learn_denoiser(as_observations(noisy[: LEAST_FRAMES - 1])) is None


def test_poses_that_come_back_improve_each_other() -> None:
    """One Gaussian for all frames could not do better than its exact posterior."""
    rng = np.random.default_rng(6)
    modes = rng.normal(size=(5, MODES))[rng.integers(5, size=FRAMES)]
    axes = np.linalg.qr(rng.normal(size=(VIEWS * KEYPOINTS * 2, MODES)))[0].T
    poses = 200 * modes @ axes + rng.uniform(100, 500, axes.shape[1])
    clean = poses.reshape(FRAMES, VIEWS, KEYPOINTS, 2)
    noisy = clean + rng.normal(0, NOISE, clean.shape)
    model = learn_denoiser(as_observations(noisy))
    assert model is not None
    left = np.mean((pixels(noisy, model, [0, 1]) - clean) ** 2)
    signal = np.linalg.eigvalsh(np.cov(poses.T, bias=True))
    gaussian = (signal * NOISE**2 / (signal + NOISE**2)).sum() / poses.shape[1]
    assert left < 0.3 * gaussian


def test_frames_unlike_the_fit_are_not_harmed(clean: Float64, model: Denoiser) -> None:
    """What they do that no frame of the fit did is kept, if it stands out from the noise."""
    rng = np.random.default_rng(8)
    for size in (0.5, 1.0, 2.0, 4.0):  # of what is new, in the noise
        new = clean + size * NOISE * rng.standard_normal(clean.shape[1:])
        noisy = new + rng.normal(0, NOISE, new.shape)
        left = np.sqrt(np.mean((pixels(noisy, model, [0, 1]) - new) ** 2))
        assert left < NOISE


def test_a_fit_stores_it_and_lifts_with_it(noisy: Float64) -> None:
    quick = FitConfig(steps=30, dictionary_sizes=(16, 8), batch_size=8, refine="off")
    prior = fit(noisy, quick)
    again = FittedPrior.from_bytes(prior.to_bytes())
    np.testing.assert_array_equal(again.lift(noisy).points3d, prior.lift(noisy).points3d)
    plain = fit(noisy, quick.model_copy(update={"denoising": False}))
    assert plain.lift(noisy).reprojection_errors.mean() > NOISE / 2
    # A view that is named is denoised; of one that is not nothing is known.
    named, unknown = prior.lift(noisy[:, :1], views=[0]), prior.lift(noisy[:, :1])
    np.testing.assert_array_equal(plain.lift(noisy).keypoints_used, 12)
    assert pa_mpjpe(named.points3d, unknown.points3d).mean > 0.01


def test_a_file_of_before_is_read(noisy: Float64, model: Denoiser) -> None:
    """Noise was the same for all keypoints then, and Gaussian, and there were no curves."""
    arrays = model.to_arrays()
    for name in ("tails", "curves_points", "curves_heights", "curves_share"):
        del arrays[name]
    arrays["noise"] = torch.tensor([NOISE], dtype=torch.float64)
    assert {name: value.ndim for name, value in arrays.items()} == {
        name: len(shape) for name, shape in Denoiser.shapes(KEYPOINTS, "mixture").items()
    }
    before = Denoiser.from_arrays(arrays)
    like_it = model._replace(
        noise=np.full((VIEWS, KEYPOINTS), NOISE), curves=no_curves(VIEWS, KEYPOINTS)
    )
    np.testing.assert_array_equal(pixels(noisy, before, [0, 1]), pixels(noisy, like_it, [0, 1]))


@pytest.mark.parametrize("name", ["heights", "centres", "precisions", "basis", "noise"])
def test_a_file_that_contradicts_itself_is_refused(model: Denoiser, name: str) -> None:
    arrays = model.to_arrays()
    arrays[name] = arrays[name][..., :-1]
    with pytest.raises(WeightsError, match="noise"):
        Denoiser.from_arrays(arrays)
