"""Lenses of two views that limit the accuracy: predicted errors beside true ones."""

import numpy as np
import pytest

from models.bundle.problem import CENTRE_X, CENTRE_Y, FOCAL, VIEW
from models.calibrating.keypoint_rig import geometry_of, static_start
from models.calibrating.lens_effect import HEIGHT, LensEffect, lens_effect, lens_findings
from models.calibrating.problem import CalibrationProblem, LensPosterior, Solution, problem_of
from models.capture.metrics import pa_mpjpe
from models.epipolar.static_cameras import StaticCameras
from models.epipolar.static_rig import StaticScene
from models.findings.finding import Finding
from models.numerics.steps import finished
from models.settings.config import FitConfig
from models.settings.lenses import Lens as KnownLens
from tests.models.rigs import FOCAL as LENGTH
from tests.models.rigs import IMAGE_SIZE, Lens, around

UNSURE = 0.1  # standard deviation of the log focal lengths


def true_solution(
    azimuths: tuple[float, ...] = (0.0, 80.0), *, noise: float = 0.0, rigid: bool = False
) -> tuple[CalibrationProblem, Solution]:
    """Return static cameras as they are, of a body that changes its shape unless it is `rigid`."""
    rng = np.random.default_rng(0)
    bodies = 0.4 * rng.normal(size=(1 if rigid else 60, 12, 3))
    turns = np.linalg.qr(rng.normal(size=(60, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    points = bodies @ turns + rng.uniform(-0.5, 0.5, (60, 1, 3))
    rotations, translations = around(list(azimuths))
    held = points[:, None] @ rotations.mT + translations[:, None]
    pixels = Lens().project(held)
    pixels += noise * rng.normal(size=pixels.shape)
    sizes = len(azimuths) * [IMAGE_SIZE]
    problem = problem_of(pixels, np.ones(pixels.shape[:3]), sizes, FitConfig())
    none = np.zeros((len(azimuths), 2))
    logs = np.full(len(azimuths), np.log(LENGTH / problem.side))
    rig = StaticCameras(logs, none, none, rotations, translations)
    solution = static_start(problem, StaticScene(rig, points), max(noise, 1e-3))
    assert solution is not None
    return problem, solution


def effect(
    problem: CalibrationProblem,
    solution: Solution,
    sd: float = UNSURE,
    views: tuple[int, ...] = (0, 1),
) -> LensEffect:
    deviations = np.zeros((2, VIEW))
    deviations[list(views), FOCAL] = sd
    return finished(lens_effect(problem, solution, deviations))


def findings(
    problem: CalibrationProblem, solution: Solution, sds: tuple[float, ...] = (UNSURE, UNSURE)
) -> tuple[Finding, ...]:
    deviations = np.zeros((len(sds), VIEW))
    deviations[:, FOCAL] = sds
    return finished(lens_findings(problem, solution, deviations))


@pytest.mark.parametrize("off", [-0.15, 0.15])
def test_the_predicted_error_is_that_of_lenses_that_are_so_far_off(off: float) -> None:
    """Cameras are found anew with one focal length held at a wrong value."""
    problem, solution = true_solution()
    predicted = effect(problem, solution, abs(off), views=(1,)).by_lenses
    focals = [LENGTH, LENGTH * np.exp(off)]
    config = FitConfig(lenses=tuple(KnownLens(focal=focal, sd=0.001) for focal in focals))
    wrong = problem_of(problem.keypoints, problem.weights, [IMAGE_SIZE] * 2, config)
    found = finished(geometry_of(wrong, declared=True)).rig
    assert found is not None
    errors = pa_mpjpe(found.best.points, solution.scene.points, reflection="never")
    sizes = np.sqrt(np.square(solution.scene.points).sum(-1).mean(1))
    assert errors.mean / (HEIGHT * sizes.mean()) == pytest.approx(predicted, rel=0.35)


def test_errors_grow_with_the_deviations_of_the_lenses() -> None:
    pair = true_solution()
    whole = effect(*pair)
    assert whole.by_lenses > 0.002
    assert whole.by_noise < 1e-4
    assert effect(*pair, UNSURE / 4).by_lenses == pytest.approx(whole.by_lenses / 4, rel=0.3)


def test_keypoints_that_are_noisy_limit_the_accuracy_themselves() -> None:
    clean, noisy = true_solution(), true_solution(noise=10.0)
    assert effect(*noisy).by_lenses == pytest.approx(effect(*clean).by_lenses, rel=0.5)
    assert effect(*noisy).by_noise > 0.01
    assert findings(*clean)
    assert not findings(*noisy)


def test_lenses_known_as_from_a_data_sheet_leave_as_much_less() -> None:
    """Where one lens is off by 0.1 and nothing else, 0.05 more knowledge leaves a known share."""
    pair = true_solution()
    unsure = effect(*pair)
    left = 1 / np.sqrt(1 / UNSURE**2 + 1 / 0.05**2)
    assert unsure.by_known == pytest.approx(left / UNSURE * unsure.by_lenses, rel=0.02)
    (finding,) = findings(*pair)
    expected = finding.evidence["error_with_lenses_to_5_percent"]
    assert expected == pytest.approx(np.hypot(unsure.by_known, unsure.by_noise))
    assert finding.remedy.startswith("Lenses known to 5 % would bring the expected error from")


def test_lenses_that_are_alike_err_together() -> None:
    """The covariance of the posterior counts, not the deviations of each."""
    problem, solution = true_solution()
    alone = np.zeros((2, VIEW))
    alone[:, FOCAL] = UNSURE
    mean = np.log(solution.rig.lenses.focals.mean(1) / problem.side)
    squares = []
    for sign in (1.0, -1.0):
        covariance = UNSURE**2 * np.array([[1.0, 0.999 * sign], [0.999 * sign, 1.0]])
        posterior = LensPosterior(mean, covariance, covariance, ())
        asked = problem._replace(lens_posterior=posterior)
        squares.append(finished(lens_effect(asked, solution, alone)).by_lenses ** 2)
    assert effect(problem, solution).by_lenses ** 2 == pytest.approx(np.mean(squares), rel=0.05)
    assert max(squares) > 1.5 * min(squares)


def test_lengths_that_stay_constant_leave_no_such_error() -> None:
    assert effect(*true_solution(rigid=True)).by_lenses < 0.1 * effect(*true_solution()).by_lenses
    assert not findings(*true_solution(rigid=True))


def test_principal_points_count_where_the_size_of_the_image_is_not_known() -> None:
    known, solution = true_solution()
    guessed = known._replace(images=known.images._replace(known=np.zeros(2, np.bool_)))
    deviations = np.zeros((2, VIEW))
    deviations[:, FOCAL] = 0.01
    deviations[:, [CENTRE_X, CENTRE_Y]] = 0.1 * known.side
    alone, together = (
        finished(lens_effect(problem, solution, deviations)).by_lenses
        for problem in (known, guessed)
    )
    assert alone == effect(known, solution, 0.01).by_lenses
    assert together > 5 * alone


def test_lenses_that_are_given_do_not_limit_the_accuracy() -> None:
    pair = true_solution()
    assert not findings(*pair, (0.0, 0.0))
    assert findings(*pair, (0.0, UNSURE))[0].views == (1,)


def test_three_views_have_no_such_finding() -> None:
    assert not findings(*true_solution((0.0, 80.0, -120.0)), 3 * (UNSURE,))
