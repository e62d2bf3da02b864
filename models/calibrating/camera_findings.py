"""Findings about estimated cameras: how they move, doubtful lenses, noise, opposite views."""

from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import get_args

import numpy as np

from models.bundle.problem import CENTRE_X, FOCAL, RADIAL
from models.calibrating.problem import USUAL_FOCAL, CalibrationProblem
from models.calibrating.result import SelfCalibration
from models.epipolar.static_rig import SURE
from models.findings.catalogue import CauseCode
from models.findings.finding import Finding
from models.optics.lenses.projection import PINHOLE

NOISY = 0.2  # of a view's radius: at a person's, 10 cm
UNSURE_FOCAL = 0.2  # standard deviation of its log: that of the prior is little larger
SHORTEST, LONGEST = 0.35, 6.0  # focal lengths in sides of the image: fields of view of 110, 10 deg
MOST_BENT = 1.0  # first radial coefficient, of a pinhole
OFF_CENTRE = (
    0.75  # of the image's longest side: a principal point so far from the middle is outside
)
DISAGREE = 4.0  # standard deviations of a given focal length
NARROW = 10.0  # degrees between two directions of view, or missing to 180
CAUSES = frozenset(get_args(CauseCode.__value__))
OF_VIEWS = ("lenses_extreme", "calibration_disagrees", "lens_disagrees")  # symptoms of causes
OF_ALL = ("noise_high", "views_opposite")


def camera_findings(
    problem: CalibrationProblem, found: SelfCalibration, *, declared: bool = False
) -> tuple[Finding, ...]:
    """Return findings of the cameras that were found, or that were `declared` static.

    Given numbers of a camera that are kept get no findings.
    """
    return (
        *(() if declared else _arrangement(problem, found)),
        *_lenses(problem, found),
        *_given(problem, found),
        *_noise(found, problem.size),
        *_opposite(found),
    )


def without_symptoms(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings without those that a cause among them explains.

    Symptoms of views go if all their views have a cause, those of all cameras if any has.
    """
    findings = tuple(findings)
    explained = {v for finding in findings if finding.code in CAUSES for v in finding.views}

    def is_symptom(finding: Finding) -> bool:
        if finding.code in OF_VIEWS:
            return bool(finding.views) and explained.issuperset(finding.views)
        return finding.code in OF_ALL and bool(explained)

    return tuple(finding for finding in findings if not is_symptom(finding))


def _arrangement(problem: CalibrationProblem, found: SelfCalibration) -> Iterator[Finding]:
    """Yield a finding of two views that move, or that geometry does not show to be static."""
    free = found.deviations[:, FOCAL] > 0
    if len(free) != 2 or not free.any() or problem.posed:
        return
    moving, geometry = ~found.static, problem.geometry
    if not moving.any() and geometry is not None:
        rig = geometry.rig  # without one, shapes alone have decided that cameras are static
        moving = ~moving if rig is None else rig.motion.gains > SURE * rig.motion.errors
    if moving.any():
        yield Finding.of("arrangement_not_observable", views=np.flatnonzero(moving))


def _lenses(problem: CalibrationProblem, found: SelfCalibration) -> Iterator[Finding]:
    lenses, deviations, images = found.rig.lenses, found.deviations, problem.images
    sought = deviations[:, FOCAL] > 0  # (K,)
    unsure = sought & (deviations[:, FOCAL] > UNSURE_FOCAL)
    if unsure.any():
        yield Finding.of(
            "focal_not_observable",
            views=() if unsure.all() else np.flatnonzero(unsure),
            largest_relative_sd=float(deviations[unsure, FOCAL].max()),
        )
    focals = lenses.focals.mean(-1) / images.sizes.max(-1)  # (K,) in sides
    away = np.abs(lenses.centres - images.middles).max(-1) / images.sizes.max(-1)
    bent = np.where(lenses.models == PINHOLE, np.abs(lenses.distortion[:, 0]), 0)
    boxes = problem.usual.lenses.focals.mean(-1) / images.sizes.max(-1) / USUAL_FOCAL  # (K,)
    extreme = sought & ((focals < boxes * SHORTEST) | (focals > boxes * LONGEST))
    extreme |= (deviations[:, CENTRE_X] > 0) & (away > OFF_CENTRE)
    extreme |= (deviations[:, RADIAL] > 0) & (bent > MOST_BENT)
    if extreme.any():
        yield Finding.of(
            "lenses_extreme",
            views=np.flatnonzero(extreme),
            shortest_focal_in_sides=float(focals[extreme].min()),
            longest_focal_in_sides=float(focals[extreme].max()),
            largest_k1=float(bent[extreme].max()),
        )


def _given(problem: CalibrationProblem, found: SelfCalibration) -> Iterator[Finding]:
    """Yield a finding of each view whose focal length is far from the given one."""
    given, ours = problem.given_focals, found.rig.lenses.focals.mean(-1)
    far = np.abs(np.log(ours / given)) > DISAGREE * problem.lens_sds[:, FOCAL]  # False for NaN
    for view in np.flatnonzero(far & (problem.lens_sds[:, FOCAL] > 0)).tolist():
        yield Finding.of(
            "lens_disagrees", views=(view,), given_focal_px=given[view], focal_px=ours[view]
        )


def _noise(found: SelfCalibration, size: float) -> Iterator[Finding]:
    if found.noise > NOISY * size:
        share = found.noise / size
        yield Finding.of("noise_high", noise_px=found.noise, share_of_subject=share)


def _opposite(found: SelfCalibration) -> Iterator[Finding]:
    """Yield the pairs of static views if all face each other or look from the same side."""
    static = np.flatnonzero(found.static)
    axes = found.rig.rotations[:, 2]  # (K, 3) directions of view in the common frame
    angles = {
        (int(a), int(b)): float(np.degrees(np.arccos(np.clip(axes[a] @ axes[b], -1, 1))))
        for a, b in combinations(static, 2)
    }
    if angles and all(min(angle, 180 - angle) < NARROW for angle in angles.values()):
        for pair, angle in angles.items():
            yield Finding.of("views_opposite", views=pair, degrees=angle)
