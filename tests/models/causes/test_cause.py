"""What was wrong with a view's pixels is undone exactly, and done again."""

import numpy as np
import pytest

from models.causes.cause import CAUSES, Cause, mended, suit, unmended
from models.causes.pixel_map import PixelMap

MIRROR = Cause("mirrored", 1, {}, {}, 50.0, PixelMap(a=-1, c=1919), None, (1, 0, 2, 3))
STRETCH = Cause("stretched", 1, {}, {}, 50.0, PixelMap(e=0.75, bend=0.2, middle=960, half=960))
CROP = Cause("cropped", 0, {"x": 560}, {"x": 3}, 50.0, PixelMap(c=560, f=180), (1920, 1080))


@pytest.fixture
def keypoints() -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 1900, (5, 3, 4, 2)).astype(np.float32)


@pytest.mark.parametrize("causes", [(MIRROR,), (STRETCH,), (CROP,), (CROP, STRETCH, MIRROR)])
def test_what_was_undone_can_be_done_again(keypoints: np.ndarray, causes: tuple[Cause]) -> None:
    undone = mended(keypoints, None, None, causes).keypoints
    assert not np.allclose(undone, keypoints, atol=1)
    assert np.allclose(unmended(undone.astype(np.float64), causes), keypoints, atol=2e-3)


def test_only_views_with_a_cause_change_wherever_they_are(keypoints: np.ndarray) -> None:
    undone = mended(keypoints, None, [(800, 600)] * 3, (CROP,))
    assert np.array_equal(undone.keypoints[:, 1:], keypoints[:, 1:])
    assert np.allclose(undone.keypoints[:, 0] - keypoints[:, 0], (560, 180), atol=1e-3)
    assert undone.image_sizes == [(1920, 1080), (800, 600), (800, 600)]
    swapped = mended(keypoints[:, [2, 0]], None, None, (CROP,), views=(2, 0)).keypoints
    assert np.array_equal(swapped, undone.keypoints[:, [2, 0]])


def test_sides_are_exchanged_with_their_confidence(keypoints: np.ndarray) -> None:
    confidence = np.random.default_rng(2).random(keypoints.shape[:3]).astype(np.float32)
    undone = mended(keypoints, confidence, None, (MIRROR,))
    assert np.array_equal(undone.keypoints[:, 1, 0, 1], keypoints[:, 1, 1, 1])
    assert undone.confidence is not None
    assert np.array_equal(undone.confidence[:, 1, 0], confidence[:, 1, 1])


def test_causes_are_kept_as_text_and_checked() -> None:
    causes = (CROP, STRETCH, MIRROR)
    assert CAUSES.validate_json(CAUSES.dump_json(causes)) == causes
    assert suit(causes, views=2, keypoints=4)
    assert not suit(causes, views=1, keypoints=4)
    assert not suit(causes, views=2, keypoints=5)
    assert not suit((CROP._replace(map=PixelMap(a=0)),), views=2, keypoints=4)
    assert not suit((MIRROR._replace(partners=(1, 2, 0, 3)),), views=2, keypoints=4)
