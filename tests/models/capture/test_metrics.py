import numpy as np
import pytest
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from models.capture.metrics import pa_mpjpe, pck, procrustes_by_size


def _structures(frames: int = 6, keypoints: int = 9, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((frames, keypoints, 3))


def test_similarity_transforms_cost_nothing() -> None:
    truth = _structures()
    turns = Rotation.random(len(truth), random_state=1).as_matrix()
    points = 7.0 * truth @ turns.mT + np.arange(3.0)
    accuracy = pa_mpjpe(points, truth)
    assert accuracy.mean < 1e-12
    assert not accuracy.reflected


def test_rotation_agrees_with_scipy_align_vectors() -> None:
    truth, points = _structures(seed=1), _structures(seed=2)
    x = points - points.mean(1, keepdims=True)
    y = truth - truth.mean(1, keepdims=True)
    x *= np.linalg.norm(y, axis=(1, 2), keepdims=True) / np.linalg.norm(
        x, axis=(1, 2), keepdims=True
    )
    for frame in range(len(truth)):
        turn, _ = Rotation.align_vectors(y[frame], x[frame])
        np.testing.assert_allclose(
            procrustes_by_size(points, truth)[frame],
            turn.apply(x[frame]) + truth[frame].mean(0),
            atol=1e-9,
        )


def test_agrees_with_scipy_procrustes_where_that_is_comparable() -> None:
    # SciPy normalises both to unit size, takes the least-squares scale, and may reflect; compare
    # on structures near the truth (no reflection) after undoing its scale with the trace.
    truth = _structures(frames=1)
    points = truth + 0.1 * _structures(frames=1, seed=3)
    _, _, disparity = procrustes(truth[0], points[0])
    aligned = procrustes_by_size(points, truth)[0]
    centred = truth[0] - truth[0].mean(0)
    size = np.linalg.norm(centred)
    cosine = ((aligned - truth[0].mean(0)) * centred).sum() / size**2
    assert disparity == pytest.approx(1 - cosine**2, rel=1e-9)
    # Same size as the truth, not the shrunken least-squares one.
    assert np.linalg.norm(aligned - aligned.mean(0)) == pytest.approx(size)


def test_mirroring_is_for_all_frames_or_none() -> None:
    truth = _structures(frames=10)
    mirrored = truth * [-1, 1, 1]
    accuracy = pa_mpjpe(mirrored, truth)
    assert accuracy.reflected
    assert accuracy.mean < 1e-12
    assert pa_mpjpe(mirrored, truth, reflection="never").mean > 0.1

    one_wrong = truth.copy()
    one_wrong[3] *= [-1, 1, 1]
    accuracy = pa_mpjpe(one_wrong, truth)
    assert not accuracy.reflected
    assert accuracy.per_frame[3] > 0.1
    assert np.delete(accuracy.per_frame, 3).max() < 1e-12


def test_gaps_in_the_truth_count_for_nothing() -> None:
    truth, points = _structures(), _structures(seed=4)
    expected = pa_mpjpe(np.delete(points, 2, axis=1), np.delete(truth, 2, axis=1))
    with_gap = truth.copy()
    with_gap[:, 2] = np.nan
    accuracy = pa_mpjpe(points, with_gap)
    np.testing.assert_allclose(accuracy.per_frame, expected.per_frame)
    assert np.isnan(accuracy.errors[:, 2]).all()

    with_gap[0] = np.nan
    points[1] = np.nan
    accuracy = pa_mpjpe(points, with_gap)
    assert np.isnan(accuracy.per_frame[:2]).all()
    assert accuracy.mean == pytest.approx(accuracy.per_frame[2:].mean())


def test_two_shared_keypoints_are_too_few_to_align() -> None:
    truth, points = _structures(), _structures(seed=4)
    truth[0, 2:], points[1, 2:], truth[2, 3:] = np.nan, np.nan, np.nan
    few = np.isnan(pa_mpjpe(points, truth).per_frame)
    assert few.tolist() == [True, True, False, False, False, False]


def test_a_collapsed_structure_is_as_bad_as_the_truth_is_large() -> None:
    truth = _structures(frames=1)
    accuracy = pa_mpjpe(np.zeros_like(truth), truth)
    expected = np.linalg.norm(truth - truth.mean(1, keepdims=True), axis=-1).mean()
    assert accuracy.mean == pytest.approx(expected)


def test_pck_counts_known_keypoints_under_the_threshold() -> None:
    truth = _structures(frames=30)
    accuracy = pa_mpjpe(truth + 0.1 * _structures(frames=30, seed=5), truth)
    errors = np.sort(accuracy.errors.ravel())
    assert pck(accuracy, float((errors[99] + errors[100]) / 2)) == pytest.approx(100 / errors.size)
    assert pck(accuracy, 1e9) == 1
    assert np.isnan(pck(pa_mpjpe(truth, np.full_like(truth, np.nan)), 0.1))


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"\(frames, keypoints, 3\)"):
        procrustes_by_size(np.zeros((2, 5, 3)), np.zeros((2, 6, 3)))
