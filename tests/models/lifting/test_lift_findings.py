"""Findings of a lift, with the weights of static cameras (see tests/fixtures)."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift_findings import lift_findings
from models.network.answers import Usual
from tests.models.rigs import Lens, make_rig_capture

Float64 = NDArray[np.float64]
WEIGHTS = Path(__file__).parents[2] / "fixtures" / "resting.safetensors"
FRAMES, VIEWS = 40, 3


@pytest.fixture(scope="module")
def keypoints() -> Float64:
    lens = Lens(distortion=(-0.12, 0.03))
    rig = make_rig_capture([0.0, 80.0, -120.0], frames=FRAMES, lenses=(lens,), distance=3)
    return rig.keypoints


@pytest.fixture(scope="module")
def prior(keypoints: Float64) -> FittedPrior:
    """Return weights of an older version, which know of nothing unusual, and what is."""
    older = FittedPrior.from_bytes(WEIGHTS.read_bytes())
    lifts = [older.lift(keypoints[:, :n], views=range(n)) for n in range(1, VIEWS + 1)]
    usual = Usual(np.array([1.3 * lift.misfits.max() for lift in lifts], float), 40.0, 400.0)
    return older.of_capture(older.config, older.capture._replace(usual=usual))


def test_nothing_is_found_in_frames_like_those_of_the_fit(
    prior: FittedPrior, keypoints: Float64
) -> None:
    for frames, views in ((keypoints, None), (keypoints[:, 1:], [1, 2]), (keypoints[:, :1], [0])):
        assert lift_findings(prior.lift(frames, views=views), prior) == ()


def test_views_in_another_order_do_not_use_the_rig(prior: FittedPrior, keypoints: Float64) -> None:
    mixed = keypoints.copy()
    mixed[10:20, :2] = mixed[10:20, 1::-1]
    found = lift_findings(prior.lift(mixed), prior)[0]
    assert found.code == "rig_not_used"
    assert found.frames == ((10, 19),)
    assert found.evidence["residual_px"] > 10
    assert found.evidence["times_the_noise"] == pytest.approx(
        found.evidence["residual_px"] / prior.noise
    )
    everywhere = prior.lift(keypoints[:, [1, 0]], views=[0, 1])
    found = lift_findings(everywhere, prior)[0]
    assert (found.code, found.frames) == ("rig_not_used", ())
    # Named rightly, or not named at all, they do not leave it.
    assert not (prior.lift(keypoints[:, [1, 0]], views=[1, 0]).findings & 1).any()
    unknown = prior.lift(keypoints[:, [1, 0]])
    assert not any(f.code == "rig_not_used" for f in lift_findings(unknown, prior))


def test_refinement_is_kept_only_where_it_explains_as_well_as_the_network(
    prior: FittedPrior,
) -> None:
    """Of keypoints at random no rig makes sense: some are left as the network has them."""
    nonsense = np.random.default_rng(0).uniform(200, 900, (FRAMES, VIEWS, 16, 2))
    auto, full, weak = (
        np.asarray(lift.reprojection_errors.sum(1), np.float64)
        for lift in (prior.lift(nonsense, refine=r) for r in ("auto", "full", "off"))
    )
    worse = full > 1.25 * weak
    assert 3 < worse.sum() < FRAMES
    np.testing.assert_array_equal(auto[worse], weak[worse])
    np.testing.assert_array_equal(auto[~worse], full[~worse])
    lift = prior.lift(nonsense)
    assert ((lift.findings & 1) > 0)[worse].all()
    codes = {finding.code for finding in lift_findings(lift, prior)}
    assert codes == {"rig_not_used", "frame_unlike_fit"}


def test_frames_unlike_the_fit(prior: FittedPrior, keypoints: Float64) -> None:
    order = np.random.default_rng(1).permutation(16)
    lift = prior.lift(np.concatenate((keypoints, keypoints[:, :, order])))
    unlike = [f for f in lift_findings(lift, prior) if f.code == "frame_unlike_fit"]
    assert len(unlike) == 1
    assert unlike[0].frames[0][0] >= FRAMES
    assert sum(last - first + 1 for first, last in unlike[0].frames) > 0.9 * FRAMES
    assert unlike[0].evidence["misfit"] > unlike[0].evidence["usual_at_most"]


def test_coordinates_of_another_scale(prior: FittedPrior, keypoints: Float64) -> None:
    small = prior.lift(keypoints / 1000)
    found = {f.code: f for f in lift_findings(small, prior)}["coordinates_of_another_scale"]
    assert found.frames == ()
    assert found.evidence["size_px"] < 1 < found.evidence["usual_at_least_px"]
    part = lift_findings(small.frames(slice(2, 5)), prior, first_frame=100)
    assert ((100, 102),) in {f.frames for f in part}


def test_older_weights_know_nothing_unusual(keypoints: Float64) -> None:
    older = FittedPrior.from_bytes(WEIGHTS.read_bytes())
    order = np.random.default_rng(1).permutation(16)
    lift = older.lift(keypoints[:, :, order], refine="off")
    assert lift_findings(lift, older) == ()


def test_how_many_views_show_a_keypoint(prior: FittedPrior, keypoints: Float64) -> None:
    shown = keypoints.copy()
    shown[0, 1] = np.nan
    shown[1, :, 7] = np.nan
    shown[2, 0, 3:] = np.nan  # so few that the view does not count
    usable = np.isfinite(shown).all(-1)
    usable &= (usable.sum(-1) >= 4)[..., None]
    lift = prior.lift(shown)
    np.testing.assert_array_equal(lift.keypoints_seen, usable.sum(1))
    assert lift.keypoints_seen[1, 7] == 0
    assert np.isfinite(lift.points3d[1, 7]).all()  # inferred
