"""Starts of the search for a rig, against cameras and points that are known exactly."""

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.epipolar.rig_adjustment import AdjustedRig
from models.epipolar.rig_search import (
    SAME,
    finished_rig,
    likely_rigs,
    necker,
    ordered,
    refocused,
    same_rig,
)
from models.epipolar.static_cameras import SeenPoints, StaticCameras, distances_of
from models.numerics.steps import finished
from tests.models.epipolar.exact_rigs import (
    FOCALS,
    believed,
    exact_points,
    exact_rig,
    images_of,
    relative_poses,
)

Float64 = NDArray[np.float64]
NOISE = np.full(3, 1e-3)


def sizes_of(seen: SeenPoints) -> Float64:
    """Return the root-mean-square radius (K,) of the images."""
    centred = seen.images - seen.images.mean(2, keepdims=True)
    return np.asarray(np.sqrt(np.square(centred).sum(1).mean(1)))


def depth_of(rig: StaticCameras, points: Float64) -> Float64:
    """Return the depth (K,) of the median point."""
    return np.asarray(rig.rotations[:, 2] @ np.median(points, 1) + rig.translations[:, 2])


def test_the_mirror_image_looks_the_same_from_far_away() -> None:
    """Its error is of second order in the subject's size over the distance."""
    off = []
    for far in (1.0, 10.0, 100.0):
        rig = exact_rig(3, distance=4 * far, focals=far * FOCALS)
        points = exact_points(distance=4 * far)
        apart = images_of(*necker(rig, points)).images - images_of(rig, points).images
        off.append(float(np.abs(apart).max() / sizes_of(images_of(rig, points)).mean()))
    assert off[0] > 0.1
    np.testing.assert_allclose(off[1:], [off[0] / 10, off[0] / 100], rtol=0.4)


def test_the_mirror_image_is_one_of_cameras_and_points() -> None:
    rig, points = exact_rig(3), exact_points()
    mirror, reflected = necker(rig, points)
    assert not same_rig(mirror, rig)
    np.testing.assert_allclose(np.linalg.det(mirror.rotations), 1)
    np.testing.assert_allclose(depth_of(mirror, reflected), depth_of(rig, points))
    np.testing.assert_array_equal(mirror.log_focals, rig.log_focals)
    gaps = [np.linalg.norm(each[:, 1:] - each[:, :-1], axis=0) for each in (points, reflected)]
    np.testing.assert_allclose(gaps[1], gaps[0])
    spreads = [np.linalg.det(each[:, :3] - each[:, 3:4]) for each in (points, reflected)]
    assert spreads[1] == pytest.approx(-spreads[0])


def test_the_mirror_image_of_the_mirror_image_is_the_rig() -> None:
    rig, points = exact_rig(3), exact_points()
    twice, again = necker(*necker(rig, points))
    assert same_rig(twice, rig)
    before, after = images_of(rig, points), images_of(twice, again)
    np.testing.assert_allclose(after.images, before.images, atol=1e-9)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_other_lenses_see_the_subject_as_large(factor: float) -> None:
    rig, points = exact_rig(3, distance=40, focals=10 * FOCALS), exact_points(distance=40)
    before = images_of(rig, points)
    other = refocused(rig, points, rig.log_focals + np.log([factor, 1.0, 1 / factor]))
    points = points - np.median(points, 1)[:, None]
    after = images_of(other, points)
    np.testing.assert_allclose(sizes_of(after), sizes_of(before), rtol=0.01)
    np.testing.assert_array_equal(other.rotations, rig.rotations)
    np.testing.assert_allclose(np.exp(other.log_focals - rig.log_focals), [factor, 1.0, 1 / factor])
    # Of a point in the middle the image stays where it was.
    middle = np.zeros((3, 1))
    expected = (
        np.exp(rig.log_focals)[:, None]
        * other.translations[:, :2]
        / depth_of(rig, exact_points(distance=40))[:, None]
    )
    np.testing.assert_allclose(images_of(other, middle).images[..., 0], expected)


def test_the_same_lenses_leave_the_images_alone() -> None:
    rig, points = exact_rig(3), exact_points()
    same = refocused(rig, points, rig.log_focals)
    after = images_of(same, points - np.median(points, 1)[:, None])
    np.testing.assert_allclose(after.images, images_of(rig, points).images, atol=1e-12)


def turned(rig: StaticCameras, view: int, angle: float) -> StaticCameras:
    rotations = rig.rotations.copy()
    rotations[view] = Rotation.from_rotvec([0, angle, 0]).as_matrix() @ rotations[view]
    return rig._replace(rotations=rotations)


def test_rigs_are_the_same_up_to_their_frame_and_small_changes() -> None:
    rig = exact_rig(3)
    about = Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix()
    moved = rig._replace(rotations=rig.rotations @ about, translations=5 * rig.translations)
    assert same_rig(rig, moved)
    for part, same in ((0.5, True), (1.5, False)):
        assert same_rig(rig, turned(rig, 2, part * SAME)) == same
        assert same_rig(rig, turned(rig, 0, part * SAME)) == same
        longer = rig._replace(log_focals=rig.log_focals - part * SAME * np.eye(3)[1])
        assert same_rig(rig, longer) == same


def test_rigs_are_ordered_under_one_noise() -> None:
    """The noise that a rig has of itself does not excuse its misfit."""
    rig, points = exact_rig(3), exact_points()
    seen = images_of(rig, points, noise=1e-3)
    off = [AdjustedRig(turned(rig, 1, angle), points, NOISE) for angle in (0.0, 0.02, 0.1)]
    shuffled = [off[2]._replace(noise=100 * NOISE), off[0], off[1]._replace(noise=10 * NOISE)]
    rigs = [each.rig for each in ordered(shuffled, seen, believed(FOCALS[:3]))]
    for found, expected in zip(rigs, off, strict=True):
        np.testing.assert_array_equal(found.rotations, expected.rig.rotations)


def test_points_are_located_anew_before_rigs_are_ordered() -> None:
    rig, points = exact_rig(3), exact_points()
    seen = images_of(rig, points)
    misled = AdjustedRig(rig, points + 0.3, NOISE)
    wrong = AdjustedRig(turned(rig, 1, 0.05), points, NOISE)
    best = ordered([wrong, misled], seen, believed(FOCALS[:3]))[0]
    np.testing.assert_array_equal(best.rig.rotations, rig.rotations)
    np.testing.assert_allclose(best.points, points, atol=1e-6)


def test_the_prior_of_lenses_decides_where_images_do_not() -> None:
    """Two rigs with equal images: the one with likelier lenses comes first."""
    rig, points = exact_rig(3), exact_points()
    longer = rig._replace(log_focals=rig.log_focals + 1e-3)
    both = [AdjustedRig(each, points, np.ones(3)) for each in (rig, longer)]
    seen = images_of(rig, points)
    for nearest in both:
        prior = believed(np.exp(nearest.rig.log_focals), sd=1e-4)
        best = ordered(both, seen, prior)[0]
        np.testing.assert_array_equal(best.rig.log_focals, nearest.rig.log_focals)


def likely(
    views: int, *, sd: float = 0.5, off: float = 1.1
) -> tuple[list[AdjustedRig], SeenPoints]:
    rig = exact_rig(views)
    pairs = combinations(range(views), 2)
    graph = {(j, k): relative_poses(rig, j, k) for j, k in pairs}
    seen = images_of(rig, exact_points(80))
    prior = believed(off * FOCALS[:views], sd)
    return finished(likely_rigs(graph, seen, prior, sizes_of(seen))), seen


def test_exact_views_give_the_exact_rig_and_another() -> None:
    rigs, seen = likely(3)
    assert same_rig(rigs[0].rig, exact_rig(3))
    assert distances_of(rigs[0].rig, rigs[0].points, seen).max() < 1e-4
    for other in rigs[1:]:
        assert not same_rig(other.rig, rigs[0].rig)
    assert len(rigs) <= 2


def test_given_lenses_are_held() -> None:
    for each in likely(2, sd=0.0, off=1.0)[0]:
        np.testing.assert_allclose(np.exp(each.rig.log_focals), FOCALS[:2], rtol=1e-12)


def test_views_that_do_not_connect_give_no_rig() -> None:
    seen = images_of(exact_rig(3), exact_points())
    found = finished(likely_rigs({}, seen, believed(FOCALS[:3]), sizes_of(seen)))
    assert found == []


def test_all_keypoints_finish_a_rig_that_is_nearly_right() -> None:
    rig, points = exact_rig(3), exact_points()
    seen = images_of(rig, points)
    start = AdjustedRig(turned(rig, 1, 0.01), points, NOISE)
    found = finished_rig(start, seen, believed(FOCALS[:3], sd=0.0), iterations=10)
    turns = found.rig.rotations @ found.rig.rotations[0].T
    np.testing.assert_allclose(turns, rig.rotations, atol=1e-6)
    assert distances_of(found.rig, found.points, seen).max() < 1e-6
