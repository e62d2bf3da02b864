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
            turns, focals = _candidates(graph, rig, placed, view)
            shifts = _placed(turns, focals, points, of_view)
            for turn, focal, shift in zip(turns, focals, shifts, strict=True):
                camera = StaticCameras(
                    np.log(focal)[None], np.zeros((1, 2)), np.zeros((1, 2)), turn[None], shift[None]
                )
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
) -> tuple[Float64, Float64]:
    """Return rotations (C, 3, 3) and focal lengths (C,) of a view from solutions of its pairs."""
    turns, focals = [np.empty((0, 3, 3))], [np.empty(0)]
    for other in placed:
        first = other < view
        poses = graph.get((other, view) if first else (view, other))
        if poses is None:
            continue
        turn = poses.rotations if first else poses.rotations.mT
        turns.append(turn @ rig.rotations[other])
        focals.append(poses.focals[:, 1 if first else 0])
    return np.concatenate(turns), np.concatenate(focals)


def _placed(rotations: Float64, focals: Float64, points: Float64, seen: SeenPoints) -> Float64:
    """Find translations (C, 3) of a camera, for each of C rotations and focal lengths.

    Robust least squares, linear in the translation.
    """
    there = seen.weights[0] > 0
    flat = seen.images[0][:, there] / focals[:, None, None]  # (C, 2, M)
    turned = rotations @ points[:, there]  # (C, 3, M)
    # u (z + t_z) = (x + t_x): two equations of a point.
    right = flat * turned[:, 2:] - turned[:, :2]  # = t_xy - u t_z
    squares, products = np.square(flat).sum(1), (flat * right).sum(1)  # (C, M)
    robust = np.ones_like(squares)
    normal, translations = np.zeros((len(focals), 3, 3)), np.zeros((len(focals), 3))
    for _ in range(ROUNDS):
        total = robust.sum(1)
        mixed = -(robust[:, None] * flat).sum(2)
        normal[:, 0, 0] = normal[:, 1, 1] = total
        normal[:, :2, 2] = normal[:, 2, :2] = mixed
        normal[:, 2, 2] = (robust * squares).sum(1)
        target = np.append(
            (robust[:, None] * right).sum(2), -(robust * products).sum(1)[:, None], 1
        )
        ridge = 1e-9 * total[:, None, None] * np.eye(3)
        translations = np.linalg.solve(normal + ridge, target[..., None])[..., 0]
        away = translations[:, 2:]
        residuals = translations[:, :2, None] - flat * away[..., None] - right
        depths = np.maximum(turned[:, 2] + away, 1e-3 * np.abs(away) + 1e-9)
        distances = np.sqrt(np.square(residuals).sum(1)) / depths
        scale = np.maximum(np.median(distances, 1), 1e-9)[:, None]
        robust = 1 / (1 + np.square(distances / scale)) / np.square(depths)
        robust /= robust.max(1, keepdims=True).clip(1e-30)
    return translations
