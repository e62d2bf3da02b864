"""Arrays and messages of any content: what was written is read, and what is broken is refused."""

import numpy as np
import pytest
from fewview.api.arrays import to_npz, to_safetensors
from fewview.api.stream_messages import write_frame
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as drawn
from numpy.typing import NDArray

from models.lifting.fitted_prior import FittedPrior
from service.http.errors import ApiError
from service.realtime.stream_frames import read_frame
from service.settings import Settings
from service.wire.arrays import from_bytes
from tests.odd_arrays import Float32, bounded, captures

MIB = 1 << 20
Arrays = dict[str, NDArray[np.generic]]
ARRAYS = st.dictionaries(
    st.from_regex(r"[a-z_]{1,12}", fullmatch=True),
    st.sampled_from(["float32", "float64", "int32", "uint8"]).flatmap(
        lambda dtype: drawn.arrays(dtype, drawn.array_shapes(max_dims=4, max_side=4))
    ),
    min_size=1,
    max_size=4,
)
WRITERS = [to_npz, to_safetensors]


@pytest.fixture(scope="module")
def prior(weights: bytes) -> FittedPrior:
    return FittedPrior.from_bytes(weights)


@pytest.mark.parametrize("write", WRITERS)
@bounded
@given(arrays=ARRAYS)
def test_arrays_come_as_they_were_sent(write: object, arrays: Arrays) -> None:
    assert callable(write)
    found = from_bytes(write(arrays), max_bytes=MIB)
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize("write", WRITERS)
@bounded
@given(arrays=ARRAYS, place=st.floats(0, 1), byte=st.integers(0, 255), cut=st.booleans())
def test_broken_arrays_are_refused_or_read_as_arrays(
    write: object, arrays: Arrays, place: float, byte: int, *, cut: bool
) -> None:
    assert callable(write)
    data = write(arrays)
    at = int(place * (len(data) - 1))
    broken = data[:at] if cut else data[:at] + bytes([byte]) + data[at + 1 :]
    try:
        found = from_bytes(broken, max_bytes=MIB)
    except ApiError as error:
        assert error.code in ("malformed_body", "body_too_large", "invalid_input")  # noqa: PT017
    else:
        assert all(isinstance(array, np.ndarray) for array in found.values())
        assert not any(array.dtype.hasobject for array in found.values())


@bounded
@given(
    seen=captures(most_frames=1),
    sequence=st.integers(0, 2**32 - 1),
    trusted=st.booleans(),
)
def test_a_frame_arrives_as_it_was_sent_or_says_what_is_wrong(
    prior: FittedPrior, seen: Float32, sequence: int, *, trusted: bool
) -> None:
    points = prior.keypoints_per_frame
    keypoints = np.resize(seen, (seen.shape[1], points, 2))
    confidence = np.full(keypoints.shape[:2], 0.5, np.float32) if trusted else None
    message = write_frame(sequence, keypoints, confidence)
    frame = read_frame(message, prior, None, None, Settings())
    assert frame.sequence == sequence
    assert (frame.capture is None) == (frame.error is not None)
    if frame.capture is not None:
        whole = np.isfinite(keypoints).all(-1, keepdims=True)  # half a point is none
        expected = np.where(whole, keypoints, np.nan)
        np.testing.assert_array_equal(frame.capture.keypoints[0], expected)
    assert read_frame(message[:-1], prior, None, None, Settings()).error is not None


@bounded
@given(message=st.one_of(st.binary(max_size=300), st.text(max_size=100), st.just("[" * 5000)))
def test_a_message_of_anything_is_a_frame_with_an_error(
    prior: FittedPrior, message: str | bytes
) -> None:
    assert read_frame(message, prior, None, None, Settings()).error is not None
