"""Keypoints that few views see are inferred from known structures; stray keypoints."""

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.torch import load

from models.bundle.known_structures import LEAST_STRUCTURES, KnownStructures
from models.capture.metrics import pa_mpjpe
from models.capture.observations import as_observations
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from models.training.batches import Data
from models.training.known_structures import believe_where_better
from models.training.trainer import fit
from tests.models.lifting.comparison import without
from tests.models.rigs import RigCapture, keypoint, make_rig_capture
from tests.sharing import fitted_once

AZIMUTHS = [0.0, 70.0, 140.0]
QUICK = FitConfig(steps=400, dictionary_sizes=(16, 8), batch_size=16, cameras="static")
FRAMES, UNSEEN, POSES = 240, 40, 29  # of the fit, beside it, and where the figure turns


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    """Return a figure that goes from pose to pose, so that each frame has others like it."""
    poses = make_rig_capture(AZIMUTHS, frames=POSES, noise=0, hidden=0, seed=3)
    times = np.linspace(0, POSES - 1.001, FRAMES + UNSEEN)
    before, share = times.astype(np.int64), (times % 1)[:, None, None]
    figure = (1 - share) * poses.points3d[before] + share * poses.points3d[before + 1]
    rotations, translations = poses.rotations[before], poses.translations[before]
    camera = figure[:, None] @ rotations.mT + translations[:, :, None]
    pixels = [lens.project(camera[:, k]) for k, lens in enumerate(poses.lenses)]
    noise = 0.3 * np.random.default_rng(4).standard_normal((*camera.shape[:3], 2))
    keypoints = np.stack(pixels, axis=1) + noise
    return RigCapture(keypoints, figure, rotations, translations, poses.lenses)


@pytest.fixture(scope="module")
def prior(capture: RigCapture) -> FittedPrior:
    order = np.random.default_rng(0).permutation(len(capture.keypoints))
    frames = capture.keypoints[np.sort(order[:FRAMES])]
    return fitted_once("structures", lambda: fit(frames, QUICK))


@pytest.fixture(scope="module")
def unseen(capture: RigCapture) -> NDArray[np.int64]:
    order = np.random.default_rng(0).permutation(len(capture.keypoints))
    return np.sort(order[FRAMES:])


@pytest.fixture(scope="module")
def plain(prior: FittedPrior) -> FittedPrior:
    """Return the same prior as files of versions have it that knew no structures."""
    return without(prior, "structures")


def errors_of(
    prior: FittedPrior, keypoints: NDArray[np.float64], truth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the errors (N, P) of lifts in metres, never mirrored."""
    points = prior.lift(keypoints).points3d
    return np.asarray(pa_mpjpe(points, truth, reflection="never").errors, np.float64)


@pytest.mark.parametrize("better", [True, False])
def test_structures_are_believed_if_hidden_views_bear_them_out(
    capture: RigCapture,
    unseen: NDArray[np.int64],
    prior: FittedPrior,
    plain: FittedPrior,
    better: bool,
) -> None:
    """With them a single view is completed better here, so without them it is worse."""
    arrays = load(prior.to_bytes())
    known = KnownStructures.from_arrays(
        {name: arrays[f"structures.{name}"] for name in KnownStructures._fields}
    )
    frames = Data.of(as_observations(capture.keypoints[unseen]), np.arange(len(unseen)))

    def make_prior(structures: KnownStructures | None) -> FittedPrior:
        return prior if (structures is not None) == better else plain

    assert believe_where_better(known, frames, make_prior, seed=[0]).believed[0] == better


def test_one_view_is_completed_by_what_is_known(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior, plain: FittedPrior
) -> None:
    one = capture.keypoints[unseen].copy()
    one[:, 1:] = np.nan
    truth = capture.points3d[unseen]
    assert errors_of(prior, one, truth).mean() < 0.7 * errors_of(plain, one, truth).mean()


def test_what_no_view_shows_is_completed_by_what_is_known(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior, plain: FittedPrior
) -> None:
    gaps = capture.keypoints[unseen].copy()
    hidden = np.random.default_rng(1).random((len(gaps), gaps.shape[2])) < 0.2
    gaps[np.broadcast_to(hidden[:, None], gaps.shape[:3])] = np.nan
    truth = capture.points3d[unseen]
    errors = [errors_of(p, gaps, truth)[hidden].mean() for p in (prior, plain)]
    assert errors[0] < 0.7 * errors[1]


def test_a_frame_unlike_all_that_is_known_stays_as_it_was(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior, plain: FittedPrior
) -> None:
    figure = capture.points3d[unseen].copy()
    middle = figure.mean(1, keepdims=True)
    figure = middle + (figure - middle) * np.array([2.0, 0.6, 1.0])  # squat and broad
    camera = figure @ capture.rotations[unseen, 0].mT + capture.translations[unseen, 0][:, None]
    one = np.full((len(unseen), len(AZIMUTHS), figure.shape[1], 2), np.nan)
    one[:, 0] = capture.lenses[0].project(camera)
    errors = [errors_of(p, one, figure).mean() for p in (prior, plain)]
    assert errors[0] < 1.05 * errors[1]


def test_all_views_need_nothing_that_is_known(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior, plain: FittedPrior
) -> None:
    frames, truth = capture.keypoints[unseen], capture.points3d[unseen]
    errors = [errors_of(p, frames, truth).mean() for p in (prior, plain)]
    assert errors[0] < 1.05 * errors[1]


def test_structures_travel_with_the_prior(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior
) -> None:
    again = FittedPrior.from_bytes(prior.to_bytes())
    one = capture.keypoints[unseen, :1]
    lifts = [p.lift(one, views=[0]).points3d for p in (prior, again)]
    np.testing.assert_array_equal(lifts[0], lifts[1])


@pytest.mark.parametrize("wrong", ["few", "weights", "shape", "believed"])
def test_a_file_that_contradicts_itself_is_refused(wrong: str) -> None:
    count = LEAST_STRUCTURES - (wrong == "few")
    weights = np.full((count, 5), 0.0 if wrong == "weights" else 1.0)
    points = np.zeros((count + (wrong == "shape"), 5, 3))
    believed = np.ones(0 if wrong == "believed" else 2)
    with pytest.raises(WeightsError, match="structures"):
        KnownStructures.from_arrays(KnownStructures(points, weights, believed).to_arrays())


def test_a_stray_keypoint_is_left_out_and_marked(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior
) -> None:
    """It lies where a keypoint may be, at the place of another one."""
    clear = capture.keypoints[unseen]
    stray = clear.copy()
    wrist, other = keypoint("left_wrist"), keypoint("right_wrist")
    stray[:, 1, wrist] = clear[:, 1, other]
    off = np.linalg.norm(clear[:, 1, wrist] - clear[:, 1, other], axis=-1) > 60  # pixels
    assert off.sum() > 10
    there, without = prior.lift(stray), prior.lift(clear)
    assert (there.outlier_probability[off, 1, wrist] > 0.5).all()
    assert (there.keypoints_used[off, 1] < clear.shape[2]).all()
    assert (there.keypoints_seen[off, wrist] == len(AZIMUTHS) - 1).mean() > 0.9
    truth = capture.points3d[unseen][off]
    errors = [pa_mpjpe(lift.points3d[off], truth).mean for lift in (there, without)]
    assert errors[0] < errors[1] + 0.001  # metres


def test_of_two_views_of_a_keypoint_the_other_keypoints_decide_which_is_stray(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior
) -> None:
    clear = capture.keypoints[unseen]
    wrist, other = keypoint("left_wrist"), keypoint("right_wrist")
    clear[:, 2, wrist] = np.nan
    stray = clear.copy()
    stray[:, 1, wrist] = clear[:, 1, other]
    off = np.linalg.norm(clear[:, 1, wrist] - clear[:, 1, other], axis=-1) > 60  # pixels
    there, without = prior.lift(stray), prior.lift(clear)
    assert (there.outlier_probability[off, 1, wrist] > 0.5).mean() > 0.9
    assert (there.outlier_probability[off, 0, wrist] < 0.5).mean() > 0.8
    truth = capture.points3d[unseen][off]
    errors = [pa_mpjpe(lift.points3d[off], truth).mean for lift in (there, without)]
    assert errors[0] < errors[1] + 0.01  # metres


def test_stray_keypoints_are_used_without_outlier_rejection(
    capture: RigCapture,
) -> None:
    given = QUICK.model_copy(update={"outlier_rejection": False, "steps": 30})
    frames = capture.keypoints[:30]
    prior = fit(frames, given)
    frames[:, 1, keypoint("left_wrist")] += 150
    lift = prior.lift(frames)
    assert (lift.keypoints_used == frames.shape[2]).all()
    assert np.isnan(lift.outlier_probability).all()


def test_what_views_agree_about_is_believed_though_no_frame_had_it(
    capture: RigCapture, unseen: NDArray[np.int64], prior: FittedPrior
) -> None:
    """By the image alone it is an outlier in every view."""
    figure, wrist = capture.points3d[unseen].copy(), keypoint("left_wrist")
    figure[:, wrist] += 0.5 * (figure[:, wrist] - figure.mean(1))
    camera = figure[:, None] @ capture.rotations[unseen].mT
    camera += capture.translations[unseen][:, :, None]
    frames = np.stack([lens.project(camera[:, k]) for k, lens in enumerate(capture.lenses)], axis=1)
    judged = prior.observe(frames).outlier_probability
    assert judged is not None
    left_out = (judged[..., wrist] > 0.5).all(1)
    assert left_out.sum() > 10
    lift = prior.lift(frames)
    assert (lift.outlier_probability[left_out][..., wrist] < 0.5).mean() > 0.9
    errors = pa_mpjpe(lift.points3d[left_out], figure[left_out], reflection="never").errors
    assert np.median(errors[:, wrist]) < 0.02  # metres
