"""Lengths of a skeleton, against a figure whose limbs are as long as they are."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle.problem import Rig, Views, make_rig
from models.capture.metrics import pa_mpjpe
from models.capture.synthetic import EDGES
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.lifting.skeleton_lengths import SkeletonLengths, learn_skeleton_lengths
from models.network.answers import RIG_NOT_USED, make_answers
from models.numerics.tensor_files import WeightsError
from models.optics.lenses.projection import Lenses
from models.settings.config import FitConfig
from models.training.trainer import Trainer, fit
from tests.models.lifting.comparison import without
from tests.models.rigs import FOCAL, Float64, RigCapture, keypoint, make_rig_capture
from tests.sharing import fitted_once

AZIMUTHS = [0.0, 70.0]
NOISE = 10.0  # pixels: 37 mm in a figure 4 m away
WANDERING = 0.02  # metres that structures of a lift are off
JOINED = np.array(EDGES)
LIMBS = [(keypoint("left_elbow"), keypoint("left_wrist")), (keypoint("neck"), keypoint("head"))]
QUICK = FitConfig(steps=60, dictionary_sizes=(16, 8), batch_size=16)


def lengths(points: NDArray[np.floating[Any]]) -> Float64:
    """Return the lengths (N, E) of the figure's edges."""
    apart = points[:, JOINED[:, 0]] - points[:, JOINED[:, 1]]
    return np.asarray(np.linalg.norm(apart, axis=-1), np.float64)


def stretched(points: Float64, edges: list[tuple[int, int]]) -> Float64:
    """Return the figure with limbs that grow and shrink by a quarter."""
    moved = points.copy()
    share = 0.25 * np.sin(np.arange(len(points)))[:, None]
    for inner, outer in edges:
        moved[:, outer] += share * (points[:, outer] - points[:, inner])
    return moved


def seen_by_cameras(points: Float64, capture: RigCapture, noise: float) -> Float64:
    camera = points[:, None] @ capture.rotations.mT + capture.translations[:, :, None]
    pixels = np.stack([lens.project(camera[:, k]) for k, lens in enumerate(capture.lenses)], axis=1)
    return pixels + noise * np.random.default_rng(1).standard_normal(pixels.shape)


def learn(points: Float64, capture: RigCapture, noise: float) -> SkeletonLengths | None:
    """Learn from a lift that is off, in the frame of the room, and from noisy keypoints."""
    frames, views, count = *capture.rotations.shape[:2], points.shape[1]
    wandering = WANDERING * np.random.default_rng(2).standard_normal(points.shape)
    answers = make_answers(frames, views, count)
    answers.points3d[:], answers.rotations[:] = points + wandering, capture.rotations
    answers.translations[:], answers.camera_models[:], answers.findings[:] = (
        capture.translations,
        1,
        0,
    )
    pixels = seen_by_cameras(points, capture, noise)
    return learn_skeleton_lengths(
        JOINED,
        LiftedFrames(*answers),
        Views(pixels, np.ones(pixels.shape[:3])),
        rig_of(capture),
        unit=1.0,
        noise=noise,
    )


def rig_of(capture: RigCapture) -> Rig:
    focals = np.array([[lens.focal] * 2 for lens in capture.lenses])
    views = len(focals)
    centres = np.array([lens.centre for lens in capture.lenses])
    lenses = Lenses(focals, centres, np.zeros((views, 8)), np.zeros(views, np.int8))
    groups = np.zeros(views, np.int64)
    return make_rig(lenses, groups, capture.rotations[0], capture.translations[0])


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=400, noise=0, hidden=0, seed=3)


def edges_of(learnt: SkeletonLengths) -> set[tuple[int, int]]:
    return {(int(a), int(b)) for a, b in learnt.ends.T}


def test_lengths_that_stay_are_found_under_noise(capture: RigCapture) -> None:
    learnt = learn(capture.points3d, capture, NOISE)
    assert learnt is not None
    assert edges_of(learnt) == set(EDGES)
    # 400 frames, each with an error of some 50 mm.
    np.testing.assert_allclose(learnt.lengths, lengths(capture.points3d)[0], atol=0.012)
    assert (learnt.scatter < 0.025).all()


def test_lengths_that_change_are_left_alone(capture: RigCapture) -> None:
    figure = stretched(capture.points3d, [(keypoint("left_knee"), keypoint("left_ankle"))])
    learnt = learn(figure, capture, NOISE)
    assert learnt is not None
    assert set(EDGES) - edges_of(learnt) == {(keypoint("left_knee"), keypoint("left_ankle"))}


def test_clear_keypoints_need_no_lengths(capture: RigCapture) -> None:
    assert learn(capture.points3d, capture, 0.3) is None


@pytest.fixture(scope="module")
def noisy() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=80, noise=NOISE, hidden=0.02, seed=4)


@pytest.fixture(scope="module")
def prior(noisy: RigCapture) -> FittedPrior:
    return fitted_once("skeleton", lambda: fit(noisy.keypoints, QUICK, edges=JOINED))


@pytest.fixture(scope="module")
def plain(prior: FittedPrior) -> FittedPrior:
    """Return the same prior as files have it that know nothing of a skeleton."""
    return without(prior, "skeleton")


def test_limbs_of_noisy_lifts_keep_their_lengths(
    noisy: RigCapture, prior: FittedPrior, plain: FittedPrior
) -> None:
    held, loose = (p.lift(noisy.keypoints) for p in (prior, plain))
    in_rig = (held.camera_models > 0).all(1) & (held.findings & RIG_NOT_USED == 0)
    assert in_rig.mean() > 0.6
    truth = noisy.points3d[in_rig]
    errors, scatter = [], []
    for lift in (held, loose):
        points = lift.points3d[in_rig]
        errors.append(pa_mpjpe(points, truth, reflection="never").mean)
        scatter.append((lengths(points).std(0) / lengths(points).mean(0)).mean())
    assert errors[0] < 0.93 * errors[1]
    assert scatter[0] < 0.1 * scatter[1]
    np.testing.assert_array_equal(held.rotations, loose.rotations)


def test_two_noisy_views_have_the_right_lenses(prior: FittedPrior) -> None:
    cameras = prior.cameras
    assert cameras is not None
    off = np.abs(cameras.focals[:, 0] - FOCAL)
    assert (off < 0.05 * FOCAL).all()
    assert (off < 3 * cameras.focal_sds).all()


@pytest.mark.thorough
def test_edges_change_nothing_where_keypoints_are_clear() -> None:
    clear = make_rig_capture(AZIMUTHS, frames=45, noise=0.3, hidden=0, seed=5)
    quick = QUICK.model_copy(update={"steps": 5})
    with_edges, without = (fit(clear.keypoints, quick, edges=e) for e in (JOINED, None))
    assert with_edges.to_bytes() == without.to_bytes()


def test_what_lengths_do_not_determine_is_as_without_them(
    noisy: RigCapture, prior: FittedPrior, plain: FittedPrior
) -> None:
    """The network's answers, frames of one view, cameras unknown to the fit."""
    assert prior.holds_lengths
    assert not plain.holds_lengths
    both, one = noisy.keypoints[:40], noisy.keypoints[:40, :1]
    alone = both.copy()
    alone[:, 1] = np.nan
    for frames, fields in (
        (both, {"refine": "off"}),
        (one, {"views": [0]}),
        (one, {}),
        (alone, {}),
    ):
        with_lengths, without = (p.lift(frames, **fields) for p in (prior, plain))
        for name, array in with_lengths.arrays.items():
            np.testing.assert_array_equal(array, getattr(without, name), err_msg=name)


def test_lengths_travel_with_the_prior(noisy: RigCapture, prior: FittedPrior) -> None:
    again = FittedPrior.from_bytes(prior.to_bytes())
    assert again.holds_lengths
    frames = noisy.keypoints[:40]
    np.testing.assert_array_equal(again.lift(frames).points3d, prior.lift(frames).points3d)


@pytest.mark.parametrize("wrong", ["ends", "lengths", "scatter", "beyond"])
def test_a_file_that_contradicts_itself_is_refused(capture: RigCapture, wrong: str) -> None:
    learnt = learn(capture.points3d, capture, NOISE)
    assert learnt is not None
    arrays = learnt.to_arrays()
    if wrong == "beyond":
        arrays["ends"][0, 0] = capture.points3d.shape[1]
    else:
        arrays[wrong] = arrays[wrong][..., :-1]
    with pytest.raises(WeightsError, match="skeleton"):
        SkeletonLengths.from_arrays(arrays, capture.points3d.shape[1])


@pytest.mark.parametrize(
    "edges", [[[0, 16]], [[3, 3]], [[-1, 2]], [[0, 1, 2]], [0, 1], [[0.5, 1.0]]]
)
def test_edges_that_name_no_two_keypoints_are_refused(noisy: RigCapture, edges: list[Any]) -> None:
    with pytest.raises(ValueError, match="edges must"):
        Trainer(noisy.keypoints, QUICK, edges=edges)


def test_a_checkpoint_is_for_the_same_edges(noisy: RigCapture) -> None:
    frames = noisy.keypoints[:45]
    saved = Trainer(frames, QUICK, edges=JOINED).checkpoint()
    Trainer(frames, QUICK, edges=JOINED[::-1], checkpoint=saved)  # in any order
    with pytest.raises(WeightsError, match="other keypoints"):
        Trainer(frames, QUICK, edges=JOINED[:-1], checkpoint=saved)
