"""The posterior of two lenses, where it has a closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from models.calibrating.lens_posterior import SHAPE_SDS, interpolated, posterior_of
from models.calibrating.lens_profile import (
    FROM_LOGS,
    TO_LOGS,
    Kind,
    Place,
    Walk,
    kinds_of,
)
from models.calibrating.problem import CalibrationProblem, problem_of
from models.epipolar.rig_adjustment import AdjustedRig
from models.epipolar.static_cameras import StaticCameras
from models.settings.config import FitConfig
from models.settings.lenses import Lens

Float64 = NDArray[np.float64]
SIZE = (1000, 800)
USUAL = np.log(1.2)
NOT_ASKED = float("nan")


def place(at: Float64, geometry: float, shapes: float = NOT_ASKED) -> Place:
    none = np.zeros((2, 2))
    rig = StaticCameras(TO_LOGS @ at, none, none, np.zeros((2, 3, 3)), np.zeros((2, 3)))
    return Place(at, AdjustedRig(rig, np.zeros((3, 0)), np.ones(2)), geometry, shapes)


def alike(
    geometry: tuple[float, float],
    shapes: float | None = None,
    sds: tuple[float, float] = (0.5, 0.01),
) -> Walk:
    """Return a walk whose geometry is Gaussian, (mean, deviation), and shapes that peak."""
    kind = Kind(1.0, np.array([USUAL, 0.0]), np.diag(np.square(sds)))
    places = []
    for common in USUAL + np.linspace(-2.4, 2.4, 41) * sds[0]:
        log = -(((common - geometry[0]) / geometry[1]) ** 2) / 2
        only = NOT_ASKED if shapes is None else -(((common - shapes) / 0.01) ** 2) / 2
        places.append(place(np.array([common, 0.0]), log, only))
    return Walk(kind, places, [])


def test_geometry_and_prior_multiply() -> None:
    mean, sd = USUAL + 0.3, 0.2
    posterior = posterior_of([alike((mean, sd))])
    precision = 1 / sd**2 + 1 / 0.5**2
    expected = USUAL + 0.3 / sd**2 / precision
    np.testing.assert_allclose(posterior.mean, expected, atol=1e-3)
    np.testing.assert_allclose(posterior.covariance, 1 / precision, rtol=0.01)
    assert posterior.peaks == pytest.approx([np.exp(expected)], rel=0.02)


def test_ratios_that_are_free_count_by_their_curvature() -> None:
    """Geometry is a Gaussian of both numbers, and so is the prior."""
    prior, middle = np.diag([0.4**2, 0.5**2]), np.array([USUAL + 0.1, 0.2])
    information = np.array([[60.0, -20.0], [-20.0, 30.0]])
    kind = Kind(1.0, np.array([USUAL, 0.0]), prior)

    def geometry(at: Float64) -> float:
        return float(-(at - middle) @ information @ (at - middle) / 2)

    among = information[1, 1] + 1 / prior[1, 1]
    places = []
    for common in USUAL + np.linspace(-1.2, 1.2, 61):
        ratio = (information[1, 1] * middle[1] - information[0, 1] * (common - middle[0])) / among
        at = np.array([common, ratio])
        places.append(place(at, geometry(at)))
    best = max(places, key=lambda each: each.geometry)
    beside = [best.at + np.array([0.0, step]) for step in (-0.1, 0.1)]
    posterior = posterior_of([Walk(kind, places, [place(at, geometry(at)) for at in beside])])
    covariance = np.linalg.inv(information + np.linalg.inv(prior))
    expected = covariance @ (information @ middle + np.linalg.inv(prior) @ kind.mean)
    np.testing.assert_allclose(FROM_LOGS @ posterior.mean, expected, atol=5e-3)
    found = FROM_LOGS @ posterior.covariance @ FROM_LOGS.T
    np.testing.assert_allclose(found, covariance, atol=0.03 * covariance.max())


def test_later_stages_move_lenses_of_the_likelier_kind_alone() -> None:
    """Alike ones stay alike, though the deviations span unlike ones, too."""
    same = alike((USUAL, 0.2))
    other = Kind(0.3, np.array([USUAL, 0.0]), np.diag([0.5**2, 0.4**2]))
    places = [each._replace(geometry=each.geometry) for each in same.places]
    aside = [place(np.array([USUAL, ratio]), -1.0) for ratio in (-0.3, 0.3)]
    posterior = posterior_of(
        [same._replace(kind=same.kind._replace(share=0.7)), Walk(other, places, aside)]
    )
    ratios = [
        FROM_LOGS[1] @ each @ FROM_LOGS[1] for each in (posterior.covariance, posterior.of_kind)
    ]
    assert np.sqrt(ratios[0]) > 0.05
    assert np.sqrt(ratios[1]) < 0.012


def test_shapes_move_lenses_as_far_as_their_error_allows() -> None:
    mean = posterior_of([alike((USUAL, 10.0), shapes=USUAL + 0.3)]).mean
    np.testing.assert_allclose(mean, USUAL + 0.3, atol=0.05)


@pytest.mark.parametrize("deviations", [4, 9, 30])
def test_shapes_never_overrule_lenses_that_are_given(deviations: int) -> None:
    sd = 0.05 / np.sqrt(2)
    shapes = USUAL + min(deviations * sd, 2.3 * sd)
    posterior = posterior_of([alike((USUAL, 10.0), shapes=shapes, sds=(sd, 0.01))])
    assert np.abs(posterior.mean - USUAL).max() < 2 * sd


def test_epipolar_geometry_may_overrule_lenses_that_are_given() -> None:
    sd = 0.05
    posterior = posterior_of([alike((USUAL + 2 * sd, sd / 20), sds=(sd, 0.01))])
    np.testing.assert_allclose(posterior.mean, USUAL + 2 * sd, atol=0.1 * sd)


def test_shapes_without_a_peak_are_not_informative() -> None:
    """Their evidence rises to the end of the range."""
    walk = alike((USUAL + 0.1, 0.2))
    rising = [each._replace(shapes=100 * each.at[0]) for each in walk.places]
    expected = posterior_of([walk])
    found = posterior_of([walk._replace(places=rising)])
    np.testing.assert_allclose(found.mean, expected.mean)
    np.testing.assert_allclose(found.covariance, expected.covariance)


def test_shapes_that_disagree_with_geometry_leave_two_peaks() -> None:
    apart = 14 * SHAPE_SDS[0]
    posterior = posterior_of([alike((USUAL - apart / 2, apart / 3.6), shapes=USUAL + apart / 2)])
    assert len(posterior.peaks) == 2
    assert np.sqrt(posterior.covariance[0, 0]) > apart / 4


def test_a_cliff_leaves_no_bump() -> None:
    known = np.arange(6.0)
    values = np.array([-1000.0, -1.0, -0.5, 0.0, -0.5, -1.0])
    assert interpolated(known, values, np.linspace(0, 5, 501)).max() < 0.05


def test_a_parabola_is_interpolated_exactly() -> None:
    known, at = np.linspace(0, 5, 11), np.linspace(0, 5, 50)
    np.testing.assert_allclose(
        interpolated(known, -((known - 2.1) ** 2), at), -((at - 2.1) ** 2), atol=1e-6
    )


@pytest.mark.parametrize("count", [4, 9])
def test_cubics_are_those_of_scipy(count: int) -> None:
    rng = np.random.default_rng(count)
    known, values = np.sort(rng.uniform(0, 5, count)), rng.normal(size=count)
    at = np.linspace(known[0], known[-1], 40)
    expected = Akima1DInterpolator(known, values)(at)
    np.testing.assert_allclose(interpolated(known, values, at), expected, atol=1e-6)


def asked(*lenses: Lens, **settings: object) -> CalibrationProblem:
    keypoints = np.random.default_rng(0).uniform(100, 700, (6, 2, 5, 2))
    config = FitConfig.model_validate({"lenses": lenses or None, **settings})
    return problem_of(keypoints, np.ones((6, 2, 5)), [SIZE, SIZE], config)


def test_lenses_are_of_one_kind_or_of_two() -> None:
    same, other = kinds_of(asked())
    assert same.share + other.share == pytest.approx(1)
    assert same.sds[1] < 0.02 < other.sds[1]
    np.testing.assert_allclose([same.mean, other.mean], [[USUAL, 0.0]] * 2, atol=1e-9)
    (only,) = kinds_of(asked(cameras_alike=True))
    assert only.sds[1] < 0.02
    (only,) = kinds_of(asked(cameras_alike=False))
    assert only.sds[1] > 0.02


def test_given_lenses_are_data_with_their_deviation() -> None:
    """Of lenses that are known far better than usual ones, the prior is what was given."""
    given = [Lens(focal=900.0, sd=0.01), Lens(focal=1500.0, sd=0.02)]
    (kind,) = kinds_of(asked(*given))  # lenses that differ so much are not alike
    logs, covariance = TO_LOGS @ kind.mean, TO_LOGS @ kind.covariance @ TO_LOGS.T
    np.testing.assert_allclose(logs, np.log([0.9, 1.5]), atol=2e-3)
    np.testing.assert_allclose(covariance, np.diag([0.01**2, 0.02**2]), rtol=0.01, atol=1e-6)


def test_one_given_lens_tells_of_the_other_if_they_are_alike() -> None:
    (same,) = kinds_of(asked(Lens(focal=700.0, sd=0.05), Lens(same_as=0)))
    np.testing.assert_allclose(TO_LOGS @ same.mean, np.log(0.7), atol=0.02)
