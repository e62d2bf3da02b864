"""Keypoints as they should not come, drawn by Hypothesis; small, the same in every run."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as drawn
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

bounded = settings(max_examples=60, deadline=None, derandomize=True, database=None)
# Missing, equal, huge, negative, and some that are usual.
PIXELS = st.one_of(
    st.just(np.nan),
    st.just(0.0),
    st.sampled_from([512.0, -1e6, 1e6, 1e-30]),
    st.floats(0, 2000, width=32),
)


@st.composite
def captures(draw: st.DrawFn, most_frames: int = 6) -> Float32:
    """Draw keypoints (N, K, P, 2), some views and keypoints of which are never seen."""
    shape = tuple(draw(st.integers(1, most)) for most in (most_frames, 4, 6))
    pixels: Float32 = draw(drawn.arrays(np.float32, (*shape, 2), elements=PIXELS))
    if draw(st.booleans()):
        pixels[:] = pixels[:1]  # nothing moves
    if draw(st.booleans()):
        pixels[:, draw(st.integers(0, shape[1] - 1))] = np.nan
    if draw(st.booleans()):
        pixels[:, :, draw(st.integers(0, shape[2] - 1))] = np.nan
    return pixels
