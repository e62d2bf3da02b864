"""Whatever a capture looks like, its lifts are finite or say that there is no answer."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.settings.config import FitConfig
from models.training.trainer import fit
from tests.models.lifting.comparison import same
from tests.models.rigs import make_rig_capture
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]
QUICK: dict[str, Any] = {"steps": 30, "dictionary_sizes": (16, 8), "batch_size": 8}
AZIMUTHS = [0.0, 80.0, -120.0]


def keypoints_of(case: str) -> Float64:  # noqa: PLR0911, PLR0912 - a branch per kind of capture
    frames, _, kind = case.partition(" ")
    if kind.startswith("frame"):
        return make_rig_capture(AZIMUTHS, frames=int(frames), hidden=0).keypoints
    keypoints = make_rig_capture(AZIMUTHS, frames=6, noise=2, hidden=0.1).keypoints
    rng = np.random.default_rng(0)
    match case:
        case "4 keypoints":
            return keypoints[:, :, [1, 6, 9, 12]]
        case "4 noisy keypoints":
            return make_rig_capture(AZIMUTHS, frames=5, noise=20, hidden=0).keypoints[
                :, :, [1, 6, 9, 12]
            ]
        case "one view":
            return keypoints[:, :1]
        case "identical views":
            return np.repeat(keypoints[:, :1], 3, 1)
        case "views that share no frame":
            keypoints[np.arange(6), np.arange(6) % 3] *= -1
            return np.where(keypoints < 0, -keypoints, np.nan)
        case "an empty view":
            keypoints[:, 1] = np.nan
        case "an empty frame":
            keypoints[4] = np.nan
        case "7 views":
            return make_rig_capture([50.0 * k for k in range(7)], frames=4).keypoints
        case "133 keypoints":
            share = rng.dirichlet(np.full(16, 0.3), 133)
            full = make_rig_capture(AZIMUTHS[:2], frames=4, hidden=0).keypoints
            return np.asarray(np.einsum("nkpc,qp->nkqc", full, share))
        case "a keypoint never seen":
            keypoints[:, :, 5] = np.nan
        case "a coordinate that is no number":
            keypoints[::2, 1, 3, 0] = np.nan
        case "half of the keypoints hidden":
            keypoints[rng.random(keypoints.shape[:3]) < 0.5] = np.nan
        case "nothing but noise":
            return rng.uniform(0, 1000, keypoints.shape)
        case "one pose throughout":
            return np.repeat(keypoints[:1], 6, 0)
        case "exact keypoints":
            return make_rig_capture(AZIMUTHS, frames=6, noise=0, hidden=0).keypoints
        case "absurd outliers":
            keypoints[rng.random(keypoints.shape[:3]) < 0.1] = 9e5
    return keypoints


CASES = (
    *("1 frame", "2 frames", "4 keypoints", "one view", "identical views"),
    *("views that share no frame", "an empty view", "an empty frame", "a keypoint never seen"),
    *("a coordinate that is no number", "half of the keypoints hidden", "absurd outliers"),
)
OTHERS = (
    *("3 frames", "15 frames", "4 noisy keypoints", "7 views", "133 keypoints"),
    *("nothing but noise", "one pose throughout", "exact keypoints"),
)


@pytest.mark.parametrize("case", thorough_after(len(CASES), CASES + OTHERS))
def test_no_capture_is_too_odd_for_a_finite_answer(case: str) -> None:
    keypoints = keypoints_of(case)
    prior = fit(keypoints, FitConfig.model_validate(QUICK))
    for refine in ("off", "full", "auto"):
        check(prior.lift(keypoints, refine=refine), keypoints)
    check_found(prior)
    copy = FittedPrior.from_bytes(prior.to_bytes())
    same(copy.lift(keypoints), prior.lift(keypoints))


@pytest.mark.parametrize(
    "case", thorough_after(1, ["one view", "identical views", "views that share no frame"])
)
def test_cameras_declared_static_may_leave_each_other_undetermined(case: str) -> None:
    keypoints = keypoints_of(case)
    given = {"cameras": "static", "refine": "full"}
    prior = fit(keypoints, FitConfig.model_validate(QUICK | given))
    check(prior.lift(keypoints), keypoints)
    check_found(prior)


def check_found(prior: FittedPrior) -> None:
    if prior.cameras is not None:
        assert np.isfinite(prior.cameras.focals).all()
        assert (prior.cameras.focals > 0).all()
        assert prior.cameras.noise > 0


def check(lift: LiftedFrames, keypoints: Float64) -> None:
    """Answers are finite where there are some, and two views suffice where 4 keypoints show."""
    usable = np.isfinite(keypoints).all(-1).sum(-1) >= 4
    assert [status == "ok" for status in lift.status] == usable.any(1).tolist()
    seen = (np.isfinite(keypoints).all(-1) & usable[..., None]).any((0, 1))  # (P,) not invented
    answered = np.isfinite(lift.points3d).all(-1)  # (N, P)
    asked = usable.any(1)[:, None] & seen
    assert not (answered & ~asked).any()
    # A keypoint that fewer than two views show has no answer where shapes put it far off.
    missing = asked & ~answered
    twice = (np.isfinite(keypoints).all(-1) & usable[..., None]).sum(1) > 1
    assert not (missing & twice).any()
    assert missing.sum() <= 0.02 * asked.sum()
    np.testing.assert_array_equal(lift.camera_models >= 0, usable)
    refined = lift.camera_models > 0
    for values, there in (
        (lift.rotations.reshape(*usable.shape, 9), usable),
        (lift.scales[..., None], usable),
        (lift.translations[..., :2], usable),
        (lift.translations[..., 2:], refined),
        (lift.reprojection_errors[..., None], usable),
        (lift.focals, refined),
        (lift.principal_points, refined),
        (lift.distortions, refined),
    ):
        np.testing.assert_array_equal(np.isfinite(values).all(-1), there)
        assert np.isnan(values[~there]).all()
    determinants = np.linalg.det(lift.rotations[usable].astype(np.float64))
    np.testing.assert_allclose(determinants, 1, atol=1e-4)
