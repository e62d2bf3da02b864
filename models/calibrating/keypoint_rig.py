"""Static cameras from keypoints alone, as a start: cameras, structures, poses."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import (
    CENTRE_X,
    CENTRE_Y,
    FOCAL,
    LENS,
    RADIAL,
    VIEW,
    Rig,
    Scene,
    ShapePrior,
    make_rig,
    make_shape_prior,
)
from models.bundle.shape_model import ShapeModel, align, learn_shapes
from models.calibrating.expectation_maximisation import LEAST_SPREAD, regauge
from models.calibrating.handedness import mirrored, same_handedness
from models.calibrating.lens_groups import (
    covariance_over_kinds,
    find_lens_groups,
    group_covariance,
)
from models.calibrating.lens_prior import (
    CENTRE_SD,
    FOCAL_SDS,
    RADIAL_2_SDS,
    RADIAL_SDS,
    UNKNOWN_CENTRE_SD,
)
from models.calibrating.problem import CalibrationProblem, Solution, grouped
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_certainty import FocalLikelihood
from models.epipolar.static_cameras import StaticCameras
from models.epipolar.static_rig import Geometry, StaticRig, StaticScene, find_static_rig
from models.numerics.rotations import nearest_rotations
from models.numerics.steps import Steps
from models.optics.lenses.projection import Lenses, project

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

FOCAL_SD, UNKNOWN_FOCAL_SD = 0.5, 0.6  # of the log focal length, with and without the image's size
STRAIGHTENINGS = 8  # steps that undo a lens
STRAY = 4.0  # radii of a structure beyond which a point does not belong to it
ROUNDS = 5  # of aligning structures and filling their gaps
LEAST_VIEWS = 3  # that determine lenses: two explain almost all keypoints with many lenses
LEAST_KNOWN = 4  # points that determine a structure's pose


def start_from_geometry(
    problem: CalibrationProblem, found: StaticRig, moving: Solution | None = None
) -> tuple[Solution, Float64] | None:
    """Return the start from static cameras, and their standard deviations (K, VIEW).

    Views that are not static are as in `moving`, which is needed if there are any. None without
    structures.
    """
    structures = _structures(found.best.points)
    if structures is None:
        return None
    noise = found.noise * problem.side
    start = _start(problem, found.best.rig, found.static, structures, noise)
    if moving is not None:
        start = _with_moving(start, moving, np.flatnonzero(~found.static))
    return start, _deviations(problem, found, structures.unit)


def static_start(problem: CalibrationProblem, seen: StaticScene, noise: float) -> Solution | None:
    """Return the start from static cameras and points; `noise` in pixels."""
    structures = _structures(seen.points)
    if structures is None:
        return None
    return _start(problem, seen.rig, np.ones(len(problem.poses), bool), structures, noise)


def geometry_of(problem: CalibrationProblem, *, declared: bool) -> Steps[Geometry]:
    """Find the static cameras from keypoints alone, in sides of the longest image.

    If the problem has its geometry, it is returned, unless cameras move in it that are `declared`
    static.
    """
    known = problem.geometry
    if known is not None and (not declared or (known.rig and known.rig.static.all())):
        return known
    # Two views determine each other worse than noise disturbs them: clean keypoints are better.
    keypoints = problem.detected if len(problem.poses) >= LEAST_VIEWS else problem.keypoints
    images, sizes = straight_images(problem, keypoints)
    graph = None if known is None else known.graph
    beliefs = lens_beliefs(problem)
    return (
        yield from find_static_rig(
            images, problem.weights, beliefs, sizes, declared=declared, graph=graph
        )
    )


def _deviations(problem: CalibrationProblem, found: StaticRig, unit: float) -> Float64:
    """Return standard deviations (K, VIEW), `unit` units of the rig in one of the structure."""
    sds = np.full((len(found.static), VIEW), np.inf)
    sds[found.static] = found.deviations[found.static]
    sds[:, FOCAL] = focal_deviations(problem, found)
    sds[:, [CENTRE_X, CENTRE_Y]] *= problem.side
    sds[:, LENS + 3 :] /= unit
    return sds


def focal_deviations(problem: CalibrationProblem, found: StaticRig) -> Float64:
    """Return standard deviations (K,) of the log focal lengths; infinite for moving views.

    Those of `found` hold if the choice between lenses of one kind and of several is right. The
    deviations of three views or more span both. Two views have theirs from the scan.
    """
    sds = np.where(found.static, found.deviations[:, FOCAL], np.inf)
    free, likelihood, expected = _free_lenses(problem, found)
    if problem.cameras_alike != "auto" or len(free) < 2 or found.static.sum() < LEAST_VIEWS:
        return sds
    kinds = (np.zeros(len(free), np.int64), np.arange(len(free)))
    priors = [group_covariance(groups, *FOCAL_SDS) for groups in kinds]
    logs = found.best.rig.log_focals[free]
    covariance = covariance_over_kinds(likelihood, expected, priors, logs)
    sds[free] = np.maximum(sds[free], np.sqrt(covariance.diagonal()))
    return sds


def _free_lenses(
    problem: CalibrationProblem, found: StaticRig
) -> tuple[Int64, FocalLikelihood, Float64]:
    """Return the static views whose lenses are not given, and their log focal lengths.

    The latter as a likelihood, and as they are expected.
    """
    beliefs = lens_beliefs(problem)
    members = np.flatnonzero(found.static)
    free = beliefs.focal_sds[members] > 0
    information, vector = found.focals
    known = np.log(beliefs.focals[members])
    likelihood = FocalLikelihood(
        information[np.ix_(free, free)],
        vector[free] - information[np.ix_(free, ~free)] @ known[~free],
    )
    return members[free], likelihood, known[free]


def lens_kinds(problem: CalibrationProblem, found: StaticRig) -> NDArray[np.int64]:
    """Return the groups (K,) of alike lenses among static views whose lenses are not given.

    The other views belong to the largest group.
    """
    free, likelihood, expected = _free_lenses(problem, found)
    if problem.cameras_alike != "auto" or len(free) < 2:
        return problem.lens_groups
    kinds = find_lens_groups(likelihood, expected, *FOCAL_SDS)
    groups = np.full(len(problem.lens_groups), np.bincount(kinds).argmax())
    groups[free] = kinds
    return groups


def _lenses(problem: CalibrationProblem, rig: StaticCameras, static: NDArray[np.bool_]) -> Lenses:
    """Return the lenses, estimated of static views; given numbers stay."""
    side, lenses = problem.side, problem.reference.lenses
    free = static[:, None] & (problem.lens_sds > 0)  # (K, LENS)
    distortion = lenses.distortion.copy()
    distortion[free[:, RADIAL], :2] = rig.radial[free[:, RADIAL]]
    focals = side * np.exp(rig.log_focals)[:, None]
    return lenses._replace(
        focals=np.where(free[:, [FOCAL]], focals, lenses.focals),
        centres=lenses.centres + np.where(free[:, [CENTRE_X]], side * rig.centres, 0.0),
        distortion=distortion,
    )


def lens_beliefs(problem: CalibrationProblem) -> Beliefs:
    """Return the prior of the lenses, in sides of the longest image."""
    images, sds = problem.images, problem.lens_sds
    focals = problem.reference.lenses.focals.mean(1)
    sides = np.where(np.isinf(sds[:, CENTRE_X]), images.sizes.max(1) / problem.side, 0)
    together = np.where(images.known, 0, UNKNOWN_CENTRE_SD) * sides
    bends = np.isinf(sds[:, RADIAL])
    radial = [
        together**2 + alone**2 * np.eye(len(sides))
        for together, alone in (RADIAL_SDS, RADIAL_2_SDS)
    ]
    unknown = np.where(images.known, FOCAL_SD, UNKNOWN_FOCAL_SD)
    own = np.where(np.isinf(sds[:, FOCAL]), unknown, sds[:, FOCAL])
    focal_covariance = np.diag(np.square(own))
    if problem.cameras_alike != "auto":
        groups, free = problem.lens_groups, np.isinf(sds[:, FOCAL])
        alike = (groups[:, None] == groups) & np.outer(free, free) & ~np.eye(len(own), dtype=bool)
        focal_covariance += np.outer(own, own) * alike
        focal_covariance += np.diag(np.where(alike.any(1), FOCAL_SDS[1] ** 2, 0))
    return Beliefs(
        focals / problem.side,
        focal_covariance,
        np.outer(together, together) + np.diag(np.square(CENTRE_SD * sides)),
        np.array(radial) * np.outer(bends, bends),
    )


def straight_images(problem: CalibrationProblem, keypoints: Float64) -> tuple[Float64, Float64]:
    """Return keypoints (N, K, P, 2) from expected principal points, and the subject's size (K,).

    Both in sides of the longest image. Distortion that was given is undone by iteration.
    """
    lenses, side = problem.reference.lenses, problem.side
    mean = lenses.focals.mean(1)[:, None, None]
    focals = lenses.focals[:, None]
    flat = (keypoints - lenses.centres[:, None]) / focals  # (N, K, P, 2)
    given = np.flatnonzero(np.isfinite(problem.lens_sds[:, RADIAL]))
    if len(given):
        bent, own = flat[:, given], lenses.of(given)
        straight = bent.copy()
        for _ in range(STRAIGHTENINGS):
            rays = np.concatenate((straight, np.ones_like(straight[..., :1])), -1)
            pixels = project(rays, own)
            straight += bent - (pixels - own.centres[:, None]) / own.focals[:, None]
        flat[:, given] = np.where(np.isfinite(straight), straight, bent)
    images = mean * flat / side
    weights = (problem.weights > 0)[..., None]
    count = weights.sum(2).clip(1)
    centred = (images - ((images * weights).sum(2) / count)[:, :, None]) * weights
    sizes = np.sqrt(np.square(centred).sum((0, 2, 3)) / weights.sum((0, 2, 3)).clip(1))
    return images, sizes


class _Structures(NamedTuple):
    """Structures of radius 1, and the similarity v = e^a R x + t that places them in the rig."""

    points: Float64  # (N, P, 3)
    rotations: Float64  # (N, 3, 3)
    translations: Float64  # (N, 3) rig units
    scales: Float64  # (N,) rig units in a unit of the structure

    @property
    def unit(self) -> float:
        """Rig units in a unit of the structure, for most frames."""
        return float(np.median(self.scales))


def _structures(points: Float64) -> _Structures | None:
    """Align triangulated structures (N, P, 3), NaN where unknown, and fill their gaps."""
    known = np.isfinite(points).all(-1)
    some = known.sum(1) > 0
    centres = np.zeros((len(points), 3))
    centres[some] = np.nanmedian(points[some], 1)
    distances = np.where(known, np.linalg.norm(points - centres[:, None], axis=-1), np.nan)
    typical = float(np.nanmedian(distances))
    known &= np.nan_to_num(distances, nan=np.inf) < STRAY * typical
    usable = known.sum(1) >= LEAST_KNOWN
    if not usable.any() or not typical > 0:
        return None
    fullest = int(known.sum(1).argmax())
    mean = np.where(known[fullest][:, None], points[fullest] - centres[fullest], 0.0)
    mean /= typical
    filled = np.where(known[..., None], np.nan_to_num(points), centres[:, None])
    rotations, scales = np.tile(np.eye(3), (len(points), 1, 1)), np.full(len(points), typical)
    shifts = centres.copy()
    for _ in range(ROUNDS):
        weights = known[usable][..., None] / known[usable].sum(1)[:, None, None]
        places = filled[usable]
        centre = (weights * places).sum(1)
        model = mean - (weights * mean).sum(1)[:, None]  # (n, P, 3)
        offsets = places - centre[:, None]
        overlap = (weights * offsets).mT @ model
        turns = nearest_rotations(overlap)
        sizes = np.sqrt(
            (weights * np.square(offsets)).sum((1, 2))
            / (weights * np.square(model)).sum((1, 2)).clip(1e-12)
        )
        rotations[usable], scales[usable] = turns, sizes
        middles = (weights * mean).sum(1)  # (n, 3)
        shifts[usable] = centre - sizes[:, None] * (turns @ middles[..., None])[..., 0]
        canonical = np.einsum("nji,npj->npi", rotations, filled - shifts[:, None])
        canonical /= scales[:, None, None]
        gaps = np.where((known & usable[:, None])[..., None], canonical, np.nan)
        seen = np.isfinite(gaps).any(0).all(-1)
        mean[seen] = np.nanmedian(gaps[:, seen], 0)
        mean -= mean.mean(0)
        mean /= np.sqrt(np.square(mean).sum(-1).mean())
    points = np.where((known & usable[:, None])[..., None], canonical, mean)
    return _Structures(points, rotations, shifts, scales)


def _start(
    problem: CalibrationProblem,
    rig: StaticCameras,
    static: NDArray[np.bool_],
    structures: _Structures,
    noise: float,
) -> Solution:
    """Combine static cameras and structures into a solution, without the other views' poses."""
    members = [int(k) for k in np.flatnonzero(static)]
    lenses = _lenses(problem, rig, static)
    placed_rig, held, placed = _in_first_camera(rig, members, lenses, structures)
    stretched = problem.reference.stretched & ~static
    placed_rig = make_rig(*placed_rig[:4], stretched)
    scene = Scene(
        structures.points,
        np.ascontiguousarray(held[:, None]),
        np.ascontiguousarray(placed[:, None]),
        np.log(structures.scales / structures.unit)[:, None],
    )
    shapes, prior = _shapes(structures.points)
    return Solution(placed_rig, scene, prior, shapes, noise, noise)


def _with_moving(start: Solution, moving: Solution, others: Int64) -> Solution:
    """Add lenses and poses of the `others`, which are groups 1, 2, ... of the start's rig."""
    rig, theirs, scene = start.rig, moving.rig.lenses, moving.scene
    focals = rig.lenses.focals.copy()
    focals[others] = theirs.focals[others]
    if not same_handedness(scene.points, start.scene.points):
        scene = mirrored(scene)
    _, similarity = align(scene.points, start.scene.points)
    scene = regauge(scene, start.scene.points, similarity, moving.rig)
    joined = Scene(
        start.scene.points,
        np.concatenate((start.scene.rotations, scene.rotations[:, others]), 1),
        np.concatenate((start.scene.translations, scene.translations[:, others]), 1),
        np.concatenate((start.scene.sizes, scene.sizes[:, others]), 1),
    )
    noise = max(start.noise, moving.noise)
    return start._replace(
        rig=rig._replace(lenses=rig.lenses._replace(focals=focals)),
        scene=joined,
        noise=noise,
        measured_noise=noise,
    )


def _in_first_camera(
    found: StaticCameras, members: list[int], lenses: Lenses, structures: _Structures
) -> tuple[Rig, Float64, Float64]:
    """Return the rig in the frame of its first camera, and poses (N, 3, 3), (N, 3) of structures.

    The unit is that of the structures.
    """
    views, unit = len(found.log_focals), structures.unit
    rotations, translations = np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3))
    first = found.rotations[members[0]], found.translations[members[0]]
    for k in members:
        rotations[k] = found.rotations[k] @ first[0].T
        translations[k] = (found.translations[k] - rotations[k] @ first[1]) / unit
    rig = make_rig(lenses, grouped(members, views), rotations, translations)
    held = first[0] @ structures.rotations
    placed = (structures.translations @ first[0].T + first[1]) / unit
    return rig, held, placed


def _shapes(points: Float64) -> tuple[ShapeModel, ShapePrior]:
    """Return the shape model of structures (N, P, 3), and the prior of frames from it."""
    shapes = learn_shapes(points, None, floor=LEAST_SPREAD)
    means = np.tile(shapes.mean, (len(points), 1, 1))
    return shapes, make_shape_prior(means, shapes.basis, shapes.spread)
