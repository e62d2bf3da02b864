import numpy as np
import pytest

from models.capture.synthetic import synthetic_capture


def test_keypoints_are_the_projections_of_the_points() -> None:
    capture = synthetic_capture(frames=5, views=3, seed=4)
    for frame in range(5):
        for view in range(3):
            rotation = capture.rotations[frame, view]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) == pytest.approx(1)
            camera = capture.points3d[frame] @ rotation.T + capture.translations[frame, view]
            assert (camera[:, 2] > 1).all()
            expected = camera[:, :2] / camera[:, 2:] * capture.intrinsics[0, 0]
            expected += capture.intrinsics[:2, 2]
            np.testing.assert_allclose(capture.keypoints[frame, view], expected, atol=0.01)


def test_bones_keep_their_lengths_and_the_figure_stands_upright_in_the_image() -> None:
    capture = synthetic_capture(frames=50, views=2)
    edges = np.array(capture.edges)
    bones = capture.points3d[:, edges[:, 0]] - capture.points3d[:, edges[:, 1]]
    lengths = np.linalg.norm(bones, axis=-1)
    np.testing.assert_allclose(lengths, lengths[:1].repeat(50, 0), atol=1e-5)
    head = capture.keypoint_names.index("head")
    assert (capture.keypoints[..., head, 1] < capture.keypoints[..., 0, 1]).mean() > 0.95  # y down


def test_same_seed_same_capture() -> None:
    first, again, other = (synthetic_capture(frames=4, noise=2, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.keypoints, again.keypoints)
    assert not np.array_equal(first.keypoints, other.keypoints)


def test_noise_gaps_and_confidence_are_as_asked() -> None:
    clean = synthetic_capture(frames=400, views=3, seed=6)
    dirty = synthetic_capture(
        frames=400, views=3, noise=5, hidden_keypoints=0.1, hidden_views=0.3, seed=6
    )
    hidden = np.isnan(dirty.keypoints[..., 0])
    assert hidden.all(-1).mean() == pytest.approx(0.3, abs=0.05)
    assert hidden[~hidden.all(-1)].mean() == pytest.approx(0.1, abs=0.02)
    assert (dirty.confidence[hidden] == 0).all()
    error = (dirty.keypoints - clean.keypoints)[~hidden]
    assert error.std() == pytest.approx(5, rel=0.05)
    size = np.linalg.norm(error, axis=-1)
    assert np.corrcoef(size, dirty.confidence[~hidden])[0, 1] < -0.5


@pytest.mark.parametrize(
    "wrong", [{"frames": 0}, {"views": 65}, {"noise": -1}, {"hidden_views": 1.1}, {"distance": 1}]
)
def test_bounds(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} must lie between"):
        synthetic_capture(**wrong)
