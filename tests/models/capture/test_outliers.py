"""Outliers, against those that were planted."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import multivariate_t

from models.capture.observations import as_observations, pixels_of
from models.capture.outlier_kernels import FAR, MOST_LEVERAGE
from models.capture.outliers import (
    FIRST_NOISE,
    JUDGING_ROUNDS,
    LEAST_FRAMES,
    OutlierJudge,
    OutlierModel,
    learn_outliers,
)
from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.numerics.medians import MEDIAN_OF_SQUARES
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from models.settings.keypoints import OUTLIER
from models.training.trainer import fit
from tests.models.rigs import Float64
from tests.tiers import thorough_after

Bool = NDArray[np.bool_]

FRAMES, VIEWS, SIDE = 300, 3, 1000.0
SHARE = 0.08


class Harmed(NamedTuple):
    keypoints: Float64  # (N, K, P, 2)
    planted: Bool  # (N, K, P)


def harm(clean: Float64, share: float = SHARE) -> Harmed:
    """Let a share of the keypoints lie anywhere in the image."""
    rng = np.random.default_rng(1)
    planted = rng.random(clean.shape[:3]) < share
    anywhere = rng.uniform(0, SIDE, clean.shape)
    return Harmed(np.where(planted[..., None], anywhere, clean), planted)


@pytest.fixture(scope="module")
def clean() -> Float64:
    """Of moving cameras, with half a pixel of noise."""
    keypoints = synthetic_capture(frames=FRAMES, views=VIEWS, seed=1).keypoints.astype(np.float64)
    return keypoints + np.random.default_rng(2).normal(0, 0.5, keypoints.shape)


@pytest.fixture(scope="module")
def harmed(clean: Float64) -> Harmed:
    return harm(clean)


@pytest.fixture(scope="module")
def model(harmed: Harmed) -> OutlierModel:
    found = learn_outliers(as_observations(harmed.keypoints))
    assert found is not None
    return found


def found_in(model: OutlierModel, keypoints: Float64, views: tuple[int, ...] = (0, 1, 2)) -> Bool:
    judge = OutlierJudge(model, views)
    return np.asarray(judge.probabilities(as_observations(keypoints[:, views])) > 0.5)


def check(found: Bool, planted: Bool) -> None:
    """Ask for most of them: what lies near where the keypoint might be is hard to recognise."""
    assert (found & planted).sum() > 0.95 * found.sum()
    assert (found & planted).sum() > 0.85 * planted.sum()


def test_planted_outliers_are_found(model: OutlierModel, harmed: Harmed) -> None:
    check(found_in(model, harmed.keypoints), harmed.planted)
    assert model.share == pytest.approx(SHARE, rel=0.2)


def test_tails_are_those_of_the_noise(clean: Float64) -> None:
    """So what Gaussian noise would hardly do is an outlier, and what heavier tails do is none."""
    rng = np.random.default_rng(8)
    gaussian = 12 * rng.standard_normal(clean.shape)
    heavy = gaussian / np.sqrt(rng.chisquare(3, clean.shape[:3]) / 3)[..., None]
    models = [learn_outliers(as_observations(clean + noise)) for noise in (gaussian, heavy)]
    assert models[0] is not None
    assert models[1] is not None
    assert models[0].freedom > models[1].freedom
    off = clean + gaussian
    off[::5, 1, 3, 0] += 15 * models[0].scales[1, 3]
    as_heavy = models[0]._replace(freedom=models[1].freedom)
    found, missed = (found_in(model, off) for model in (models[0], as_heavy))
    assert found[::5, 1, 3].mean() > missed[::5, 1, 3].mean() + 0.2
    assert found[1::5].mean() < 0.005
    assert found_in(models[1], clean + heavy).mean() < 0.005


def test_a_keypoint_that_lies_apart_is_no_outlier() -> None:
    """Of a mouse: nose, ears and the base of its tail."""
    rng = np.random.default_rng(4)
    turns = rng.uniform(0, 2 * np.pi, FRAMES)
    body = np.array([[0, 0], [-12, 9], [-12, -9], [-90, 0]], float)
    ahead = np.stack((np.cos(turns), np.sin(turns)), -1)
    aside = np.stack((-ahead[:, 1], ahead[:, 0]), -1)
    view = body[None, :, :1] * ahead[:, None] + body[None, :, 1:] * aside[:, None]
    keypoints = 500 + np.stack((view, 0.8 * view[..., ::-1]), 1)
    keypoints += rng.normal(0, 0.5, keypoints.shape)
    model = learn_outliers(as_observations(keypoints))
    assert model is not None
    assert found_in(model, keypoints, (0, 1)).mean() < 0.005


def test_a_view_that_shows_nothing_hides_no_outliers(harmed: Harmed) -> None:
    keypoints, planted = harmed.keypoints[:100], harmed.planted[:100]
    nothing = np.full_like(keypoints[:, :2], np.nan)
    found = []
    for seen in (keypoints, np.concatenate((keypoints, nothing), 1)):
        model = learn_outliers(as_observations(seen))
        assert model is not None
        found.append(found_in(model, seen, tuple(range(seen.shape[1]))))
    assert (found[1][:, :VIEWS] & planted).sum() > 0.9 * (found[0] & planted).sum()
    assert found[1].sum() < 1.05 * (found[1][:, :VIEWS] & planted).sum()


def test_outliers_are_found_beside_gaps(clean: Float64) -> None:
    keypoints, planted = harm(clean)
    hidden = np.random.default_rng(3).random(planted.shape) < 0.2
    keypoints = np.where(hidden[..., None], np.nan, keypoints)
    model = learn_outliers(as_observations(keypoints))
    assert model is not None
    found = found_in(model, keypoints)
    assert not found[hidden].any()
    check(found, planted & ~hidden)


def expected(model: OutlierModel, offsets: Float64, noise: float, used: Bool) -> Float64:
    """Return how probably keypoints (V,) are outliers, from the inverse of their covariance.

    Parameters
    ----------
    offsets, used
        (V, 2) from the mean, NaN where not observed; which of them (V,) are predicted from.
    """
    basis = model.basis.reshape(offsets.size, -1)
    covariance = basis @ basis.T + noise**2 * np.eye(offsets.size)
    y, given = offsets.ravel(), np.repeat(used, 2)
    inverse = np.linalg.inv(covariance[np.ix_(given, given)])
    squared = np.full(len(y), np.nan)
    own = np.diag(inverse)  # what is used is predicted from the others that are
    residuals, leverage = (inverse @ y[given]) / own, 1 - noise**2 * own
    squared[given] = (residuals * noise**2 * own) ** 2 / (1 - leverage.clip(max=MOST_LEVERAGE))
    rest = covariance[np.ix_(~given, given)] @ inverse
    variance = np.diag(covariance)[~given] - (rest * covariance[np.ix_(~given, given)]).sum(1)
    missed = y[~given] - rest @ y[given]
    squared[~given] = missed**2 / (1 + (variance / noise**2 - 1).clip(max=1))
    errors = squared.reshape(-1, 2).sum(1)
    variances = model.scales.ravel() ** 2
    seen = np.isfinite(errors)
    middle = np.sort((errors / variances)[seen])[(seen.sum() - 1) // 2]
    half = 2 * f_distribution(2, model.freedom).median()  # of squared errors of variance 1
    spread = variances * max(middle, MEDIAN_OF_SQUARES) / half
    inlying = [
        multivariate_t(shape=v * np.eye(2), df=int(model.freedom)).pdf([np.sqrt(e), 0])
        if there
        else np.nan
        for e, v, there in zip(errors, spread, seen, strict=True)
    ]
    anywhere = model.share / np.repeat(model.sides, model.scales.shape[1]) ** 2
    return np.asarray(anywhere / (anywhere + (1 - model.share) * np.array(inlying)))


def expected_in_frame(model: OutlierModel, pixels: Float64) -> Float64:
    """Return how probably keypoints (K, P) of a frame are outliers, by the formula in the docs."""
    offsets = (pixels - model.mean).reshape(-1, 2)
    seen = np.isfinite(offsets[:, 0])
    first = FIRST_NOISE * model.sides.mean()
    coarse, fine = (expected(model, offsets, noise, seen) for noise in (first, model.noise))
    if not (np.fmax(coarse, fine) > 0.5).any():
        return fine.reshape(model.scales.shape)
    middle = np.nanquantile(pixels, 0.5, axis=1, keepdims=True, method="lower")
    distances = np.linalg.norm(pixels - middle, axis=-1)
    usual = np.nanquantile(distances, 0.5, axis=1, keepdims=True, method="lower")
    used = seen & ~(distances > FAR * usual).ravel()
    for noise in np.geomspace(first, model.noise, JUDGING_ROUNDS):
        found = expected(model, offsets, noise, used)
        used = seen & (found < 0.5)
    return found.reshape(model.scales.shape)


@pytest.mark.filterwarnings("ignore:All-NaN slice")
@pytest.mark.parametrize("views", thorough_after(1, [((0, 1, 2),), ((2, 0),)]))
def test_probabilities_are_those_of_the_model(
    model: OutlierModel, harmed: Harmed, clean: Float64, views: tuple[int, ...]
) -> None:
    """Predicted with the inverse of the covariance of all coordinates, without compiled code."""
    some, more = harmed.keypoints[:8], harmed.keypoints[8:24]
    frames = np.concatenate((some, some, clean[:8], more))
    hidden = np.random.default_rng(6).random(frames.shape[:3]) < 0.15
    hidden[:4] = hidden[16:20] = False  # these show everything
    hidden[7, 1:] = True  # and this but one view
    hidden[7, 0] = False
    observations = as_observations(np.where(hidden[..., None], np.nan, frames)[:, views])
    pixels, observed = pixels_of(observations)
    pixels[~observed] = np.nan
    chosen = model._replace(
        mean=model.mean[list(views)],
        basis=model.basis[list(views)],
        scales=model.scales[list(views)],
        sides=model.sides[list(views)],
    )
    truth = np.stack([expected_in_frame(chosen, frame) for frame in pixels])
    assert ((truth > 1e-3) & (truth < 1 - 1e-3)).sum() > 10  # not all is certain
    judged = OutlierJudge(model, views).probabilities(observations)
    np.testing.assert_allclose(judged, truth, rtol=1e-7, atol=1e-12)


def test_keypoints_that_are_not_observed_have_no_probability(
    model: OutlierModel, clean: Float64
) -> None:
    keypoints = clean[:3].copy()
    keypoints[0] = np.nan
    keypoints[1, 2, 4] = np.nan
    judged = OutlierJudge(model, (0, 1, 2)).probabilities(as_observations(keypoints))
    np.testing.assert_array_equal(np.isnan(judged), np.isnan(keypoints).any(-1))


def test_frames_are_judged_each_on_its_own(model: OutlierModel, harmed: Harmed) -> None:
    together = found_in(model, harmed.keypoints)
    alone = [found_in(model, frame[None])[0] for frame in harmed.keypoints[:20]]
    np.testing.assert_array_equal(alone, together[:20])


def test_some_of_the_views_are_judged_by_themselves(model: OutlierModel, harmed: Harmed) -> None:
    found = found_in(model, harmed.keypoints, (2, 0))
    planted = harmed.planted[:, [2, 0]]
    assert (found & planted).sum() > 0.9 * found.sum()
    assert (found & planted).sum() > 0.6 * planted.sum()


def test_clear_keypoints_have_none(clean: Float64) -> None:
    model = learn_outliers(as_observations(clean))
    assert model is not None
    assert found_in(model, clean).mean() < 0.001


def test_frames_unlike_those_of_the_fit_have_none(model: OutlierModel, clean: Float64) -> None:
    """Where all keypoints are elsewhere, none of them stands out."""
    rng = np.random.default_rng(4)
    scattered = clean[:50] + rng.normal(0, 40, clean[:50].shape)
    assert found_in(model, scattered).mean() < 0.01


def test_few_frames_are_not_judged(harmed: Harmed) -> None:
    assert learn_outliers(as_observations(harmed.keypoints[: LEAST_FRAMES - 1])) is None


def test_keypoints_that_stand_still_are_learnt_too() -> None:
    still = np.tile(np.random.default_rng(5).uniform(0, 100, (1, 2, 6, 2)), (50, 1, 1, 1))
    model = learn_outliers(as_observations(still))
    assert model is not None
    assert not OutlierJudge(model, [0, 1]).probabilities(as_observations(still)).round().any()


def test_a_fit_leaves_them_out_and_so_do_its_lifts(harmed: Harmed) -> None:
    quick = FitConfig(steps=30, dictionary_sizes=(16, 8), batch_size=8, refine="off")
    prior = fit(harmed.keypoints, quick)
    (finding,) = (found for found in prior.findings if found.code == "outliers")
    assert finding.views == (0, 1, 2)
    assert finding.evidence["share"] == pytest.approx(SHARE, rel=0.2)
    lift = prior.lift(harmed.keypoints)
    shown = (~harmed.planted).sum((1, 2))
    assert np.abs(lift.keypoints_used.sum(1) - shown).mean() < 1
    found = lift.outlier_probability > OUTLIER
    check(found, harmed.planted)
    np.testing.assert_array_equal(lift.keypoints_used, (~found).sum(-1))
    alone = prior.lift(harmed.keypoints[:5, [1]], views=[1]).outlier_probability
    assert np.isfinite(alone).all()
    assert np.isnan(prior.lift(harmed.keypoints[:5, [1]]).outlier_probability).all()  # unknown
    again = FittedPrior.from_bytes(prior.to_bytes())
    np.testing.assert_array_equal(again.lift(harmed.keypoints).points3d, lift.points3d)
    keeping = fit(harmed.keypoints, quick.model_copy(update={"outlier_rejection": False}))
    assert not [found for found in keeping.findings if found.code == "outliers"]
    kept = keeping.lift(harmed.keypoints)
    assert (kept.keypoints_used == harmed.planted.shape[2]).all()
    assert np.isnan(kept.outlier_probability).all()


@pytest.mark.parametrize("name", ["basis", "scales", "sides"])
def test_a_file_that_contradicts_itself_is_refused(model: OutlierModel, name: str) -> None:
    arrays = model.to_arrays()
    arrays[name] = arrays[name][:-1]
    with pytest.raises(WeightsError, match="outliers"):
        OutlierModel.from_arrays(arrays)
