"""After the network: least squares over the views of a frame settle its structure and handedness.

Nothing is learned here. Under weak perspective a structure and its mirror image look the same, but
a real camera makes near things larger. To first order in depth over distance,

    w = s (R X)_xy (1 - k z) + t,    z = (R X)_z about its mean,

with a foreshortening k > 0 that is the inverse of the distance in units of the structure. With the
mirror image every z changes its sign, and so does the best k. So the sign of k gives the
handedness.

Settling solves for the cameras (`models.optics.weak_perspective`) and for the structure in turn,
with the keypoints as they would be without foreshortening. Lifts settle frame by frame in
`models.network.feed_forward`; fits settle many frames here. Both call `settling_kernels`.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.network.settling_kernels import alternate_frames, project_frames, settle_frames
from models.numerics.rotations import rotations_from_rows
from models.numerics.threads import in_slices

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Floats = NDArray[Any]  # of 32 or 64 bits

ROUNDS = 2  # a third lowers the error by some 2 % and costs a frame 0.3 ms
FRAMES = 64  # that a thread takes at a time
LEAST_SLOPES = 1e-9  # sum of squares: less would divide by zero
MIRROR = (1.0, 1.0, -1.0)  # through the x-y plane


class SettlingPolicy(NamedTuple):
    """Which frames of a lift are settled; the others keep the structure of the network."""

    every_frame: bool
    misfit_limit: float  # otherwise frames with a larger misfit, in units of the structure


SETTLE_ALL = SettlingPolicy(every_frame=True, misfit_limit=0.0)
SETTLE_NONE = SettlingPolicy(every_frame=False, misfit_limit=math.inf)


def settle_beyond(misfit_limit: float) -> SettlingPolicy:
    """Settle the frames whose misfit, the mean reprojection error, is larger than a limit."""
    return SettlingPolicy(every_frame=False, misfit_limit=misfit_limit)


class FirstOrder(NamedTuple):
    """Cameras of N frames of K views, and their images: `projected + k slopes`."""

    rotations: Float64  # (N, K, 3, 3); the guess in views without weight
    projected: Float64  # (N, K, P, 2) by weak perspective; 0 in views without weight
    slopes: Float64  # (N, K, P, 2) how projections move per unit of k


def settle(
    points: Floats,
    keypoints: Float32,
    weights: Float32,
    guesses: Floats,
    foreshortening: float,
    *,
    rounds: int = ROUNDS,
) -> tuple[Float64, Float64]:
    """Settle the structures of frames and make them right-handed.

    In a frame with one view, points move parallel to its image only: depth stays the network's.

    Parameters
    ----------
    points
        (N, P, 3) structures of the network, in its own handedness.
    keypoints, weights
        (N, K, P, 2) normalised and (N, K, P), as the network got them.
    guesses
        (N, K, 2, 3) matrices whose nearest rotations are the guesses of the camera solution.
    foreshortening
        k of the fit, negative if the network's structures are mirror images; see
        `estimate_foreshortening`. A frame follows that sign unless the other explains its
        keypoints much better. A frame with one view follows it always. If k is 0, nothing is
        settled.
    rounds
        How often structures are solved for; with more, the network's structure counts less.

    Returns
    -------
    tuple
        Structures (N, P, 3), centred, root-mean-square radius 1, and guesses (N, K, 3, 3) that see
        them.
    """
    settled, rotations = np.array(points, np.float64), rotations_from_rows(guesses)
    if foreshortening != 0:
        in_slices(
            len(settled),
            FRAMES,
            lambda part: settle_frames(
                settled[part],
                keypoints[part],
                weights[part],
                rotations[part],
                foreshortening,
                rounds,
            ),
        )
    return settled, rotations


def first_order_cameras(
    points: Floats,
    keypoints: Float32,
    weights: Float32,
    guesses: Floats,
    foreshortening: float,
    *,
    rounds: int = 1,
) -> FirstOrder:
    """Find the cameras that see structures (N, P, 3) with this foreshortening, to first order.

    The other arguments are those of `settle`. Cameras and foreshortened targets are computed in
    turn, `rounds` times; the first round has no foreshortening.
    """
    shape = weights.shape
    found = FirstOrder(np.empty((*shape[:2], 3, 3)), np.empty((*shape, 2)), np.empty((*shape, 2)))
    rotations, structures = rotations_from_rows(guesses), np.array(points, np.float64)
    in_slices(
        len(points),
        FRAMES,
        lambda part: project_frames(
            structures[part],
            keypoints[part],
            weights[part],
            rotations[part],
            foreshortening,
            rounds,
            *(array[part] for array in found),
        ),
    )
    return found


def estimate_foreshortening(
    points: Floats, keypoints: Float32, weights: Float32, guesses: Floats, *, rounds: int = ROUNDS
) -> float:
    """Return k of a whole fit, in the handedness that most of its frames have.

    Least squares over the frames with two views or more (one view is explained by any shape), each
    with the sign it prefers; 0 without such a frame. Arguments as for `settle`.
    """
    several = (weights.sum(-1) > 0).sum(1) > 1
    if not several.any():
        return 0.0
    points, keypoints = points[several], keypoints[several]
    weights, guesses = weights[several], guesses[several]
    k = np.zeros(len(points))
    for _ in range(rounds):
        settled = np.array(points, np.float64)
        alternate_frames(settled, keypoints, weights, rotations_from_rows(guesses), k, rounds)
        _, projected, slopes = first_order_cameras(settled, keypoints, weights, guesses, 0.0)
        weighted = weights[..., None] * slopes  # (N, K, P, 2)
        match = (weighted * (keypoints - projected)).sum((1, 2, 3))  # (N,)
        square = max((weighted * slopes).sum(), LEAST_SLOPES)
        k = np.sign(match) * (np.abs(match).sum() / square)
    return float(np.abs(k).max()) * (1.0 if k.sum() >= 0 else -1.0)


def mirror_images(points: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """Return the mirror images of structures (N, P, 3), and rotations (N, K, 3, 3) that see them.

    With D = diag(1, 1, -1), the rotation D R D sees D X where R sees X: (D R D)(D X) = D R X has
    the same x and y.
    """
    mirror = np.array(MIRROR, points.dtype)  # the diagonal of D
    return points * mirror, mirror[:, None] * rotations * mirror
