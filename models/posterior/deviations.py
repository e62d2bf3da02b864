"""From answers and keypoints to how far points may be off, without leaving machine code."""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig
from models.capture.observations import Observations
from models.network.answers import Answers
from models.numerics.compiled import compiled
from models.posterior.answers import fill_frames, make_frames
from models.posterior.frames import Covariances, LearntShapes, write_covariances

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@compiled
def write_deviations(
    answers: Answers,
    rig: Rig,
    seen: Observations,
    detected: Float32,
    shapes: LearntShapes,
    noise: Float64,
    factor: Float64,
    start: int,
    stop: int,
    found: Covariances,
    out: Float32,
) -> None:
    """Write deviations (N, P) of frames from `start` to `stop`; see `Posterior.deviations`.

    A frame without a perspective camera stays as it is. `found` has room for these frames.
    """
    some, (views, count) = stop - start, noise.shape
    keypoints, weights = np.zeros((some, views, count, 2)), np.zeros((some, views, count))
    for n in range(start, stop):
        for k in range(views):
            for p in range(count):
                weights[n - start, k, p] = seen.weights[n, k, p]
                known = len(detected) > 0 and detected[n, k, p, 2] > 0
                for i in range(2):
                    pixel = seen.keypoints[n, k, p, i] * seen.sizes[n, k] + seen.centres[n, k, i]
                    keypoints[n - start, k, p, i] = detected[n, k, p, i] if known else pixel
    frames = make_frames(keypoints, rig)
    fill_frames(answers, rig, shapes.mean, weights, noise, start, stop, start, frames)
    write_covariances(frames, shapes, factor, 0, some, found)
    for n in range(start, stop):
        placed = False
        for k in range(views):
            placed = placed or answers.camera_models[n, k] > 0
        for p in range(count):
            block = found.blocks[n - start, p]
            squared = block[0, 0] + block[1, 1] + block[2, 2]
            if placed and math.isfinite(squared):
                out[n, p] = math.sqrt(max(squared, 0.0))
            else:
                block[:] = np.nan
