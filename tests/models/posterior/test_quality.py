"""How far frames may be relied on: those of the fit, and harmed ones."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.lifting.lift import LiftedFrames
from models.posterior.quality import DOUBTFUL, REASONS
from tests.models.posterior.test_deviations import HAND, LATER, capture, prior

Float64 = NDArray[np.float64]


def lift(keypoints: Float64) -> LiftedFrames:
    return prior().lift(keypoints)


def as_filmed() -> Float64:
    return np.array(capture().keypoints[LATER])


def test_most_frames_may_be_relied_on() -> None:
    found = lift(as_filmed())
    assert (found.quality > DOUBTFUL).mean() > 0.85
    assert ((found.quality >= 0) & (found.quality <= 1)).all()
    assert ((found.quality_reason == 0) == (found.quality >= DOUBTFUL)).all()


def swapped_keypoints(keypoints: Float64) -> None:
    keypoints[:] = keypoints[:, :, np.random.default_rng(0).permutation(keypoints.shape[2])]


def out_of_step(keypoints: Float64) -> None:
    keypoints[:, 1] = np.roll(keypoints[:, 1], len(keypoints) // 2, axis=0)


def one_view(keypoints: Float64) -> None:
    keypoints[:, 1:] = np.nan


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (swapped_keypoints, "unlike_fit"),
        (out_of_step, "views_disagree"),
        (one_view, "little_evidence"),
    ],
)
def test_harmed_frames_are_less_reliable_for_a_reason(harm, reason: str) -> None:  # type: ignore[no-untyped-def]
    keypoints = as_filmed()
    harm(keypoints)
    found = lift(keypoints)
    assert np.median(found.quality) < 0.7 * np.median(lift(as_filmed()).quality)
    reasons = [REASONS[place - 1] for place in found.quality_reason if place]
    assert reasons.count(reason) > 0.6 * len(found.quality)


def test_a_frame_without_a_structure_has_no_quality() -> None:
    keypoints = as_filmed()
    keypoints[0] = np.nan
    found = lift(keypoints)
    assert found.quality[0] == 0
    assert REASONS[found.quality_reason[0] - 1] == "no_evidence"


def test_weak_perspective_is_of_unknown_quality() -> None:
    assert np.isnan(prior().lift(as_filmed(), refine="off").quality).all()


def test_a_hidden_keypoint_makes_little_difference() -> None:
    keypoints = as_filmed()
    keypoints[:, 0, HAND] = np.nan
    ratios = lift(keypoints).quality / lift(as_filmed()).quality
    assert 0.7 < np.median(ratios) < 1.05
