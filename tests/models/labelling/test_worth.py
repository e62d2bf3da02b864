"""What was planted in a film is ranked first, once for each burst; a clean film has nothing."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.calibrating.result import CameraReport
from models.labelling.worth import Image, rank
from models.network.answers import UNLIKE_FIT
from tests.models.labelling.films import AZIMUTHS, FRAMES, SIZES, filmed, walked
from tests.models.rigs import FOCAL, around

Array = NDArray[Any]


def ranked(points: Array, keypoints: Array, most: int = 50, **more: Any) -> list[Image]:
    film, evidence = filmed(points, keypoints, **more)
    return list(rank(film, evidence, SIZES[: keypoints.shape[1]], most=most).images)


def rig() -> CameraReport:
    views = len(AZIMUTHS)
    turns, shifts = around(AZIMUTHS)
    nothing: Any = np.zeros((views, 8))
    return CameraReport(
        "static",
        "",
        (),
        ("perspective",) * views,
        np.full((views, 2), FOCAL),
        nothing[:, 0],
        np.tile([640.0, 512.0], (views, 1)),
        nothing[:, :2],
        nothing,
        nothing[:, :2],
        np.ones(views, np.bool_),
        turns,
        nothing[:, 0],
        shifts,
        nothing[:, :3],
        nothing[:, 0],
        1.0,
        1.0,
    )


def test_a_clean_film_has_nothing_to_label() -> None:
    assert ranked(*walked()) == []
    points, keypoints = walked()
    gone = np.random.default_rng(1).random(keypoints.shape[:3]) < 0.03
    keypoints[gone] = np.nan  # single keypoints that are hidden are no reason
    assert all(image.score < 2.5 for image in ranked(points, keypoints))


def test_a_burst_of_wrong_keypoints_is_one_entry() -> None:
    points, keypoints = walked()
    keypoints[100:110, 1, 6] += [40.0, 0.0]
    [image] = ranked(points, keypoints)
    assert (image.view, image.moment) == (1, image.frame)
    assert 100 <= image.frame < 110
    [reason] = image.reasons
    assert (reason.code, reason.keypoints) == ("disagreement", (6,))
    assert reason.evidence["error_px"] == pytest.approx(40, abs=5)
    assert 0.9 < image.score < 1


def test_long_bursts_have_an_entry_now_and_then_where_they_look_different() -> None:
    points, keypoints = walked()
    keypoints[60:140, 1, 6] += [40.0, 0.0]
    images = ranked(points, keypoints)
    frames = sorted(image.frame for image in images)
    assert 2 <= len(frames) <= 1 + 80 // 15
    assert min(np.diff(frames)) >= 15
    points, keypoints = np.repeat(points[:1], 240, axis=0), keypoints.copy()
    keypoints[:] = walked(frames=1)[1]  # nobody moves
    keypoints[60:140, 1, 6] += [40.0, 0.0]
    assert len(ranked(points, keypoints)) == 1


def test_outliers_count_as_the_fit_judged_them() -> None:
    points, keypoints = walked()
    keypoints[50:53, 2, 4:6] += 200.0
    judged = np.zeros(keypoints.shape[:3], np.float32)
    judged[50:53, 2, 4:6] = 0.9
    judged[90, 1, 3] = 1.0  # and yet it is where the fit shows it
    keypoints[90, 1, 3] = filmed(points, keypoints)[0].reprojections[90, 1, 3]
    [image] = ranked(points, keypoints, found={"outlier_probability": judged})
    [reason] = image.reasons
    assert (image.view, reason.code, reason.keypoints) == (2, "outlier", (4, 5))
    assert reason.evidence["probability"] == pytest.approx(0.9)
    assert image.score == pytest.approx(1.8)


def test_a_static_view_that_saw_nobody_is_shown_what_others_see() -> None:
    points, keypoints = walked()
    keypoints[150:158, 3] = np.nan
    [image] = ranked(points, keypoints, cameras=rig(), placed=points)
    assert image.view == 3
    assert 150 <= image.frame < 158
    [reason] = image.reasons
    assert (reason.code, len(reason.keypoints)) == ("missed", keypoints.shape[2])
    assert reason.evidence == {"views": 3.0}
    # Of a camera that moves it is not known where it looked.
    [unplaced] = ranked(points, keypoints)
    assert unplaced.score == pytest.approx(image.score / 2, abs=0.01)


def test_who_left_the_image_is_not_missed() -> None:
    points, keypoints = walked()
    turns, shifts = around(AZIMUTHS)
    aside = turns[3].T @ [4.0, 0.0, 0.0]
    points[150:158] += aside  # 4 m to the right of the fourth camera
    more = 0.01 * np.random.default_rng(0).standard_normal(keypoints[150:158].shape)
    for view in range(3):
        camera = points[150:158] @ turns[view].T + shifts[view]
        keypoints[150:158, view] = FOCAL * camera[..., :2] / camera[..., 2:] + [640, 512]
        keypoints[150:158, view] += more[:, view]
    keypoints[150:158, 3] = np.nan
    assert ranked(points, keypoints, cameras=rig(), placed=points) == []


def test_a_keypoint_that_a_view_never_shows_is_not_missed() -> None:
    points, keypoints = walked()
    keypoints[:, 0, :3] = np.nan
    assert ranked(points, keypoints) == []


def test_a_pose_unlike_all_others_is_listed_for_one_view() -> None:
    points, keypoints = walked()
    again = np.arange(FRAMES) % 60  # the same steps four times
    points, keypoints = points[again], keypoints[again]
    points += 0.005 * np.random.default_rng(0).standard_normal(points.shape)
    assert ranked(points, keypoints) == []
    turns, shifts = around(AZIMUTHS)
    points[80] = points[80] * [1.0, 0.4, 1.0]  # squashed
    for view in range(4):
        camera = points[80] @ turns[view].T + shifts[view]
        keypoints[80, view] = FOCAL * camera[:, :2] / camera[:, 2:] + [640, 512]
    [image] = ranked(points, keypoints)
    assert image.frame == 80
    assert image.score == pytest.approx(1.0)
    [reason] = image.reasons
    assert (reason.code, reason.keypoints) == ("unlike_fit", ())
    assert reason.evidence["distance_ratio"] > 2


def test_a_frame_that_the_fit_found_odd_is_listed() -> None:
    points, keypoints = walked()
    odd = np.zeros(FRAMES, np.uint8)
    odd[33] = UNLIKE_FIT
    [image] = ranked(points, keypoints, found={"findings": odd})
    assert (image.frame, image.reasons[0].code) == (33, "unlike_fit")


def test_several_troubles_are_ranked_by_what_they_would_teach() -> None:
    points, keypoints = walked()
    keypoints[20:24, 0, 3] += [0.0, 40.0]
    keypoints[120:126, 1, 3:9] += [40.0, 0.0]
    keypoints[200:210, 2] = np.nan
    images = ranked(points, keypoints, cameras=rig(), placed=points)
    assert [image.view for image in images] == [2, 1, 0]
    assert [image.view for image in ranked(points, keypoints, most=1)] == [1]
    film, evidence = filmed(points, keypoints)
    ranking = rank(film, evidence, SIZES, most=1)
    assert ranking.candidates == 4 + 6 + 10


def test_frames_are_those_of_a_late_view() -> None:
    points, keypoints = walked(late=6.5)
    keypoints[130:136, 3, 2] += [40.0, 0.0]
    every = np.arange(float(FRAMES))[:, None]
    frames = np.repeat(every, 4, axis=1)
    frames[:, 3] += 6.5
    frames[frames > FRAMES - 1] = np.nan
    [image] = ranked(points, keypoints, frames=frames)
    assert image.view == 3
    assert 130 <= image.frame < 136
    assert image.moment is not None
    assert abs(image.frame - 6.5 - image.moment) <= 0.5


def test_a_keypoint_that_one_view_misses_for_long_is_listed() -> None:
    points, keypoints = walked()
    keypoints[100:112, 2, 7] = np.nan
    keypoints[150, 2, 7] = np.nan  # a moment is no reason
    [image] = ranked(points, keypoints)
    assert image.view == 2
    assert 100 <= image.frame < 112
    [reason] = image.reasons
    assert (reason.code, reason.keypoints) == ("missed", (7,))
    assert image.score == pytest.approx(0.75 * (1 - 1 / 8), abs=0.01)


def test_what_the_detector_was_sure_of_comes_first() -> None:
    points, keypoints = walked()
    keypoints[60, 0, 4] += [40.0, 0.0]
    keypoints[100, 0, 4] += [40.0, 0.0]
    confidence = np.full(keypoints.shape[:3], 1.0, np.float32)
    confidence[60, 0, 4] = 0.6
    sure, unsure = ranked(points, keypoints, confidence=confidence)
    assert (sure.frame, unsure.frame) == (100, 60)
    assert unsure.score == pytest.approx(sure.score * 0.7, rel=0.05)


def test_a_view_that_saw_nobody_hides_no_other_error_of_that_view() -> None:
    points, keypoints = np.repeat(walked(frames=1)[0], FRAMES, axis=0), walked()[1]
    keypoints[:] = walked(frames=1)[1]  # nobody moves
    keypoints[60:70, 1] = np.nan
    keypoints[72, 1, 6] += [40.0, 0.0]
    keypoints[150, 1, 6] += [0.0, 40.0]
    codes = [i.reasons[0].code for i in ranked(points, keypoints, cameras=rig(), placed=points)]
    assert codes == ["missed", "disagreement"]
