"""Where the points of lifts are in the images: `python projection.py < answer.json`.

Reads an answer of `POST /lift`, canonical or in the room. Prints frames x views x keypoints x
(x, y) as JSON: pixels, with the origin that the lifted keypoints had; null: no answer.
"""

import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def project(points: Sequence[Sequence[float] | None], view: dict[str, Any]) -> NDArray[np.float64]:
    """Return the pixels (P, 2) of points (P, 3), null where unknown, in a view with a camera."""
    known = np.array([[np.nan] * 3 if point is None else point for point in points])
    turned = known @ np.array(view["rotation"]).T
    if view["camera"] == "weak_perspective":
        flat: NDArray[np.float64] = view["scale"] * turned[:, :2] + view["translation"]
        return flat
    x, y, z = (turned + view["translation"]).T
    bent = bend(np.stack((x / z, y / z), -1), view["camera"], view["distortion"])
    pixels: NDArray[np.float64] = bent * view["focal"] + view["principal_point"]
    return pixels


def bend(
    directions: NDArray[np.float64], camera: str, distortion: Sequence[float]
) -> NDArray[np.float64]:
    """Return the directions (P, 2) at depth 1 as the lens bends them: OpenCV's two models."""
    a, b = directions.T
    r2 = a * a + b * b
    k = distortion
    if camera == "fisheye":
        r = np.maximum(np.sqrt(r2), 1e-12)
        t2 = np.arctan(r) ** 2
        bent = np.arctan(r) / r * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        return np.stack((a * bent, b * bent), -1)
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        (
            a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
            b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
        ),
        -1,
    )


if __name__ == "__main__":
    seen = [
        [
            None
            if view is None
            else [None if np.isnan(p[0]) else p.tolist() for p in project(frame["points3d"], view)]
            for view in frame["views"]
        ]
        for frame in json.load(sys.stdin)["frames"]
    ]
    print(json.dumps(seen))
