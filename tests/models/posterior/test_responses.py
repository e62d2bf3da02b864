"""How far lifts follow noise, for lifts whose posterior is known."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.posterior.answers import derivatives_of
from models.posterior.frames import Frames, covariances_of
from models.posterior.responses import STEP, repetition, response_of, white_steps
from tests.models.posterior.test_frame import NOISE, POINTS, Case

Float64 = NDArray[np.float64]

FRAMES, VIEWS = 200, 3


def many() -> tuple[Case, Frames]:
    """Return a frame of three static cameras, as often."""
    case = Case([True] * VIEWS)
    one = case.frames()
    often: dict[str, Any] = {
        name: np.repeat(array, FRAMES, 0)
        for name, array in one._asdict().items()
        if name != "lenses"
    }
    frames = one._replace(**often)
    return case, frames._replace(weights=np.full(frames.weights.shape, NOISE**-2.0))


def follow(case: Case, frames: Frames, steps: Float64, share: float) -> Frames:
    """Return what the posterior mean makes of noise, or a share of it."""
    known = np.zeros((VIEWS, 11, 1))
    found = covariances_of(frames, case.shapes, known)
    columns = found.modes.reshape(FRAMES, 3 * POINTS, -1)
    whole = columns @ columns.mT
    for p in range(POINTS):
        place = slice(3 * p, 3 * p + 3)
        whole[:, place, place] = found.blocks[:, p]
    slopes, _ = derivatives_of(frames)
    pulls = np.einsum("nkpai,nkpa->npi", slopes, STEP * NOISE * steps) / NOISE**2
    moves = (whole @ pulls.reshape(FRAMES, -1, 1)).reshape(frames.points.shape)
    return frames._replace(points=frames.points + share * moves)


@pytest.mark.parametrize("share", [1.0, 4.0])
def test_the_posterior_mean_needs_no_correction(share: float) -> None:
    """The mean of Gaussian noise and shapes answers noise by its own covariance."""
    case, frames = many()
    steps = white_steps(frames.keypoints.shape, 0.0)
    moved = follow(case, frames, steps, share)
    found = response_of(frames, moved, steps, case.shapes, np.full((VIEWS, POINTS), NOISE))
    np.testing.assert_allclose(found, [1, 1, np.sqrt(share), np.sqrt(share)], rtol=0.05)


def test_what_lifts_do_not_follow_is_trusted_by_half() -> None:
    case, frames = many()
    steps = white_steps(frames.keypoints.shape, 0.0)
    moved = follow(case, frames, steps, 0.25)
    found = response_of(frames, moved, steps, case.shapes, np.full((VIEWS, POINTS), NOISE))
    np.testing.assert_allclose(found[VIEWS], np.sqrt(0.5), rtol=0.05)


def test_steps_repeat_as_errors_do() -> None:
    _, frames = many()
    for wanted in (0.0, 0.8):
        errors = white_steps(frames.keypoints.shape, wanted)
        assert set(np.unique(errors)) == {-1.0, 1.0}
        off = frames._replace(keypoints=frames.keypoints + errors)
        assert repetition(off) == pytest.approx(wanted, abs=0.05)
