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


@st.composite
def films(draw: st.DrawFn) -> Float32:
    """Draw keypoints (N, K, P, 2) of subjects that move, long enough for every check, with gaps.

    Coordinates may be rounded, views blind or the same, keypoints stuck, frames missing.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    frames, views, points = draw(st.sampled_from([12, 33, 50, 54, 64])), draw(VIEWS), draw(POINTS)
    start = rng.uniform(0, 1000, (1, views, points, 2))
    moves = rng.normal(0, draw(st.sampled_from([0.0, 0.1, 3.0])), (frames, views, points, 2))
    pixels: Float32 = (start + np.cumsum(moves, axis=0)).astype(np.float32)
    for harm in draw(st.lists(st.sampled_from(HARMS), max_size=4)):
        _do_harm(pixels, harm, draw(VIEWS) % views, rng)
    return pixels


VIEWS, POINTS = st.integers(1, 5), st.sampled_from([4, 5, 13])
HARMS = ("blind", "gaps", "stuck", "rounded", "same", "missing", "shares", "flat", "far")


def _do_harm(pixels: Float32, harm: str, view: int, rng: np.random.Generator) -> None:
    chosen = rng.random(pixels.shape[:3]) < rng.choice([0.1, 0.5, 0.9])
    match harm:
        case "blind":
            pixels[:, view] = np.nan
        case "gaps":
            pixels[chosen] = np.nan
        case "stuck":
            pixels[chosen[:, 0, 0], view, 0] = 5
        case "rounded":
            np.round(pixels, out=pixels)
        case "same":
            pixels[:, view] = pixels[:, 0]
        case "missing":
            pixels[chosen[:, 0, 0]] = np.nan
        case "shares":
            pixels /= 1000
        case "flat":
            pixels[..., 0] = 7
        case "far":
            pixels[chosen] = 1e6
