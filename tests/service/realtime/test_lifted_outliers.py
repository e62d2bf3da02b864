"""What answers say of the keypoints that were left out of a lift."""

import httpx2
import numpy as np

from models.capture.synthetic import SyntheticCapture
from tests.service.realtime.conftest import lifted


def test_outliers_that_were_left_out_are_marked(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints[:4].copy()
    seen = np.isfinite(keypoints[..., 0])
    n, k, p = np.argwhere(seen)[0]
    keypoints[n, k, p] += 300
    keypoints[3] = np.nan
    seen[3] = False
    frames = lifted(http, model, keypoints)
    judged = np.array([frame["outlier_probability"] for frame in frames[:3]], np.float32)
    np.testing.assert_array_equal(np.isnan(judged), ~seen[:3])
    assert judged[n, k, p] > 0.99
    assert (judged > 0.5).sum() == 1
    assert [frame["keypoints_seen"][p] for frame in frames] == [
        int(seen[i, :, p].sum()) - (i == n) for i in range(4)
    ]
    assert frames[3]["outlier_probability"] is None  # nothing was observed
    (of_strangers,) = lifted(http, model, keypoints[:1, :2])  # cameras it does not know
    assert of_strangers["outlier_probability"] is None
