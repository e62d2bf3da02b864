"""Long lists in JSON become arrays some frames at a time, as far as there is memory for them."""

import numpy as np
import pytest

from service.wire.slices import SLICE_BYTES, read_in_slices

FRAMES = 150_000
BODY = b'{"name": "x", "keypoints": [' + b",".join([b"[[[1, 2]]]"] * FRAMES) + b"]}"


@pytest.mark.parametrize(("most", "read"), [(8 * FRAMES, True), (8 * FRAMES - 1, False)])
def test_all_slices_together_take_no_more_than_they_may(most: int, *, read: bool) -> None:
    assert len(BODY) > SLICE_BYTES
    found = read_in_slices(bytearray(BODY), ("keypoints",), lambda _: None, most)
    assert (found is not None) == read
    if found is not None:
        assert found.body["name"] == "x"
        np.testing.assert_array_equal(found.arrays["keypoints"], np.tile([1, 2], (FRAMES, 1, 1, 1)))
