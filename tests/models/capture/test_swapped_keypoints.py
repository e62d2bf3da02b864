"""Left and right taken for each other, against those that were planted and SciPy's likelihoods."""

from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from models.capture.observations import as_observations, pixels_of
from models.capture.outliers import OLD_FREEDOM, OutlierJudge, OutlierModel, learn_outliers
from models.capture.swapped_keypoints import SURE
from models.capture.synthetic import KEYPOINT_NAMES, synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from models.settings.keypoints import OUTLIER
from models.training.trainer import fit
from tests.models.rigs import Float64

Bool = NDArray[np.bool_]

FRAMES, VIEWS, NOISE = 800, 3, 2.0
PAIRS = [
    (KEYPOINT_NAMES.index(name), KEYPOINT_NAMES.index(name.replace("left", "right")))
    for name in KEYPOINT_NAMES
    if name.startswith("left")
]
PARTNERS = np.arange(len(KEYPOINT_NAMES))
PARTNERS[np.array(PAIRS)] = np.array(PAIRS)[:, ::-1]


class Swapped(NamedTuple):
    clean: Float64  # (N, K, P, 2)
    keypoints: Float64  # (N, K, P, 2)
    planted: Bool  # (N, K, P)


def static_capture() -> Float64:
    """Return keypoints (N, K, P, 2) with some noise, before static cameras."""
    made = synthetic_capture(frames=FRAMES, views=VIEWS, seed=1)
    points = np.concatenate((made.points3d, np.ones((*made.points3d.shape[:2], 1))), -1)
    image = points[:, None] @ made.projections[0].mT
    exact = image[..., :2] / image[..., 2:]
    return np.asarray(exact + np.random.default_rng(2).normal(0, NOISE, exact.shape))


def swap(clean: Float64) -> Swapped:
    """Swap the arms, the legs or all limbs in a twentieth of the views."""
    rng = np.random.default_rng(3)
    limbs = [[p for p in PAIRS if KEYPOINT_NAMES[p[0]].endswith(end)] for end in ("ankle", "wrist")]
    limbs[0] += [p for p in PAIRS if KEYPOINT_NAMES[p[0]].endswith("knee")]
    limbs[1] += [p for p in PAIRS if KEYPOINT_NAMES[p[0]].endswith("elbow")]
    limbs.append(PAIRS)
    planted = np.zeros(clean.shape[:3], np.bool_)
    for n, k in np.argwhere(rng.random(clean.shape[:2]) < 0.05):
        planted[n, k, np.array(limbs[rng.integers(3)]).ravel()] = True
    return Swapped(clean, np.where(planted[..., None], clean[:, :, PARTNERS], clean), planted)


@pytest.fixture(scope="module")
def swapped() -> Swapped:
    return swap(static_capture())


@pytest.fixture(scope="module")
def model(swapped: Swapped) -> OutlierModel:
    found = learn_outliers(as_observations(swapped.keypoints))
    assert found is not None
    return found


def apart(swapped: Swapped) -> Bool:
    """Say which keypoints (N, K, P) noise does not mix up with their partners."""
    distances = np.linalg.norm(swapped.clean - swapped.clean[:, :, PARTNERS], axis=-1)
    return np.asarray(distances > 20 * NOISE)


def test_left_and_right_are_found(model: OutlierModel) -> None:
    """Hips lie so close together that they may or may not be among them."""
    found = {tuple(sorted(pair)) for pair in model.pairs.tolist()}
    assert found <= set(PAIRS)
    assert len(found) >= 4


def test_what_was_swapped_is_put_right(model: OutlierModel, swapped: Swapped) -> None:
    confidence = np.random.default_rng(4).uniform(0.2, 1, swapped.planted.shape).round(2)
    moved = np.where(swapped.planted, confidence[:, :, PARTNERS], confidence)
    observations = as_observations(swapped.keypoints, moved)
    mended, found = OutlierJudge(model, range(VIEWS)).put_right(observations)
    clear = apart(swapped)
    assert found[swapped.planted & clear].mean() > 0.8
    assert found[~swapped.planted & clear].mean() < 0.005
    right = found == swapped.planted
    np.testing.assert_allclose(pixels_of(mended)[0][right], swapped.clean[right], atol=1e-3)
    np.testing.assert_allclose(mended.weights[right], confidence[right], atol=1e-6)


@pytest.mark.parametrize(("views", "gaps"), [((0, 1, 2), 0.1), ((2, 0), 0.0)])
def test_gaps_and_some_of_the_views_are_no_hindrance(
    model: OutlierModel, swapped: Swapped, views: tuple[int, ...], gaps: float
) -> None:
    some = np.ix_(range(FRAMES), views)
    hidden = (np.random.default_rng(5).random(swapped.planted.shape) < gaps)[some]
    keypoints = np.where(hidden[..., None], np.nan, swapped.keypoints[some])
    mended, found = OutlierJudge(model, views).put_right(as_observations(keypoints))
    np.testing.assert_array_equal(pixels_of(mended)[1], ~hidden)
    both = ~(hidden | hidden[:, :, PARTNERS])
    assert not found[~both].any()  # a partner that is hidden cannot change places
    planted, clear = swapped.planted[some], apart(swapped)[some]
    assert found[planted & clear & both].mean() > 0.7
    assert found[~planted & clear & both].mean() < 0.01


def test_one_view_alone_may_show_the_subject_from_behind(
    model: OutlierModel, swapped: Swapped
) -> None:
    observations = as_observations(swapped.keypoints[:, [1]])
    same, found = OutlierJudge(model, (1,)).put_right(observations)
    assert same is observations
    assert not found.any()


@pytest.mark.parametrize("noise", [0.0, 15.0])
def test_nothing_is_swapped_where_nothing_was(swapped: Swapped, noise: float) -> None:
    noisy = swapped.clean + np.random.default_rng(6).normal(0, 1, swapped.clean.shape) * noise
    rng = np.random.default_rng(7)
    tails = rng.standard_t(2, noisy.shape) * (rng.random(noisy.shape[:3]) < 0.1)[..., None] * 10
    for keypoints in (noisy, noisy + tails):
        model = learn_outliers(as_observations(keypoints))
        assert model is not None
        assert len(model.pairs) == 0


def test_frames_unlike_those_of_the_fit_are_left_alone(model: OutlierModel) -> None:
    """Another seed has other poses, seen by other cameras."""
    other = synthetic_capture(frames=50, views=VIEWS, seed=9)
    points = np.concatenate((other.points3d, np.ones((50, len(KEYPOINT_NAMES), 1))), -1)
    image = points[:, None] @ other.projections[0].mT
    _, found = OutlierJudge(model, range(VIEWS)).put_right(
        as_observations(image[..., :2] / image[..., 2:])
    )
    assert found.mean() < 0.05


def test_the_likeliest_frame_is_found() -> None:
    """All ways to swap pairs in one view are tried with SciPy; frames have gaps."""
    rng = np.random.default_rng(8)
    views, count, size = 2, 7, 4
    pairs = np.array([[0, 1], [2, 3], [5, 4]])
    model = OutlierModel(
        rng.normal(0, 30, (views, count, 2)),
        rng.normal(0, 40, (views, count, 2, size)),
        1.5,
        np.full((views, count), 2.0),
        6.0,
        np.full(views, 500.0),
        0.01,
        pairs,
    )
    basis = model.basis.reshape(-1, size)
    covariance = basis @ basis.T + model.noise**2 * np.eye(len(basis))
    frames = model.mean + (rng.standard_normal((40, size)) @ basis.T).reshape(-1, views, count, 2)
    frames += rng.normal(0, model.noise, frames.shape)
    hidden = rng.random(frames.shape[:3]) < 0.1
    hidden[:20] = False
    planted = rng.random((40, 3)) < 0.4
    for frame, turned in zip(frames, planted, strict=True):
        exchange(frame[0], pairs[turned])
    mended, _ = OutlierJudge(model, range(views)).put_right(
        as_observations(np.where(hidden[..., None], np.nan, frames))
    )
    found, observed = pixels_of(mended)
    for n, frame in enumerate(frames):
        there = np.repeat(observed[n].ravel(), 2)
        law = multivariate_normal(np.zeros(there.sum()), covariance[np.ix_(there, there)])
        trials = [frame]
        for view, turned in product(range(views), product((False, True), repeat=3)):
            trial = frame.copy()
            shown = [pair for pair in pairs[list(turned)] if observed[n, view, pair].all()]
            exchange(trial[view], np.array(shown, np.int64).reshape(-1, 2))
            trials.append(trial)
        logs = [law.logpdf((trial - model.mean).ravel()[there]) for trial in trials]
        best = trials[int(np.argmax(logs))]
        usual = max(1.0, (2 * (law.logpdf(np.zeros(there.sum())) - max(logs))) / there.sum())
        expected = best if 2 * (max(logs) - logs[0]) >= SURE * usual else frame
        shown = observed[n]
        np.testing.assert_allclose(found[n][shown], expected[shown], atol=1e-3)


def exchange(view: Float64, pairs: NDArray[np.integer]) -> None:
    for a, b in pairs:
        view[[a, b]] = view[[b, a]]


def test_a_fit_and_its_lifts_put_them_right(swapped: Swapped) -> None:
    quick = FitConfig(steps=30, dictionary_sizes=(16, 8), batch_size=8, refine="off")
    prior = fit(swapped.keypoints, quick)
    codes = [finding.code for finding in prior.findings]
    assert "left_right_mended" in codes
    assert "left_right_swapped" not in codes
    mended = prior.findings[codes.index("left_right_mended")]
    assert set(mended.keypoints) == set(np.array(PAIRS).ravel().tolist())
    assert mended.views == (0, 1, 2)
    lift = prior.lift(swapped.keypoints)
    clear = apart(swapped)
    learnt = learn_outliers(as_observations(swapped.keypoints))
    assert learnt is not None
    clean = OutlierJudge(learnt, range(VIEWS)).without_outliers(as_observations(swapped.clean))
    assert not clean.swapped.any()
    assert (prior.lift(swapped.clean).outlier_probability > OUTLIER).mean() < 0.001
    assert (lift.outlier_probability[swapped.planted & clear] == 1).mean() > 0.8
    assert lift.keypoints_used.mean() > 0.99 * VIEWS  # none of them is left out
    again = FittedPrior.from_bytes(prior.to_bytes()).lift(swapped.keypoints)
    np.testing.assert_array_equal(again.points3d, lift.points3d)
    keeping = fit(swapped.keypoints, quick.model_copy(update={"outlier_rejection": False}))
    assert "left_right_mended" not in [finding.code for finding in keeping.findings]


@pytest.mark.parametrize("pairs", [[[0, 1], [1, 2]], [[0, 99]], [[-1, 3]]])
def test_pairs_that_cannot_be_are_refused(model: OutlierModel, pairs: list[list[int]]) -> None:
    arrays = model._replace(pairs=np.array(pairs)).to_arrays()
    with pytest.raises(WeightsError, match="outliers"):
        OutlierModel.from_arrays(arrays)


def test_files_of_before_knew_less(model: OutlierModel) -> None:
    arrays = model.to_arrays()
    del arrays["freedom"]
    assert arrays.keys() == OutlierModel.shapes(len(KEYPOINT_NAMES), "pairs").keys()
    assert OutlierModel.from_arrays(arrays).freedom == OLD_FREEDOM
    del arrays["pairs"]
    assert arrays.keys() == OutlierModel.shapes(len(KEYPOINT_NAMES), "yes").keys()
    assert len(OutlierModel.from_arrays(arrays).pairs) == 0
