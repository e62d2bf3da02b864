"""Drawn captures whose cameras move: what is said of them is true."""

import numpy as np
import pytest

from benchmarks.drawn_captures import STATIC, Draw, projected
from benchmarks.motions import HALVES
from benchmarks.moving_captures import (
    ANY,
    CARRIED,
    CROPPED,
    DRIFTING,
    HAND_HELD,
    KINDS,
    MIXED,
    PANNING,
    draw_moving,
)


def _eyes(draw: Draw) -> np.ndarray:
    """Places (N, K, 3) of the cameras."""
    return -(draw.rotations.mT @ draw.translations[..., None])[..., 0]


@pytest.mark.parametrize("kind", KINDS)
def test_the_true_cameras_of_each_frame_show_the_keypoints(kind: str) -> None:
    for number, half in ((0, HALVES[0]), (1, HALVES[0]), (2, HALVES[1])):
        draw = draw_moving(number, None, half, kind)
        assert draw.keypoints.shape[1] == len(draw.kinds)
        truth = (draw.points3d, draw.rotations, draw.translations)
        shown = projected(*truth, draw.frame_focals, draw.frame_centres, draw.radial)
        off = np.abs(shown - draw.keypoints)
        assert np.nanmedian(off) < 1.5 * draw.noise + 0.5, draw.words  # half of a whole pixel
        inside = (draw.keypoints >= -1) & (draw.keypoints <= draw.images[:, None] + 1)
        assert inside[np.isfinite(draw.keypoints)].all()


def test_cameras_move_as_their_kind_does() -> None:
    for number in range(1, 3):
        panning = draw_moving(number, None, HALVES[0], PANNING)
        eyes = _eyes(panning)
        np.testing.assert_allclose(eyes, np.broadcast_to(eyes[0], eyes.shape), atol=1e-9)
        assert np.ptp(panning.rotations, 0).max() > 0.01
        walked = _eyes(draw_moving(number, None, HALVES[0], HAND_HELD))
        assert (np.linalg.norm(np.ptp(walked, 0), axis=-1) > 0.2 * np.abs(walked).mean()).all()
        cropped = draw_moving(number, None, HALVES[0], CROPPED)
        assert np.ptp(cropped.rotations, 0).max() == 0
        assert np.ptp(cropped.frame_centres, 0).min() > 0
        carried = draw_moving(number, None, HALVES[0], CARRIED)
        assert carried.static.all()
        for kind in (MIXED, DRIFTING):
            draw = draw_moving(number, None, HALVES[0], kind)
            assert not draw.static.all()
            assert [one == STATIC for one in draw.kinds] == draw.static.tolist()
            assert np.ptp(draw.rotations[:, draw.static], 0, keepdims=True).max(initial=0) == 0


def test_a_draw_depends_on_its_number_alone() -> None:
    one, again = (draw_moving(5, None, HALVES[1], ANY) for _ in range(2))
    np.testing.assert_array_equal(one.keypoints, again.keypoints)
    assert one.words == again.words
    other = draw_moving(5, None, HALVES[0], ANY)
    assert other.words != one.words
