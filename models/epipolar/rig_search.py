"""The search for a static rig: starts from pairs of views, other lenses, the mirror image.

All starts are compared under one common noise, each with its points located anew.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from models.epipolar.affine_rigs import affine_rigs
from models.epipolar.assembly import ViewGraph, assemble
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, adjust_rig, cost_of
from models.epipolar.robust_points import robust_points, triangulate_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras
from models.epipolar.view_graph import LENS_NOISE
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

STARTS, FINALISTS = 6, 2
OTHER_FOCALS, SWEEPS, SWEEP_ITERATIONS = (0.5, 2.0), 2, 6
# Figures: evidence/static-rigs.md.
COMMON_FACTORS = (0.6, 1.6)  # of all focal lengths; clear keypoints may hold a rig at its start
FIRST_ITERATIONS, MORE_ITERATIONS = 15, 20
SAME = 0.03  # radians and share of focal lengths within which rigs count as one
# Limits of the noise in a first adjustment: this share of the subject's size, and what lens models
# leave.
FIRST_NOISE = 0.02
COOLING = (1.0, 0.03)  # of it, one after another


def likely_rigs(
    graph: ViewGraph, few: SeenPoints, beliefs: Beliefs, sizes: Float64
) -> Steps[list[AdjustedRig]]:
    """Return the best rig of all K views and the best different one; none if views do not connect.

    `few` points are used; `sizes` (K,) are the subject's in each view, in sides.
    """
    if not graph:
        return []
    noise = float(np.median([poses.noise for poses in graph.values()]))
    assembled = [each.rig for each in assemble(graph, few, max(noise, 1e-3))]
    rigs = affine_rigs(few, beliefs) + assembled
    if not rigs:
        return []
    least = min(LENS_NOISE, FIRST_NOISE * float(np.median(sizes)))
    free = replace(beliefs, alike=False)
    first = []
    for rig in _distinct(rigs, STARTS):
        yield
        points = triangulate_points(rig, few)
        first.append(
            adjust_rig(
                rig,
                points,
                few,
                free,
                iterations=FIRST_ITERATIONS,
                lenses=False,
                least_noise=least,
            )
        )
    first = ordered(first, few, free)
    first[0] = yield from _with_other_lenses(first[0], few, free, least)
    return (yield from _with_lenses(first, few, beliefs, least))


def _with_lenses(
    first: list[AdjustedRig], few: SeenPoints, beliefs: Beliefs, least: float
) -> Steps[list[AdjustedRig]]:
    """Adjust the best rigs with free lenses: as is, alike, mirrored, longer and shorter."""
    second = []
    for adjusted in first[:FINALISTS]:
        rig = adjusted.rig
        alike = rig._replace(
            log_focals=np.where(beliefs.focal_sds > 0, np.median(rig.log_focals), rig.log_focals)
        )
        for start in (rig, alike):
            yield
            second.append(_nearer(start, adjusted.points, few, beliefs, least))
    second.append(_nearer(*necker(second[0].rig, second[0].points), few, beliefs, least))
    best = ordered(second, few, beliefs)[0]
    # Two views fit almost any focal lengths: shapes choose them later.
    for factor in COMMON_FACTORS if len(best.noise) > 2 else ():
        yield
        change = np.log(factor) * (beliefs.focal_sds > 0)
        rig = refocused(best.rig, best.points, best.rig.log_focals + change)
        points = robust_points(rig, few, np.maximum(best.noise, least))
        second.append(_nearer(rig, points, few, beliefs, least))
    finalists = ordered(second, few, beliefs)
    others = [each for each in finalists[1:] if not same_rig(each.rig, finalists[0].rig)]
    return [finalists[0], *others[:1]]


def necker(rig: StaticCameras, points: Float64) -> tuple[StaticCameras, Float64]:
    """Return the mirror image of cameras and points (3, M), which looks the same from far away."""
    centre = np.median(points, 1)
    flip = np.diag([1.0, 1.0, -1.0])
    translations = rig.translations + rig.rotations @ centre
    mirrored = rig._replace(rotations=flip @ rig.rotations @ flip, translations=translations)
    return mirrored, flip @ (points - centre[:, None])


def _with_other_lenses(
    adjusted: AdjustedRig, seen: SeenPoints, beliefs: Beliefs, least_noise: float
) -> Steps[AdjustedRig]:
    """Try other focal lengths of one camera after another, at distances that keep sizes equal.

    A nearer camera with a shorter lens sees nearly the same, so adjustment alone hardly moves from
    one to the other.
    """
    views = np.flatnonzero(beliefs.focal_sds > 0)
    for _ in range(SWEEPS):
        before = adjusted
        for view in views:
            yield
            tried = [adjusted]
            for factor in OTHER_FOCALS:
                rig = StaticCameras(*(array.copy() for array in adjusted.rig))
                rig.log_focals[view] += np.log(factor)
                rig.translations[view, 2] *= factor
                points = adjusted.points
                near = adjust_rig(
                    rig,
                    points,
                    seen,
                    beliefs,
                    iterations=SWEEP_ITERATIONS,
                    lenses=False,
                    least_noise=least_noise,
                )
                tried.append(near)
            adjusted = ordered(tried, seen, beliefs)[0]
        if same_rig(adjusted.rig, before.rig):
            break
    return adjusted


def refocused(rig: StaticCameras, points: Float64, log_focals: Float64) -> StaticCameras:
    """Change focal lengths, and move each camera so that it sees the points (3, M) as large."""
    centre = np.median(points, 1)
    translations = rig.translations + rig.rotations @ centre
    translations[:, 2] *= np.exp(log_focals - rig.log_focals)
    return rig._replace(log_focals=log_focals, translations=translations)


def _nearer(
    rig: StaticCameras, points: Float64, seen: SeenPoints, beliefs: Beliefs, least_noise: float
) -> AdjustedRig:
    """Adjust a start with a falling lower limit of the noise: first, far observations pull too."""
    adjusted = AdjustedRig(rig, points, np.full(len(rig.log_focals), least_noise))
    for share in COOLING:
        adjusted = adjust_rig(
            adjusted.rig,
            adjusted.points,
            seen,
            beliefs,
            iterations=MORE_ITERATIONS,
            least_noise=share * least_noise,
        )
    return adjusted


def finished_rig(
    adjusted: AdjustedRig, seen: SeenPoints, beliefs: Beliefs, *, iterations: int
) -> AdjustedRig:
    """Adjust a rig to all keypoints, with points located anew."""
    points = robust_points(adjusted.rig, seen, adjusted.noise)
    return adjust_rig(adjusted.rig, points, seen, beliefs, iterations=iterations)


def ordered(rigs: list[AdjustedRig], seen: SeenPoints, beliefs: Beliefs) -> list[AdjustedRig]:
    """Sort by cost under one common noise: under its own, a rig that fits worse could win.

    Points are located anew, since a point misled by an outlier is no evidence about the cameras.
    """
    common = np.min([rig.noise for rig in rigs], 0)
    located = [
        each._replace(points=robust_points(each.rig, seen, common, start=each.points))
        for each in rigs
    ]
    costs = [cost_of(each.rig, each.points, seen, common, beliefs) for each in located]
    return [located[place] for place in np.argsort(costs, kind="stable")]


def _distinct(rigs: list[StaticCameras], most: int) -> list[StaticCameras]:
    """Return the first rigs of which no two are the same."""
    kept: list[StaticCameras] = []
    for rig in rigs:
        if len(kept) < most and not any(same_rig(rig, other) for other in kept):
            kept.append(rig)
    return kept


def same_rig(rig: StaticCameras, other: StaticCameras) -> bool:
    """Whether rotations and focal lengths of two rigs are the same, or nearly."""
    turns = [r.rotations @ r.rotations[0].T for r in (rig, other)]
    relative = turns[0] @ turns[1].mT
    cosines = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    angles = np.arccos(cosines.clip(-1, 1))
    return bool(angles.max() < SAME and np.abs(rig.log_focals - other.log_focals).max() < SAME)
