"""A rig put together from the relative poses of its pairs, view by view."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.pairs import RelativePoses
from models.epipolar.robust_points import costs_of, triangulate_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras

Float64 = NDArray[np.float64]
ViewGraph = dict[tuple[int, int], RelativePoses]  # by views j < k

SEEDS = 10  # pairs and solutions that a rig begins with
ROUNDS = 6  # of reweighting for a camera's place
COMMON = 30  # points that a view must share with those that are placed


class Assembled(NamedTuple):
    """Cameras that were put together, and which of the views they are."""

    rig: StaticCameras
    cost: float  # mean robust cost of an observation, under the noise of the pairs


def assemble(graph: ViewGraph, seen: SeenPoints, noise: float) -> list[Assembled]:
    """Assemble rigs of all K views, one from each of the best pairs; return the best rig first.

    Rigs and views are compared under one `noise`, in sides. If a view shares too little with the
    others, there is no rig.
    """
    seeds = [
        (float(poses.costs[s] - poses.costs[0]), float(poses.noise), pair, s)
        for pair, poses in graph.items()
        for s in range(len(poses.costs))
    ]
    rigs = []
    for _, _, pair, s in sorted(seeds)[:SEEDS]:
        rig = _grow(graph, seen, noise, pair, s)
        if rig is not None:
            rigs.append(rig)
    return sorted(rigs, key=lambda rig: rig.cost)


def _grow(
    graph: ViewGraph, seen: SeenPoints, noise: float, pair: tuple[int, int], solution: int
) -> Assembled | None:
    """Assemble a rig from one solution of a pair, adding one camera after another."""
    views = len(seen.weights)
    poses = graph[pair]
    log_focals = np.zeros(views)
    rotations, translations = np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3))
    placed = list(pair)
    log_focals[placed] = np.log(poses.focals[solution])
    rotations[pair[1]], translations[pair[1]] = (
        poses.rotations[solution],
        poses.translations[solution],
    )
    rig = StaticCameras(
        log_focals, np.zeros((views, 2)), np.zeros((views, 2)), rotations, translations
    )
    while len(placed) < views:
        some = SeenPoints(seen.images[placed], seen.weights[placed])
        known = (some.weights > 0).sum(0) >= 2
        points = triangulate_points(
            rig.of(placed), SeenPoints(some.images[..., known], some.weights[:, known])
        )
        best: tuple[float, int, StaticCameras] | None = None
        for view in (v for v in range(views) if v not in placed):
            of_view = SeenPoints(
                seen.images[[view], :, :][..., known], seen.weights[[view]][:, known]
            )
            if (of_view.weights > 0).sum() < COMMON:
                continue
            for candidate in _candidates(graph, rig, placed, view):
                camera = _place(candidate, points, of_view)
                cost = costs_of(camera, points, of_view, np.array([noise])).sum()
                cost /= of_view.weights.sum()
                if best is None or cost < best[0]:
                    best = float(cost), view, camera
        if best is None:
            return None
        _, view, camera = best
        for array, row in zip(rig, camera, strict=True):
            array[view] = row[0]
        placed.append(view)
    points = triangulate_points(rig, seen)
    level = np.full(views, noise)
    costs = costs_of(rig, points, seen, level)
    return Assembled(rig, float(costs.sum() / seen.weights.sum()))


def _candidates(
    graph: ViewGraph, rig: StaticCameras, placed: list[int], view: int
) -> list[StaticCameras]:
    """Return rotation and focal length of a view from each solution of its pairs; K = 1."""
    candidates = []
    for other in placed:
        first = other < view
        poses = graph.get((other, view) if first else (view, other))
        if poses is None:
            continue
        for s in range(len(poses.costs)):
            turn = poses.rotations[s] if first else poses.rotations[s].T
            focal = poses.focals[s, 1 if first else 0]
            candidates.append(
                StaticCameras(
                    np.log(focal)[None],
                    np.zeros((1, 2)),
                    np.zeros((1, 2)),
                    (turn @ rig.rotations[other])[None],
                    np.zeros((1, 3)),
                )
            )
    return candidates


def _place(camera: StaticCameras, points: Float64, seen: SeenPoints) -> StaticCameras:
    """Find the translation of a camera of known rotation: robust least squares, linear in t."""
    flat = seen.images[0] / np.exp(camera.log_focals[0])  # (2, M)
    turned = camera.rotations[0] @ points
    # u (z + t_z) = (x + t_x): two equations of a point.
    weights = seen.weights[0] > 0
    robust = weights.astype(float)
    translation = np.zeros(3)
    right = flat * turned[2] - turned[:2]  # = t_xy - u t_z
    for _ in range(ROUNDS):
        total = robust.sum()
        mixed = -(robust * flat).sum(1)
        normal = np.array(
            [
                [total, 0, mixed[0]],
                [0, total, mixed[1]],
                [mixed[0], mixed[1], (robust * np.square(flat).sum(0)).sum()],
            ]
        )
        target = np.append((robust * right).sum(1), -(robust * (flat * right).sum(0)).sum())
        translation = np.linalg.solve(normal + 1e-9 * total * np.eye(3), target)
        residuals = translation[:2, None] - flat * translation[2] - right
        depths = (turned[2] + translation[2]).clip(1e-3 * np.abs(translation[2]) + 1e-9)
        distances = np.linalg.norm(residuals, axis=0) / depths
        scale = max(float(np.median(distances[weights])), 1e-9)
        robust = weights / (1 + np.square(distances / scale)) / np.square(depths)
        robust /= max(robust.max(), 1e-30)
    return camera._replace(translations=translation[None])
