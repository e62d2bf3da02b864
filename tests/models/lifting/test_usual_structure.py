"""Keypoints of too few views have a place only where the fit's structures have one near."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.lifting.usual_structure import learn_usual_structure, without_unlikely
from models.settings.config import FitConfig
from models.training.trainer import fit
from tests.models.rigs import make_rig_capture
from tests.sharing import fitted_once

QUICK: dict[str, Any] = {"steps": 30, "dictionary_sizes": (16, 8), "batch_size": 8}
ALONE = 9  # no two views show it in the same frame
POINTS = 16


def capture() -> NDArray[np.float64]:
    """Return a capture in which two views show a keypoint in turn."""
    keypoints = make_rig_capture([0.0, 80.0], frames=24).keypoints.copy()
    for frame in range(len(keypoints)):
        keypoints[frame, frame % 2, ALONE] = np.nan
    return keypoints


@cache
def prior() -> FittedPrior:
    return fitted_once("alone", lambda: fit(capture(), FitConfig.model_validate(QUICK)))


def test_a_keypoint_that_two_views_show_in_turn_alone_is_null() -> None:
    (found,) = [f for f in prior().findings if f.code == "keypoint_never_seen"]
    assert found.keypoints == (ALONE,)
    everywhere = make_rig_capture([0.0, 80.0], frames=24).keypoints
    for keypoints in (capture(), everywhere):
        points = prior().lift(keypoints).points3d
        assert np.isnan(points[:, ALONE]).all()
        assert np.isfinite(np.delete(points, ALONE, axis=1)).mean() > 0.99


def test_a_file_has_the_usual_structure() -> None:
    data = prior().to_bytes()
    structure = FittedPrior.from_bytes(data).capture.structure
    assert structure.shape == (POINTS - 1, 3)
    assert np.isfinite(structure).all()
    np.testing.assert_array_equal(structure, prior().capture.structure)
    assert FittedPrior.from_bytes(data).to_bytes() == data


def astray(lift: LiftedFrames, keypoint: int, radii: float) -> LiftedFrames:
    """Return a lift of which one view shows a keypoint, that far from where it is."""
    points, seen = lift.points3d.copy(), lift.keypoints_seen.copy()
    radius = np.sqrt(np.square(points - points.mean(1, keepdims=True)).sum(-1).mean(1))
    points[:, keypoint, 0] += np.float32(radii) * radius
    seen[:, keypoint] = 1
    return lift._replace(points3d=points, keypoints_seen=seen)


def test_only_what_lies_far_from_the_usual_structure_is_null() -> None:
    known = prior().capture.known
    lift = prior().lift(capture()).of_keypoints(known)
    lift = lift.frames(np.asarray(np.isfinite(lift.points3d).all((1, 2))))
    usual = learn_usual_structure(lift, np.asarray(lift.points3d[0], np.float64))
    for radii, null in ((0.5, False), (5.0, True)):
        answer = without_unlikely(astray(lift, 3, radii), usual)
        assert (np.isnan(answer.points3d[:, 3]) == null).all()
        assert np.isfinite(np.delete(answer.points3d, 3, axis=1)).all()
    sure = astray(lift, 3, 5.0)._replace(keypoints_seen=lift.keypoints_seen)
    shown = lift.keypoints_seen[:, 3] > 1  # two views determine it
    assert np.isfinite(without_unlikely(sure, usual).points3d[shown, 3]).all()
    nowhere = usual.copy()
    nowhere[3] = np.nan
    assert np.isfinite(without_unlikely(astray(lift, 3, 5.0), nowhere).points3d).all()


def test_lifts_of_one_view_have_all_their_keypoints() -> None:
    others = np.delete(np.arange(POINTS), ALONE)
    lift = prior().lift(capture()[:, :1], views=[0])
    assert np.isfinite(lift.points3d[:, others]).all()
    alone = capture()[:, :1]
    assert np.isfinite(fit(alone, FitConfig.model_validate(QUICK)).lift(alone).points3d).all()


def test_a_frame_without_a_point_is_not_continued() -> None:
    keypoints = make_rig_capture([0.0, 80.0], frames=24).keypoints
    before = prior().lift(keypoints)
    broken = before.points3d.copy()
    broken[:, 3] = np.nan
    again = prior().lift(keypoints, previous=before._replace(points3d=broken))
    np.testing.assert_array_equal(again.points3d, before.points3d)
