"""The shape model against SciPy's alignments and NumPy's decompositions."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation

from models.bundle.shape_model import (
    LEAST_ERROR,
    LEAST_SHARE,
    MOST_COMPONENTS,
    ShapeModel,
    StructureCovariances,
    align,
    learn_network_errors,
    learn_shapes,
    unknown_network_errors,
)

Float64 = NDArray[np.float64]
MIRROR = np.array([1.0, 1.0, -1.0])


def standard(points: Float64) -> Float64:
    """Centre a structure (P, 3) and give it root-mean-square radius 1."""
    centred: Float64 = points - points.mean(0)
    size: Float64 = np.sqrt(np.square(centred).sum(-1).mean())
    return centred / size


def procrustes(points: Float64, target: Float64) -> Float64:
    """Bring one structure onto another by the nearest rotation, scale and shift."""
    a, b = points - points.mean(0), target - target.mean(0)
    rotation, _ = Rotation.align_vectors(b, a)
    turned = rotation.apply(a)
    scale: float = (turned * b).sum() / np.square(a).sum()
    moved: Float64 = scale * turned
    return moved


def similarities(mean: Float64) -> Float64:
    """Directions (3 P, 7) in which shifts, scale and turns move a structure."""
    columns = [np.tile(axis, (len(mean), 1)) for axis in np.eye(3)]
    columns += [mean, *(np.cross(axis, mean) for axis in np.eye(3))]
    return np.stack([column.ravel() for column in columns], -1)


def without_similarities(rows: Float64, mean: Float64) -> Float64:
    """Remove from every row (N, 3 P) what a similarity of the mean explains."""
    axes = similarities(mean)
    found, *_ = np.linalg.lstsq(axes, rows.T, rcond=None)
    return rows - (axes @ found).T


def spread_of(model: ShapeModel) -> Float64:
    """Return B B^T, (3 P, 3 P)."""
    flat: Float64 = model.basis.reshape(-1, model.basis.shape[-1])
    return flat @ flat.T


def moved_about(structures: Float64, seed: int) -> tuple[Float64, Float64, Float64]:
    """Turn, scale and shift every structure at random; also the turns and the scales."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(len(structures), rng=seed).as_matrix()
    scales = rng.uniform(0.5, 3, len(structures))
    shifts = rng.standard_normal((len(structures), 1, 3))
    return scales[:, None, None] * structures @ turns.mT + shifts, turns, scales


def drawn(count: int, points: int, seed: int) -> Float64:
    """Draw structures that vary along three directions, and a little in all of them."""
    rng = np.random.default_rng(seed)
    mean = standard(rng.standard_normal((points, 3)))
    basis = np.array([0.15, 0.1, 0.07]) * rng.standard_normal((points, 3, 3)) / np.sqrt(3)
    z = rng.standard_normal((count, 3))
    varied: Float64 = mean + np.einsum("piq,nq->npi", basis, z)
    return varied + 0.03 * rng.standard_normal(varied.shape)


@pytest.mark.parametrize("targets", [1, 5])
def test_align_agrees_with_procrustes(targets: int) -> None:
    rng = np.random.default_rng(0)
    points = 3 * rng.standard_normal((5, 9, 3)) + 7
    points[1] = MIRROR * points[0]  # must not be mirrored back
    target = rng.standard_normal((targets, 9, 3)) - 4
    aligned, moved = align(points, target if targets > 1 else target[0])
    for n in range(5):
        expected = procrustes(points[n], target[n % targets])
        np.testing.assert_allclose(aligned[n], expected, atol=1e-9)
        again = moved.scales[n] * (points[n] - moved.centres[n]) @ moved.rotations[n]
        np.testing.assert_allclose(again, aligned[n])
    np.testing.assert_allclose(np.linalg.det(moved.rotations), 1)


def test_align_undoes_a_similarity_exactly() -> None:
    mean = standard(np.random.default_rng(1).standard_normal((8, 3)))
    points, turns, scales = moved_about(np.stack([mean] * 6), seed=2)
    aligned, moved = align(points, mean)
    np.testing.assert_allclose(aligned, np.stack([mean] * 6), atol=1e-12)
    np.testing.assert_allclose(moved.scales, 1 / scales)
    np.testing.assert_allclose(moved.rotations, turns, atol=1e-9)
    rotation, _ = orthogonal_procrustes(points[0] - points[0].mean(0), mean)
    np.testing.assert_allclose(moved.rotations[0], rotation, atol=1e-9)


def test_components_agree_with_a_decomposition_of_the_aligned_structures() -> None:
    points, _, _ = moved_about(drawn(200, 20, seed=3), seed=4)
    model = learn_shapes(points, None, floor=1e-6)
    mean: Float64 = model.mean
    np.testing.assert_allclose(mean, standard(mean), atol=1e-12)

    offsets = np.stack([procrustes(x, mean) - mean for x in points]).reshape(200, 60)
    rows = without_similarities(offsets, mean)
    np.testing.assert_allclose(rows.mean(0), 0, atol=1e-4)
    _, values, vt = np.linalg.svd(rows, full_matrices=False)
    variances = np.square(values) / 200
    rest = variances[MOST_COMPONENTS : 60 - 7].mean()
    assert model.spread == pytest.approx(np.sqrt(rest), rel=1e-3)
    kept = vt[:MOST_COMPONENTS]
    expected = kept.T @ np.diag(variances[:MOST_COMPONENTS] - rest) @ kept
    assert model.basis.shape == (20, 3, MOST_COMPONENTS)
    np.testing.assert_allclose(spread_of(model), expected, atol=1e-4 * np.abs(expected).max())
    # Nothing of a similarity is left for the cameras to dispute.
    flat: Float64 = model.basis.reshape(-1, model.basis.shape[-1])
    assert np.abs(similarities(mean).T @ flat).max() < 1e-9


def test_what_structures_vary_like_is_found_whatever_their_pose() -> None:
    structures = drawn(1500, 10, seed=5)
    points, _, _ = moved_about(structures, seed=6)
    still = learn_shapes(structures, None, floor=1e-6)
    model = learn_shapes(points, None, floor=1e-6)
    # The same model in another frame of reference.
    rotation, _ = Rotation.align_vectors(still.mean, model.mean)
    turn = np.kron(np.eye(10), rotation.as_matrix())
    np.testing.assert_allclose(rotation.apply(model.mean), still.mean, atol=1e-5)
    expected = spread_of(still)
    found = turn @ spread_of(model) @ turn.T
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    # Three directions stand out of what varies a little.
    strengths = np.sort(np.linalg.eigvalsh(expected))[::-1]
    assert strengths[2] > 5 * strengths[3]


def test_covariances_of_structures_count_as_their_variance() -> None:
    rng = np.random.default_rng(7)
    mean = standard(rng.standard_normal((6, 3)))
    root = 0.1 * rng.standard_normal((18, 18))
    halves = 0.1 * rng.standard_normal((6, 3, 3))
    covariance = root @ root.T  # of every structure, in the frame of the mean
    for at, half in zip(range(0, 18, 3), halves, strict=True):
        covariance[at : at + 3, at : at + 3] += half @ half.T
    points, turns, scales = moved_about(np.stack([mean] * 4), seed=8)
    moved = turns * scales[:, None, None]
    own = StructureCovariances(
        moved[:, None] @ halves @ halves.mT @ moved.mT[:, None],
        np.stack([np.kron(np.eye(6), each) @ root for each in moved]),
    )
    model = learn_shapes(points, own, floor=1e-6)
    rotation, _ = Rotation.align_vectors(model.mean, mean)
    turn = np.kron(np.eye(6), rotation.as_matrix())
    rows = without_similarities(turn @ covariance @ turn.T, model.mean)
    expected = without_similarities(rows.T, model.mean)
    values = np.linalg.eigvalsh(expected)[7:]
    assert model.spread == pytest.approx(np.sqrt(values[0]), rel=1e-6)
    free = without_similarities(np.eye(18), model.mean)
    np.testing.assert_allclose(spread_of(model) + model.spread**2 * free, expected, atol=1e-9)


def test_structures_that_do_not_vary_leave_the_least_spread() -> None:
    mean = standard(np.random.default_rng(9).standard_normal((7, 3)))
    points, _, _ = moved_about(np.stack([mean] * 5), seed=10)
    model = learn_shapes(points, None, floor=0.02)
    assert model.spread == 0.02
    assert model.basis.shape == (7, 3, 0)
    np.testing.assert_allclose(model.mean, procrustes(mean, model.mean), atol=1e-9)


def test_network_errors_have_a_scale_for_each_number_of_views() -> None:
    rng = np.random.default_rng(11)
    mean = standard(rng.standard_normal((20, 3)))
    pattern = rng.standard_normal((20, 3))
    sizes = (0.4, 0.2, 0.1)
    errors = [
        size * (rng.choice([-1, 1], (300, 1, 1)) * pattern + rng.standard_normal((300, 20, 3)))
        for size in sizes
    ]
    errors[0][:20] *= 1000  # what is off by far does not decide
    everything = [np.ones(300, np.bool_)] * 3
    learnt = learn_network_errors(errors, everything, mean)
    for scale, part in zip(learnt.scales.tolist(), errors, strict=True):
        usual = np.median(np.sqrt(np.square(part).sum(-1).mean(-1)))
        assert scale == pytest.approx(usual, rel=0.01)
    # The pattern comes first among what they have in common, whatever the number of views.
    strongest = np.linalg.eigh(spread_of(ShapeModel(mean, learnt.basis, 1.0)))[1][:, -1]
    along = without_similarities(pattern.reshape(1, -1), mean)[0]
    assert abs(strongest @ along) / np.linalg.norm(along) > 0.99
    # Three coordinates share the error of a keypoint.
    total = spread_of(ShapeModel(mean, learnt.basis, 1.0)).trace() / 53
    assert total + learnt.spread**2 == pytest.approx(1 / 3, rel=0.15)


def test_sizes_of_errors_are_learnt_from_some_frames_alone() -> None:
    rng = np.random.default_rng(13)
    mean = standard(rng.standard_normal((6, 3)))
    errors = 0.1 * rng.standard_normal((200, 6, 3))
    some = np.arange(200) >= 150
    errors[some] *= 3
    learnt = learn_network_errors([errors], [some], mean)
    usual = np.median(np.sqrt(np.square(errors[some]).sum(-1).mean(-1)))
    assert learnt.scales[0] == pytest.approx(usual, rel=0.05)


def test_a_network_without_errors_is_believed_to_have_small_ones_all_the_same() -> None:
    nothing = np.zeros((10, 5, 3))
    mean = standard(np.random.default_rng(12).standard_normal((5, 3)))
    learnt = learn_network_errors([nothing], [np.ones(10, np.bool_)], mean)
    assert learnt.scales.tolist() == [LEAST_ERROR]
    assert learnt.spread == LEAST_SHARE
    assert learnt.basis.shape == (5, 3, 0)
    assert unknown_network_errors(5).basis.shape == (5, 3, 0)
    assert unknown_network_errors(5).scales.tolist() == []
