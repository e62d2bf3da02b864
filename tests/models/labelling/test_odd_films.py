"""Films of one view or frame, and such as show nothing: nothing is listed, nothing breaks."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.labelling.accepted import accept
from models.labelling.worth import rank
from tests.models.labelling.films import SIZES, filmed, walked

Array = NDArray[Any]


def one_view() -> tuple[Array, Array]:
    return walked(views=1)


def one_frame() -> tuple[Array, Array]:
    return walked(frames=1)


def nothing_seen() -> tuple[Array, Array]:
    points, keypoints = walked(frames=30)
    return np.full_like(points, np.nan), np.full_like(keypoints, np.nan)


def a_keypoint_and_a_view_never_seen() -> tuple[Array, Array]:
    points, keypoints = walked(frames=60)
    points[:, 4] = np.nan
    keypoints[:, :, 4] = np.nan
    keypoints[:, 2] = np.nan
    return points, keypoints


def frames_without_an_answer() -> tuple[Array, Array]:
    points, keypoints = walked(frames=60)
    points[10:20] = np.nan
    keypoints[10:20] = np.nan
    return points, keypoints


@pytest.mark.parametrize(
    "make",
    [
        one_view,
        one_frame,
        nothing_seen,
        a_keypoint_and_a_view_never_seen,
        frames_without_an_answer,
    ],
)
@pytest.mark.parametrize("known", [True, False], ids=["sizes", "no sizes"])
def test_odd_films_have_labels_where_something_was_seen(make: Any, known: bool) -> None:
    points, keypoints = make()
    film, evidence = filmed(points, keypoints)
    views = keypoints.shape[1]
    sizes: list[tuple[int, int] | None] = SIZES[:views] if known else [None] * views
    assert rank(film, evidence, sizes, most=20).images == ()
    seen: Array = np.asarray(np.isfinite(keypoints).all(-1))
    for source in ("keypoints", "reprojections"):
        accepted = accept(film, evidence, sizes, source)
        labelled: Array = np.asarray(np.isfinite(accepted.keypoints).all(-1))
        np.testing.assert_array_equal(labelled, accepted.weights > 0)
        assert (labelled & seen).sum() >= 0.98 * seen.sum()
        assert (accepted.weights <= 1).all()
        if source == "keypoints":
            assert not labelled[~seen].any()


def test_a_camera_in_weak_perspective_projects_by_its_scale() -> None:
    points, keypoints = walked(frames=30)
    shape = keypoints.shape[:2]
    shifts = np.broadcast_to([100.0, 50.0, np.nan], (*shape, 3)).astype(np.float32)
    found = {
        "camera_models": np.zeros(shape, np.int8),
        "scales": np.full(shape, 200.0, np.float32),
        "rotations": np.broadcast_to(np.eye(3), (*shape, 3, 3)).astype(np.float32),
        "translations": shifts,
    }
    film, _ = filmed(points, keypoints, found=found)
    expected = 200 * points[:, None, :, :2] + [100, 50]
    np.testing.assert_allclose(film.reprojections[:, :1], expected, rtol=1e-4)
