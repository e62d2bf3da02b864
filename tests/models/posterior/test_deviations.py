"""How far points of a fit may be off, against how far they are."""

import json
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load, save

from models.capture.metrics import procrustes_by_size
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from models.settings.uncertainty import Uncertainty
from models.training.trainer import fit
from tests.models.rigs import RigCapture, make_rig_capture
from tests.sharing import fitted_once

NOISE = 3.0  # pixels
HAND = 5  # a keypoint at the end of a limb
LATER = slice(60, 90)  # frames that the fit does not see
STEPS = 200


@cache
def capture() -> RigCapture:
    return make_rig_capture([0.0, 80.0, -120.0], frames=90, noise=NOISE)


@cache
def prior() -> FittedPrior:
    keypoints = capture().keypoints[: LATER.start]
    return fitted_once("doubted", lambda: fit(keypoints, FitConfig(steps=STEPS)))


def errors(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the distances (N, P) from the truth, each frame aligned, in the unit of the lift."""
    truth = capture().points3d[LATER]
    aligned = procrustes_by_size(truth, points.astype(np.float64))
    return np.asarray(np.linalg.norm(aligned - points, axis=-1))


def hidden(*views: int) -> NDArray[np.float64]:
    """Return the later frames without a hand in some views."""
    keypoints = capture().keypoints[LATER].copy()
    keypoints[:, views, HAND] = np.nan
    return keypoints


def test_errors_are_as_large_as_they_are_expected_to_be() -> None:
    lift = prior().lift(capture().keypoints[LATER])
    off, expected = errors(lift.points3d), lift.points3d_sd
    assert expected.shape == off.shape
    assert 0.75 < np.sqrt(np.square(off).mean() / np.square(expected).mean()) < 1.33
    within = off < 1.08 * expected  # 68 % of a distance in three directions
    assert 0.5 < within.mean() < 0.85


def test_a_keypoint_is_the_surer_the_more_views_show_it() -> None:
    sds = [
        float(np.median(prior().lift(hidden(*views)).points3d_sd[:, HAND]))
        for views in ((), (0,), (0, 1), (0, 1, 2))
    ]
    assert sds == sorted(sds)
    assert sds[0] < 0.9 * sds[1]
    assert sds[1] < 0.7 * sds[2]


def test_where_a_keypoint_is_hidden_errors_are_as_expected() -> None:
    for views in ((0,), (0, 1), (0, 1, 2)):
        lift = prior().lift(hidden(*views))
        off, expected = errors(lift.points3d)[:, HAND], lift.points3d_sd[:, HAND]
        assert 0.5 < np.sqrt(np.square(off).mean() / np.square(expected).mean()) < 2


def test_noisier_keypoints_of_unknown_cameras_leave_more_doubt() -> None:
    sds = prior().lift(capture().keypoints[LATER]).points3d_sd
    two = prior().lift(capture().keypoints[LATER, :2]).points3d_sd  # cameras of their own
    assert np.nanmedian(two) > np.median(sds)


def dense(covariances: NDArray[np.float32], modes: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return Sigma (N, 3 P, 3 P) of covariances (N, P, 6) and modes (N, P, 3, r)."""
    frames, count = covariances.shape[:2]
    rows = modes.astype(np.float64).reshape(frames, 3 * count, -1)
    whole = rows @ rows.mT
    for p in range(count):
        block = whole[:, 3 * p : 3 * p + 3, 3 * p : 3 * p + 3]
        block[:] = covariances[:, p][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    return whole


def test_covariances_are_of_the_deviations() -> None:
    keypoints = capture().keypoints[LATER]
    lift, plain = prior().lift(keypoints, uncertainty="full"), prior().lift(keypoints)
    np.testing.assert_array_equal(lift.points3d_sd, plain.points3d_sd)
    assert lift.points3d_covariance.shape == (*lift.points3d_sd.shape, 6)
    assert "points3d_covariance" in lift.arrays
    assert "points3d_covariance" not in plain.arrays
    whole = dense(lift.points3d_covariance, lift.points3d_modes)
    variances = whole.diagonal(axis1=1, axis2=2).reshape(*lift.points3d_sd.shape, 3).sum(-1)
    np.testing.assert_allclose(np.sqrt(variances), lift.points3d_sd, rtol=1e-4)
    values = np.linalg.eigvalsh(whole)
    assert values.min() > -1e-3 * values.max()


def test_lengths_are_off_by_what_covariances_expect() -> None:
    lift = prior().lift(capture().keypoints[LATER], uncertainty="full")
    points = lift.points3d.astype(np.float64)
    truth = procrustes_by_size(capture().points3d[LATER], points)
    whole = dense(lift.points3d_covariance, lift.points3d_modes)
    scores = []
    for p, q in combinations(range(points.shape[1]), 2):
        apart = points[:, p] - points[:, q]
        length = np.linalg.norm(apart, axis=-1)
        slopes = np.zeros(points.shape)
        slopes[:, p], slopes[:, q] = apart / length[:, None], -apart / length[:, None]
        rows = slopes.reshape(len(points), 1, -1)
        variance = (rows @ whole @ rows.mT)[:, 0, 0]
        off = np.linalg.norm(truth[:, p] - truth[:, q], axis=-1) - length
        scores.append(np.square(off) / variance)
    assert 0.5 < np.mean(scores) < 2


@pytest.mark.parametrize("uncertainty", ["off", "full"])
def test_null_points_have_no_covariance(uncertainty: Uncertainty) -> None:
    keypoints = capture().keypoints[LATER].copy()
    keypoints[0] = np.nan
    lift = prior().lift(keypoints, uncertainty=uncertainty)
    assert np.isnan(lift.points3d_sd[0]).all()
    assert np.isnan(lift.points3d_covariance[0]).all()
    assert np.isnan(lift.points3d_modes[0]).all()
    assert np.isnan(lift.points3d_sd[1:]).all() == (uncertainty == "off")
    assert np.isfinite(lift.points3d_covariance[1:]).all()


def test_weak_perspective_has_no_covariances() -> None:
    lift = prior().lift(capture().keypoints[LATER], refine="off", uncertainty="full")
    assert lift.points3d_modes.shape[-1] > 0
    assert np.isnan(lift.points3d_modes).all()
    assert np.isnan(lift.points3d_covariance).all()


def test_weak_perspective_is_of_unknown_doubt() -> None:
    assert np.isnan(prior().lift(capture().keypoints[LATER], refine="off").points3d_sd).all()


def test_a_file_has_the_posterior() -> None:
    data = prior().to_bytes()
    again = FittedPrior.from_bytes(data)
    assert again.to_bytes() == data
    keypoints = capture().keypoints[LATER]
    np.testing.assert_array_equal(
        again.lift(keypoints).points3d_sd, prior().lift(keypoints).points3d_sd
    )


def test_files_without_corrections_are_read() -> None:
    """Older versions wrote one share of noise, and no corrections."""
    data = prior().to_bytes()
    arrays = dict(load(data))
    arrays["posterior.left"] = arrays["posterior.left"][:1]
    corrections = arrays.pop("posterior.corrections")
    del arrays["posterior.usual"]
    header = data[8 : 8 + int.from_bytes(data[:8], "little")]
    about = json.loads(json.loads(header)["__metadata__"]["fewview"]) | {"posterior": "yes"}
    older = FittedPrior.from_bytes(save(arrays, {"fewview": json.dumps(about)}))
    keypoints = capture().keypoints[LATER]
    ratios = prior().lift(keypoints).points3d_sd / older.lift(keypoints).points3d_sd
    assert 0.9 * corrections[0, 3] < np.median(ratios) < 1.1  # that of the cameras stays
    assert np.isnan(older.lift(keypoints).quality).all()


def test_a_point_that_may_be_anywhere_is_null() -> None:
    """With shapes that leave the hand open by more than the subject's size."""
    posterior = prior().posterior
    assert posterior is not None
    variances = posterior.variances.copy()
    variances[HAND] = 100 * np.square(posterior.mean).sum(-1).mean()
    loose = prior().with_posterior(posterior._replace(variances=variances))
    assert np.isnan(loose.lift(hidden(0, 1, 2)).points3d[:, HAND]).all()
    assert np.isfinite(loose.lift(hidden(0)).points3d[:, HAND]).mean() > 0.8
    assert np.isfinite(prior().lift(hidden(0, 1, 2)).points3d).all()


@pytest.mark.parametrize("name", ["noise", "variances", "left", "corrections"])
def test_a_file_with_a_posterior_that_makes_no_sense_is_refused(name: str) -> None:
    data = prior().to_bytes()
    arrays = dict(load(data))
    arrays[f"posterior.{name}"] = -arrays[f"posterior.{name}"]
    header = data[8 : 8 + int.from_bytes(data[:8], "little")]
    broken = save(arrays, json.loads(header)["__metadata__"])
    with pytest.raises(WeightsError, match="posterior"):
        FittedPrior.from_bytes(broken)
