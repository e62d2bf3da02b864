"""Files of arrays are read and written as the library of their format does it."""

import numpy as np
import pytest
from safetensors.numpy import load, save

from store.array_files import TYPES, safetensors_arrays
from store.capture import Capture


def test_arrays_of_every_type_are_read_as_the_library_reads_them() -> None:
    rng = np.random.default_rng(0)
    arrays = {name: rng.uniform(0, 90, (3, 4, 2)).astype(kind) for name, kind in TYPES.items()}
    arrays |= {"none": np.zeros((0, 5), np.float32), "one": np.array(7.0)}
    data = save(arrays, {"said": "of the file"})
    expected, found = load(data), safetensors_arrays(data)
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"[0,24]", b"[0,20]"),
        (b"[0,24]", b"[8,32]"),
        (b"[0,24]", b"[-8,6]"),
        (b"[0,24]", b"[0,240]"),
        (b"[0,24]", b"0,[24] "),
        (b"[2,3]", b"[2,-3]"),
        (b"[2,3]", b"[2,3.0]"),
        (b"[2,3]", b"[2,true]"),
        (b"F32", b"F31"),
        (b"F32", b"\xff32"),
        (b'"dtype"', b'"type"'),
    ],
)
def test_headers_that_contradict_themselves_are_refused(old: bytes, new: bytes) -> None:
    data = save({"keypoints": np.ones((2, 3), np.float32)})
    size = int.from_bytes(data[:8], "little")
    header = data[8 : 8 + size].rstrip().replace(old, new)
    assert header != data[8 : 8 + size].rstrip()
    changed = len(header).to_bytes(8, "little") + header + data[8 + size :]
    with pytest.raises(ValueError, match=r".+"):
        safetensors_arrays(changed)


def test_captures_are_written_for_the_library_to_read() -> None:
    rng = np.random.default_rng(0)
    capture = Capture(
        rng.random((5, 3, 7, 2), np.float32),
        rng.random((5, 3, 7), np.float32),
        rng.random((5, 7, 3), np.float32)[:, :, ::-1],
        np.arange(5) / 3,
    )
    found = load(capture.to_bytes())
    assert found.keys() == {"keypoints", "confidence", "points3d", "times"}
    for name, array in found.items():
        np.testing.assert_array_equal(array, getattr(capture, name))
