"""What is known of a dataset is changed after it was stored."""

import numpy as np
import pytest

from store import attempts, dataset_changes, datasets, fits, lookup
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import CaptureError
from store.records import DatasetRecord, ModelRecord
from tests.deployments import scaled_is_thorough
from tests.store.test_fits import DESCRIBE


def codes(record: DatasetRecord) -> list[str]:
    return [finding["code"] for finding in record.findings or []]


@scaled_is_thorough
def test_image_sizes_are_compared_with_the_sample_of_an_upload(store: Store) -> None:
    pixels = np.random.default_rng(0).uniform(0, 1000, (9000, 2, 16, 2)).astype(np.float32)
    pixels[:, :, 3] = np.nan  # never seen
    capture = Capture.checked(pixels)
    sizes = [[600, 600], [600, 600]]
    at_once = datasets.create(store, capture, CaptureDescription("a", image_sizes=sizes))
    later = datasets.create(store, capture, CaptureDescription("b"))
    assert "outside_image" not in codes(later)
    changed = dataset_changes.change(store, DatasetRecord, later.id, {"image_sizes": sizes})
    assert set(codes(changed)) == {"keypoint_never_seen", "outside_image"}
    assert changed.findings == at_once.findings
    back = dataset_changes.change(store, DatasetRecord, later.id, {"image_sizes": None})
    assert back.findings == later.findings


def test_models_of_a_dataset_get_its_skeleton(store: Store, capture: Capture) -> None:
    made = datasets.create(store, capture, CaptureDescription("a"))
    fit = fits.create(store, dataset_id=made.id, name="f", config={})
    attempt = attempts.claim(store, fit.id, lease_seconds=60)
    assert attempt is not None
    describe = DESCRIBE | {"dataset_id": made.id}
    model = attempts.succeed(
        store, attempt, weights=b"w", reconstruction=b"r", progress=None, describe=describe
    )
    skeleton = {"keypoint_names": None, "edges": [[0, 1]]}
    for given in (skeleton, None):
        dataset_changes.change(store, DatasetRecord, made.id, {"skeleton": given})
        assert lookup.get(store, ModelRecord, model).skeleton == given


def test_frames_with_times_keep_their_rate(store: Store, capture: Capture) -> None:
    timed = Capture.checked(capture.keypoints, times=np.arange(capture.frames) / 50)
    made = datasets.create(store, timed, CaptureDescription("a"))
    with pytest.raises(CaptureError, match="fps is 30"):
        dataset_changes.change(store, DatasetRecord, made.id, {"fps": 30.0})
    assert dataset_changes.change(store, DatasetRecord, made.id, {"fps": 50.0}).fps == 50
