"""Outliers, against those that were planted."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from models.capture.observations import as_observations
from models.capture.outliers import LEAST_FRAMES, OutlierJudge, OutlierModel, learn_outliers
from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from models.training.trainer import fit
from tests.models.rigs import Float64

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
    """Ask for most of them: what lies near where the keypoint might be is hard to tell."""
    assert (found & planted).sum() > 0.95 * found.sum()
    assert (found & planted).sum() > 0.85 * planted.sum()


def test_planted_outliers_are_found(model: OutlierModel, harmed: Harmed) -> None:
    check(found_in(model, harmed.keypoints), harmed.planted)
    assert model.share == pytest.approx(SHARE, rel=0.2)


def test_outliers_are_found_beside_gaps(clean: Float64) -> None:
    keypoints, planted = harm(clean)
    hidden = np.random.default_rng(3).random(planted.shape) < 0.2
    keypoints = np.where(hidden[..., None], np.nan, keypoints)
    model = learn_outliers(as_observations(keypoints))
    assert model is not None
    found = found_in(model, keypoints)
    assert not found[hidden].any()
    check(found, planted & ~hidden)


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


def test_few_frames_say_nothing(harmed: Harmed) -> None:
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
    again = FittedPrior.from_bytes(prior.to_bytes())
    np.testing.assert_array_equal(again.lift(harmed.keypoints).points3d, lift.points3d)
    keeping = fit(harmed.keypoints, quick.model_copy(update={"outlier_rejection": False}))
    assert not [found for found in keeping.findings if found.code == "outliers"]
    assert (keeping.lift(harmed.keypoints).keypoints_used == harmed.planted.shape[2]).all()


@pytest.mark.parametrize("name", ["basis", "scales", "sides"])
def test_a_file_that_contradicts_itself_is_refused(model: OutlierModel, name: str) -> None:
    arrays = model.to_arrays()
    arrays[name] = arrays[name][:-1]
    with pytest.raises(WeightsError, match="outliers"):
        OutlierModel.from_arrays(arrays)
