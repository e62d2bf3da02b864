"""The information of views on the points of a frame whose cameras are known."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import LENS, Views
from models.numerics.compiled import inner
from models.numerics.matrices import fill
from models.optics.lenses.projection import Lenses, differentiate_into

Float64 = NDArray[np.float64]


@inner
def inform_points(
    points: Float64,
    rotations: Float64,
    translations: Float64,
    lenses: Lenses,
    views: Views,
    information: Float64,
    pull: Float64,
) -> None:
    """Compute the information of the views on each point of a frame, linearised at `points`.

    `information` (P, 3, 3) are inverse covariances. `pull` (P, 3) is the right-hand side of the
    normal equations, with the present points as the origin.
    """
    camera, pixel, by_camera = np.empty(3), np.empty(2), np.empty((2, 3))
    by_lens, by_point = np.empty((2, LENS)), np.empty(3)
    fill(information, 0)
    fill(pull, 0)
    for k in range(len(rotations)):
        for p in range(len(points)):
            w = views.weights[k, p]
            if not w > 0:
                continue
            for i in range(3):
                camera[i] = translations[k, i]
                for j in range(3):
                    camera[i] += rotations[k, i, j] * points[p, j]
            differentiate_into(camera, lenses, k, pixel, by_camera, by_lens)
            for a in range(2):
                for j in range(3):
                    by_point[j] = 0.0
                    for i in range(3):
                        by_point[j] += by_camera[a, i] * rotations[k, i, j]
                for i in range(3):
                    pull[p, i] += w * by_point[i] * (views.keypoints[k, p, a] - pixel[a])
                    for j in range(3):
                        information[p, i, j] += w * by_point[i] * by_point[j]
