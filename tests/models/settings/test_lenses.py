"""What people know of lenses, in pixels."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from models.bundle.problem import FOCAL
from models.calibrating.keypoint_rig import lens_beliefs
from models.calibrating.problem import problem_of
from models.settings.config import FitConfig
from models.settings.lenses import Lens, LensError, alike_views, known_lenses, lens_of_each_view
from models.training.keypoints_of_fit import check_entries_per_view

HD = (1920, 1080)


@pytest.mark.parametrize(
    ("lens", "size", "pixels"),
    [
        # 36 mm of film in a 36 mm lens: as wide as far; an image of its shape, 3:2.
        (Lens(equivalent=36), (3000, 2000), 3000.0),
        (Lens(equivalent=50), HD, 50 / math.hypot(36, 24) * math.hypot(*HD)),
        (Lens(field_of_view=90), HD, 960.0),
        (Lens(field_of_view=90, axis="vertical"), HD, 540.0),
        (Lens(field_of_view=90, axis="diagonal"), (1600, 1200), 1000.0),
        (Lens(field_of_view=2 * math.degrees(math.atan(0.5))), HD, 1920.0),
        (Lens(focal=1460), None, 1460.0),
    ],
)
def test_a_focal_length_in_pixels(lens: Lens, size: tuple[int, int] | None, pixels: float) -> None:
    assert lens.pixels(size) == pytest.approx(pixels)


@pytest.mark.parametrize(
    "wrong",
    [{}, {"equivalent": 26, "focal": 1000}, {"field_of_view": 180}, {"focal": 900, "sd": 0}],
)
def test_one_thing_is_said_of_a_lens(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        Lens.model_validate(wrong)


def test_the_same_lens_is_as_long_in_a_smaller_image() -> None:
    lenses = [Lens(same_as=1), Lens(focal=2000, sd=0.02), None, Lens(same_as=0)]
    known = known_lenses(lenses, [(960, 540), HD, None, HD])
    assert [lens and (lens.focal, lens.sd) for lens in known] == [
        (1000.0, 0.02),
        (2000.0, 0.02),
        None,
        (2000.0, 0.02),
    ]
    assert alike_views(lenses) == [0, 0, 2, 0]
    with pytest.raises(LensError, match="sizes of both"):
        known_lenses(lenses, [None, HD, None, HD])


@pytest.mark.parametrize("other", [0, 2])
def test_a_lens_is_the_same_as_that_of_another_view(other: int) -> None:
    with pytest.raises(LensError, match="another view, from 0 to 1"):
        alike_views([Lens(same_as=other), None])


def test_an_entry_counts_for_all_views_or_for_one() -> None:
    lens = Lens(equivalent=26)
    assert lens_of_each_view([lens], 3) == (lens, lens, lens)
    with pytest.raises(ValueError, match=r"one per view \(3\), got 2"):
        lens_of_each_view([lens, None], 3)
    config = FitConfig(lenses=(lens,))
    check_entries_per_view(2, config, [HD, HD])
    with pytest.raises(ValueError, match=r"lenses\[1\].*image_sizes"):
        check_entries_per_view(2, config, [HD, None])


def test_what_is_known_is_a_prior_of_the_cameras() -> None:
    keypoints = np.random.default_rng(0).uniform(200, 900, (8, 3, 5, 2))
    weights, sizes = np.ones((8, 3, 5)), [HD] * 3
    lenses = (Lens(focal=1000, sd=0.1), Lens(same_as=2), None)
    given = {"intrinsics": {"fx": 1234.0}}
    config = FitConfig.model_validate({"lenses": [lens and lens.model_dump() for lens in lenses]})
    problem = problem_of(keypoints, weights, sizes, config)
    assert problem.reference.lenses.focals[0] == pytest.approx([1000, 1000])
    assert problem.lens_sds[:, FOCAL].tolist() == [0.1, np.inf, np.inf]
    covariance = lens_beliefs(problem).focal_covariance
    sds = np.sqrt(covariance.diagonal())
    correlations = covariance / np.outer(sds, sds)
    assert sds[0] == pytest.approx(0.1)
    assert correlations[1, 2] > 0.99
    assert np.abs(correlations[0, 1:]).max() == 0

    every = problem_of(keypoints, weights, sizes, config.model_copy(update={"cameras_alike": True}))
    assert every.lens_groups.tolist() == [0, 0, 0]

    # A calibration knows better.
    calibration = FitConfig.model_validate({"calibration": [given, None, None]}).calibration
    calibrated = config.model_copy(update={"calibration": calibration})
    problem = problem_of(keypoints, weights, sizes, calibrated)
    assert problem.reference.lenses.focals[0] == pytest.approx([1234, 1234])
    assert problem.lens_sds[0, FOCAL] == 0
