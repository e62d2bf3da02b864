"""Cheap checks of keypoints alone: harm that was planted is found where it is, and nothing else."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.capture.checks import BLOCKS, NUMBERS, capture_findings, sample
from models.findings.finding import Finding
from tests.models.rigs import IMAGE_SIZE, make_rig_capture

Float32 = NDArray[np.float32]
FRAMES, VIEWS = 60, 3
SIZES = [IMAGE_SIZE] * VIEWS


@pytest.fixture(scope="module")
def unharmed() -> Float32:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=FRAMES)
    return capture.keypoints.astype(np.float32)


def only(found: tuple[Finding, ...], code: str) -> Finding:
    (finding,) = found
    assert finding.code == code
    return finding


def test_nothing_is_found_in_unharmed_captures(unharmed: Float32) -> None:
    rng = np.random.default_rng(1)
    noisy = unharmed + 10 * rng.standard_normal(unharmed.shape)
    with_outliers = unharmed.copy()
    astray = rng.random(unharmed.shape[:3]) < 0.1
    with_outliers[astray] = rng.uniform(0, 1000, (astray.sum(), 2))
    moving = make_rig_capture([0.0, 80.0], moving=(0, 1), frames=FRAMES).keypoints
    for keypoints in (unharmed, noisy, with_outliers, moving, np.round(unharmed)):
        views = keypoints.shape[1]
        assert capture_findings(keypoints, image_sizes=SIZES[:views]) == ()
        assert capture_findings(keypoints) == ()


def test_a_keypoint_that_no_view_shows(unharmed: Float32) -> None:
    keypoints, confidence = unharmed.copy(), np.ones(unharmed.shape[:3], np.float32)
    keypoints[:, :, 4] = np.nan
    confidence[:, :, 7] = 0
    assert only(capture_findings(keypoints, confidence), "keypoint_never_seen").keypoints == (4, 7)


def test_a_keypoint_that_two_views_never_show_together(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    for frame in range(FRAMES):
        keypoints[frame, np.arange(VIEWS) != frame % VIEWS, 4] = np.nan
    assert only(capture_findings(keypoints), "keypoint_never_seen").keypoints == (4,)
    keypoints[7] = unharmed[7]
    assert capture_findings(keypoints) == ()


def test_a_view_that_shows_nothing(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    keypoints[:, 1, 3:] = np.nan
    assert only(capture_findings(keypoints), "view_never_seen").views == (1,)


def test_a_keypoint_that_is_stuck_in_one_view(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    keypoints[:, 1, 5] = (700.5, 400.25)
    found = only(capture_findings(keypoints), "keypoint_frozen")
    assert (found.views, found.keypoints, found.frames) == ((1,), (5,), ())
    assert found.evidence == {"x": 700.5, "y": 400.25, "share": 1.0}


def test_a_keypoint_that_is_stuck_for_some_frames(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    keypoints[20:45, 2, 6] = (640.0, 500.0)
    found = only(capture_findings(keypoints), "keypoint_frozen")
    assert (found.views, found.keypoints, found.frames) == ((2,), (6,), ((20, 44),))


def test_a_corner_that_stands_for_not_found_in_all_views(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    gone = np.random.default_rng(2).random(FRAMES) < 0.5
    keypoints[gone, :, 9] = 0
    found = only(capture_findings(keypoints), "keypoint_frozen")
    assert (found.views, found.keypoints) == ((0, 1, 2), (9,))
    marked = np.zeros(FRAMES, bool)
    for first, last in found.frames:
        marked[first : last + 1] = True
    assert (marked == gone).all()


def test_a_keypoint_that_stays_in_the_middle_is_no_fault(unharmed: Float32) -> None:
    centred = unharmed - unharmed[:, :, :1]  # of the root, as some captures are
    centred = np.where(np.isnan(unharmed[:, :, :1]), unharmed - 600, centred) + 600
    assert not [f for f in capture_findings(centred) if f.code == "keypoint_frozen"]


def test_a_foot_that_is_planted_and_rounded_is_no_harm() -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=FRAMES, noise=0.0)
    keypoints = capture.keypoints.copy()
    foot = keypoints[10, :, 3]
    keypoints[10:40, :, 3] = foot  # stands, in all views
    assert capture_findings(np.round(keypoints)) == ()


def test_views_that_are_one(unharmed: Float32) -> None:
    keypoints = np.concatenate((unharmed, unharmed[:, :1], unharmed[:, 2:]), axis=1)
    found = capture_findings(keypoints)
    assert [(f.code, f.views) for f in found] == [
        ("views_identical", (0, 3)),
        ("views_identical", (2, 4)),
    ]


def test_coordinates_that_are_no_pixels(unharmed: Float32) -> None:
    shares = unharmed / np.array(IMAGE_SIZE, np.float32)
    found = only(capture_findings(shares, image_sizes=SIZES), "coordinates_normalised")
    assert found.views == ()
    assert 0 < found.evidence["least"] < found.evidence["most"] < 1
    one = unharmed.copy()
    one[:, 1] = shares[:, 1]
    assert only(capture_findings(one), "coordinates_normalised").views == (1,)


def test_images_smaller_than_the_extent_of_the_keypoints_are_reported(unharmed: Float32) -> None:
    sizes = [IMAGE_SIZE, (640, 512), None]
    found = only(capture_findings(unharmed, image_sizes=sizes), "outside_image")
    assert found.views == (1,)
    assert found.evidence["share"] > 0.1
    above = capture_findings(unharmed - [0, 600])
    assert [(f.code, f.views) for f in above] == [("outside_image", (k,)) for k in range(VIEWS)]
    assert all(f.evidence["least_y"] < 0 for f in above)


def test_too_little_to_learn_from(unharmed: Float32) -> None:
    few = only(capture_findings(unharmed[:25]), "too_few_frames")
    assert few.evidence["frames_shown"] == 25
    assert only(capture_findings(unharmed[:, :1]), "one_view").views == ()
    in_turn = unharmed.copy()
    for frame in range(FRAMES):
        in_turn[frame, np.arange(VIEWS) != frame % VIEWS] = np.nan
    assert only(capture_findings(in_turn), "one_view").evidence["frames_with_two_views"] == 0


def test_a_subject_that_stands_still(unharmed: Float32) -> None:
    noise = 4 * np.random.default_rng(0).standard_normal(unharmed.shape)
    still = np.repeat(unharmed[3:4], FRAMES, axis=0) + noise
    assert only(capture_findings(still), "no_motion").evidence["change"] < 0.05
    rng = np.random.default_rng(2)
    astray = rng.random(still.shape[:3]) < 0.1
    still[astray] = rng.uniform(0, 1000, (int(astray.sum()), 2))
    still[rng.random(still.shape[:3]) < 0.3] = np.nan
    assert only(capture_findings(still), "no_motion").evidence["change"] < 0.05


def test_nothing_depends_on_the_order_of_frames(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    keypoints[20:45, 2, 6] = (640.0, 500.0)
    order = np.random.default_rng(3).permutation(FRAMES)
    one, other = (
        only(capture_findings(k, numbers=n), "keypoint_frozen")
        for k, n in ((keypoints, None), (keypoints[order], order))
    )
    assert one == other


def test_a_long_capture_is_sampled() -> None:
    few = sample(1000, 3, 16)
    assert (few == np.arange(1000)).all()
    many = sample(1_000_000, 3, 16)
    assert len(np.unique(many)) == len(many) <= NUMBERS // 48
    assert (np.diff(many) > 1).sum() == BLOCKS - 1
    assert many[-1] == 999_999


def test_a_sample_speaks_of_the_frames_of_the_capture(unharmed: Float32) -> None:
    keypoints = unharmed.copy()
    keypoints[30:45, 0, 6] = (640.0, 500.0)
    numbers = np.arange(5000, 5000 + FRAMES)
    found: Any = capture_findings(keypoints, numbers=numbers, frames=90_000)
    assert only(found, "keypoint_frozen").frames == ((5030, 5044),)
