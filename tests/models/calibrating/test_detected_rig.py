"""Cameras that are adjusted to noisy keypoints, against those that saw a figure without noise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models.bundle.adjustment import ROTATION, TRANSLATION, RigPrior
from models.bundle.instrumental_equations import NoisyFrames
from models.bundle.problem import FOCAL, VIEW, Rig, make_rig
from models.calibrating.detected_rig import adjust_to_detected
from models.capture.synthetic import EDGES
from models.numerics.steps import finished
from models.optics.lenses.projection import Lenses
from tests.models.rigs import FOCAL as TRUE_FOCAL
from tests.models.rigs import Float64, RigCapture, keypoint, make_rig_capture

JOINED = np.array(EDGES)
NOISE = 10.0  # pixels
PULLED = 0.1  # of the way to where a keypoint usually is, as removing noise pulls


def rig_of(capture: RigCapture, *, focal: float = TRUE_FOCAL, turned: float = 0.0) -> Rig:
    """Return the true rig, or one with other lenses whose second camera is turned by degrees."""
    views = len(capture.lenses)
    lenses = Lenses(
        np.full((views, 2), focal),
        np.array([lens.centre for lens in capture.lenses]),
        np.zeros((views, 8)),
        np.zeros(views, np.int8),
    )
    rotations, translations = capture.rotations[0].copy(), capture.translations[0] * 1.0
    rotations[1] = Rotation.from_euler("y", turned, degrees=True).as_matrix() @ rotations[1]
    return make_rig(lenses, np.zeros(views, np.int64), rotations, translations)


def believed_of(rig: Rig) -> RigPrior:
    """Return next to no belief in focal lengths, which are alike, and none in where cameras are."""
    views = len(rig.groups)
    free = np.zeros((views, VIEW), np.bool_)
    free[:, FOCAL] = True
    free[1:, ROTATION] = free[1:, TRANSLATION] = True
    focals = VIEW * np.arange(views)
    precision = np.zeros((VIEW * views, VIEW * views))
    together = np.full((views, views), 0.5**2) + np.diag(np.full(views, 0.01**2))
    precision[np.ix_(focals, focals)] = np.linalg.inv(together)
    return RigPrior(rig, precision, free.ravel())


def frames_of(capture: RigCapture, *, noise: float = NOISE, pulled: float = PULLED) -> NoisyFrames:
    exact = capture.keypoints
    clear = exact + pulled * (exact.mean(0) - exact)
    detected = exact + noise * np.random.default_rng(5).standard_normal(exact.shape)
    return NoisyFrames(clear, detected, np.ones(exact.shape[:3]), max(noise, 0.1))


def adjusted(
    capture: RigCapture, start: Rig, frames: NoisyFrames, edges: Float64 | None = None
) -> tuple[Rig, Float64]:
    joined = JOINED if edges is None else np.asarray(edges, np.int64).reshape(-1, 2)
    found = finished(adjust_to_detected(frames, joined, start, believed_of(start)))
    assert found is not None
    return found


def turned_by(found: Rig, capture: RigCapture) -> float:
    """Degrees between the pose of the second view relative to the first, and the true one."""
    between = [turns[1] @ turns[0].T for turns in (found.rotations, capture.rotations[0])]
    return float(np.degrees(Rotation.from_matrix(between[0] @ between[1].T).magnitude()))


@pytest.fixture(scope="module")
def pair() -> RigCapture:
    return make_rig_capture([0.0, 80.0], frames=600, noise=0, hidden=0, seed=3)


def test_exact_keypoints_give_the_exact_rig() -> None:
    """Three views determine it without a skeleton."""
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=60, noise=0, hidden=0)
    start = rig_of(capture, focal=1.1 * TRUE_FOCAL, turned=4.0)
    frames = frames_of(capture, noise=0, pulled=0)
    rig, _ = adjusted(capture, start, frames, np.zeros(0))
    np.testing.assert_allclose(rig.lenses.focals, TRUE_FOCAL, rtol=1e-3)
    assert turned_by(rig, capture) < 0.05


@pytest.mark.parametrize("wrong", [0.85, 1.2])
def test_two_views_and_a_skeleton_determine_the_focal_length_under_noise(
    pair: RigCapture, wrong: float
) -> None:
    start = rig_of(pair, focal=wrong * TRUE_FOCAL, turned=5.0)
    rig, sds = adjusted(pair, start, frames_of(pair))
    off = np.log(rig.lenses.focals[:, 0] / TRUE_FOCAL)
    assert np.abs(off).max() < 0.05
    assert (np.abs(off) < 3 * sds[:, FOCAL]).all()
    assert turned_by(rig, pair) < 1.5


def test_clear_keypoints_in_their_place_lead_astray(pair: RigCapture) -> None:
    """The right-hand sides must be what was detected."""
    start, frames = rig_of(pair, focal=0.9 * TRUE_FOCAL), frames_of(pair)
    unpulled, _ = adjusted(pair, start, frames)
    pulled, _ = adjusted(pair, start, frames._replace(detected=frames.clear))
    off = [abs(float(np.log(rig.lenses.focals[0, 0] / TRUE_FOCAL))) for rig in (unpulled, pulled)]
    assert off[1] > 2 * off[0]


def test_edges_that_stretch_are_less_informative(pair: RigCapture) -> None:
    figure = pair.points3d.copy()
    limbs = np.random.default_rng(4).uniform(0.4, 1.6, (len(figure), len(EDGES)))
    for number, (inner, outer) in enumerate(EDGES):
        figure[:, outer] += (limbs[:, number, None] - 1) * (figure[:, outer] - figure[:, inner])
    camera = figure[:, None] @ pair.rotations.mT + pair.translations[:, :, None]
    seen = np.stack([lens.project(camera[:, k]) for k, lens in enumerate(pair.lenses)], axis=1)
    stretching = RigCapture(seen, figure, pair.rotations, pair.translations, pair.lenses)
    start = rig_of(pair, focal=0.95 * TRUE_FOCAL)
    _, steady = adjusted(pair, start, frames_of(pair))
    _, loose = adjusted(stretching, start, frames_of(stretching))
    assert loose[0, FOCAL] > 1.5 * steady[0, FOCAL]


def test_what_is_not_seen_does_not_count_for_the_lenses(pair: RigCapture) -> None:
    frames, start = frames_of(pair), rig_of(pair, focal=0.9 * TRUE_FOCAL)
    whole, _ = adjusted(pair, start, frames)
    head = keypoint("head")
    weights = frames.weights.copy()
    weights[::2, 1, head] = 0
    hidden = frames._replace(weights=weights)
    first, _ = adjusted(pair, start, hidden)
    detected, clear = frames.detected.copy(), frames.clear.copy()
    detected[::2, 1, head] = clear[::2, 1, head] = 1e6
    spoilt = hidden._replace(detected=detected, clear=clear)
    second, _ = adjusted(pair, start, spoilt)
    np.testing.assert_array_equal(first.lenses.focals, second.lenses.focals)
    np.testing.assert_allclose(first.lenses.focals, whole.lenses.focals, rtol=0.03)


def test_more_edges_than_can_be_asked_are_thinned_out(pair: RigCapture) -> None:
    start, frames = rig_of(pair, focal=0.9 * TRUE_FOCAL), frames_of(pair)
    rig, _ = adjusted(pair, start, frames, np.tile(JOINED, (20, 1)))
    np.testing.assert_allclose(rig.lenses.focals, TRUE_FOCAL, rtol=0.06)


def test_undetermined_numbers_are_reported(pair: RigCapture) -> None:
    frames, start = frames_of(pair), rig_of(pair)
    nothing = frames._replace(weights=np.zeros_like(frames.weights))
    with pytest.raises(np.linalg.LinAlgError):
        adjusted(pair, start, nothing)
