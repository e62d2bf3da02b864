"""A lens that is known roughly counts with its own standard deviation, wherever it enters."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from models.bundle.problem import FOCAL, VIEW
from models.calibrating.keypoint_rig import FOCAL_SD, lens_beliefs
from models.calibrating.lens_prior import FOCAL_SDS, rig_prior
from models.calibrating.lens_profile import SHARES, TO_LOGS, UNLIKE_SDS, kinds_of
from models.calibrating.problem import USUAL_FOCAL, CalibrationProblem, problem_of
from models.settings.config import FitConfig
from models.settings.lenses import Lens, known_lenses

Float64 = NDArray[np.float64]

SIZE = (1000, 800)
SD = 0.04
ONE_AND_ANOTHER = {"lenses": [Lens(focal=950.0, sd=SD), None]}
# Ways to give the first of two focal lengths.
WAYS = [
    ONE_AND_ANOTHER,
    {"lenses": [Lens(equivalent=35.0, sd=SD), None]},
    {"lenses": [Lens(field_of_view=50.0, sd=SD), None]},
    {"lenses": [Lens(same_as=1), Lens(focal=950.0, sd=SD)]},
    {"calibration": [{"intrinsics": {"fx": 950.0, "focal_sd": SD}}, None]},
]


def asked(**settings: object) -> CalibrationProblem:
    keypoints = np.random.default_rng(0).uniform(100, 700, (6, 2, 5, 2))
    config = FitConfig.model_validate(settings)
    return problem_of(keypoints, np.ones((6, 2, 5)), [SIZE, SIZE], config)


@pytest.mark.parametrize("way", WAYS)
def test_every_stage_starts_from_the_deviation_that_was_given(way: dict[str, object]) -> None:
    problem = asked(**way)
    assert problem.lens_sds[0, FOCAL] == SD
    assert lens_beliefs(problem).focal_sds[0] == pytest.approx(SD)
    prior = rig_prior(problem, problem.reference, given_poses=None)
    assert prior.precision[FOCAL, FOCAL] == pytest.approx(SD**-2)
    assert prior.free[FOCAL]


def test_a_lens_that_is_not_given_keeps_the_usual_deviation() -> None:
    problem = asked(**ONE_AND_ANOTHER)
    prior = rig_prior(problem, problem.reference, given_poses=None)
    usual = np.square(FOCAL_SDS).sum()
    assert prior.precision[VIEW + FOCAL, VIEW + FOCAL] == pytest.approx(1 / usual)
    assert lens_beliefs(problem).focal_sds[1] >= FOCAL_SD


def test_the_default_is_five_percent() -> None:
    (known,) = known_lenses([Lens(equivalent=26.0)], [SIZE])
    assert known is not None
    assert known.sd == 0.05


def usual_covariance(kind: int) -> Float64:
    """Return the covariance of two log focal lengths before any is given, alike or not."""
    together, alone = ((FOCAL_SD, FOCAL_SDS[1]), UNLIKE_SDS)[kind]
    return np.asarray(together**2 + alone**2 * np.eye(2))


@pytest.mark.parametrize("sds", [(0.05, None), (None, 0.02), (0.05, 0.2), (0.4, 0.4)])
def test_two_lenses_are_those_of_gaussian_observations(
    sds: tuple[float | None, float | None],
) -> None:
    """Precisions add, and the evidence of a kind is the density that it gave to the observations.

    Bishop, *Pattern Recognition and Machine Learning*, 2006, eq. 2.113 to 2.117.
    """
    logs = np.log([1.0, 1.35])  # sides
    lenses = [
        None if sd is None else Lens(focal=1000 * float(np.exp(log)), sd=sd)
        for log, sd in zip(logs, sds, strict=True)
    ]
    given = np.array([sd is not None for sd in sds])
    own = np.array([np.inf if sd is None else sd for sd in sds])
    kinds = kinds_of(asked(lenses=lenses))
    expected, shares = [], []
    for place in range(2):
        covariance, mean = usual_covariance(place), np.full(2, np.log(USUAL_FOCAL))
        information = np.linalg.inv(covariance)
        posterior = np.linalg.inv(information + np.diag(own**-2))
        observed = np.where(given, logs / own**2, 0.0)
        expected.append((posterior @ (information @ mean + observed), posterior))
        among = (covariance + np.diag(np.where(given, own, 0.0) ** 2))[np.ix_(given, given)]
        density = multivariate_normal(mean[given], among).pdf(logs[given])
        shares.append(SHARES[place] * density)
    assert len(kinds) == 2
    for kind, (mean, posterior), share in zip(kinds, expected, shares, strict=True):
        np.testing.assert_allclose(TO_LOGS @ kind.mean, mean, atol=1e-9)
        np.testing.assert_allclose(TO_LOGS @ kind.covariance @ TO_LOGS.T, posterior, atol=1e-9)
        assert kind.share == pytest.approx(share / sum(shares))


def test_a_lens_that_is_held_has_no_deviation() -> None:
    problem = asked(calibration=[{"intrinsics": {"fx": 950.0}}, None])
    assert problem.lens_sds[0, FOCAL] == 0
    assert lens_beliefs(problem).focal_sds[0] == 0
    assert not rig_prior(problem, problem.reference, given_poses=None).free[FOCAL]
    for kind in kinds_of(problem):
        logs, covariance = TO_LOGS @ kind.mean, TO_LOGS @ kind.covariance @ TO_LOGS.T
        assert logs[0] == pytest.approx(np.log(0.95))
        assert covariance[0, 0] == pytest.approx(0.0, abs=1e-9)
