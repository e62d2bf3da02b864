"""Estimating lenses, handedness, static cameras and shapes from several views of many frames.

The start are the network's weak-perspective answers. Everything is one maximum-a-posteriori problem
(`models.bundle.adjustment`), in which given values are constants or priors. Expectation
maximisation learns the noise of the keypoints and the Gaussian shape model.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.bone_lengths import find_bone_lengths
from models.bundle.initial_poses import WeakPerspectiveScene
from models.bundle.instrumental_equations import NoisyFrames
from models.bundle.problem import FOCAL, POSE, VIEW, Scene
from models.bundle.shape_model import MOST_COMPONENTS, unknown_network_errors
from models.calibrating.arrangement_search import Arranged, search_arrangement
from models.calibrating.camera_findings import camera_findings, without_symptoms
from models.calibrating.detected_rig import adjust_to_detected
from models.calibrating.deviations import deviations
from models.calibrating.expectation_maximisation import LEAST_MEASURED, LEAST_NOISE, learn
from models.calibrating.geometry_first import settle_by_geometry, structures_of_all
from models.calibrating.given_cameras import measured_unit
from models.calibrating.given_order import as_meant
from models.calibrating.handedness import DECIDED
from models.calibrating.image_sizes import ImageSizes, images_of
from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.lens_effect import lens_findings
from models.calibrating.lens_prior import rig_prior
from models.calibrating.likely_lenses import (
    MOST_FRAMES,
    RefinedCameras,
    until_steady,
    with_likely_lenses,
    within,
)
from models.calibrating.problem import (
    CLEAR,
    CalibrationProblem,
    Solution,
    problem_of,
    reprojection_distances,
    usual_rig,
)
from models.calibrating.result import SelfCalibration
from models.findings.advice import attempt_steps, noticed
from models.findings.finding import Finding
from models.network.settling import SETTLE_ALL
from models.numerics.steps import Steps
from models.settings.config import FitConfig

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

LEAST_FRAMES = 20  # that are used
OPERATIONS = 300_000_000  # in one iteration: half a second
WORSE = 1.2  # times the previous noise: with more, adjusted cameras are not used
BENT = 1.05  # times the previous noise: beyond, constant lengths have bent settled cameras
UNSURE = 0.15  # of the log focal length: shapes determine it as well
MORE_ROUNDS = 2  # of learning, once cameras are adjusted to detected keypoints
EXACT = 2 * LEAST_MEASURED  # of the image's side: keypoints with less noise are exact


class CalibrationTask(NamedTuple):
    """The keypoints of a capture, and what is given of its cameras."""

    problem: CalibrationProblem  # of frames with two usable views or more
    config: FitConfig  # its poses in the convention that fits the keypoints
    misread: tuple[Finding, ...]  # given poses that were in another convention
    noisy: NoisyFrames | None
    edges: Int64 | None

    def of(self, frames: Int64) -> "CalibrationTask":
        """Return the task for some of the frames."""
        return self._replace(problem=self.problem.of(frames))


def task_of(
    keypoints: Float64,
    weights: Float64,
    config: FitConfig,
    image_sizes: ImageSizes | None,
    *,
    detected: Float64 | None = None,
    noisy: NoisyFrames | None = None,
    edges: Int64 | None = None,
) -> CalibrationTask:
    """Return the task of finding the cameras.

    Parameters
    ----------
    keypoints, weights
        (N, K, P, 2) pixels and (N, K, P) confidences of frames with two usable views or more.
    detected
        (N, K, P, 2) pixels, the keypoints before noise was removed; None: no noise was removed.
        Denoised keypoints of three views or more are no longer one rigid scene.
    noisy
        All frames of the capture, if noise was removed from them.
    edges
        (E, 2) keypoints that a skeleton joins.
    """
    config, misread = _as_meant(keypoints, weights, config, image_sizes)
    problem = problem_of(keypoints, weights, image_sizes, config, detected=detected)
    return CalibrationTask(problem, config, misread, noisy, edges)


def self_calibrate(
    task: CalibrationTask, answers: WeakPerspectiveScene
) -> Steps[tuple[SelfCalibration, Scene]]:
    """Estimate lenses, handedness, static cameras and the shape model; yields between iterations.

    `answers` are the network's, for the frames of the task.

    Returns
    -------
    The calibration, and the structures and poses of the frames.

    Raises
    ------
    NothingFoundError
        When no frame can be explained at all.
    numpy.linalg.LinAlgError
        When the cameras are not determined.
    """
    problem, config, misread, noisy, edges = task
    arranged = yield from search_arrangement(problem, answers, config)
    likely = yield from with_likely_lenses(arranged, _share_left(arranged, noisy))
    problem, best, kept, reason = yield from _refined(likely, noisy, edges)
    sds = deviations(problem, best)
    if kept is not None:
        sds = np.where(np.isfinite(kept), kept, sds)
    found = yield from _result(
        problem,
        best,
        sds,
        reason,
        arranged.certain,
        arranged.unit,
        misread + arranged.findings,
        config,
    )
    return found, best.scene


def with_geometry(task: CalibrationTask) -> Steps[CalibrationTask]:
    """Return the task with the geometry of all views, unless poses or motion are given."""
    problem = task.problem
    if problem.posed or task.config.cameras == "moving" or len(problem.poses) < 2:
        return task
    found = yield from geometry_of(problem, declared=False)
    return task._replace(problem=problem._replace(geometry=found))


def calibrate_by_geometry(
    task: CalibrationTask,
) -> Steps[tuple[SelfCalibration, Scene] | None]:
    """Take static cameras from a task `with_geometry`; None where geometry does not decide.

    `self_calibrate` handles all other cases.
    """
    problem, config, misread, noisy, edges = task
    most = most_frames(*problem.keypoints.shape[1:3])
    settled = yield from settle_by_geometry(problem, config, most=most)
    if settled is None:
        return None
    arranged = settled.arranged
    likely = yield from with_likely_lenses(arranged, _share_left(arranged, noisy))
    part, best, kept, reason = yield from _refined(likely, noisy, edges)
    sds = deviations(part, best) if kept is None else kept
    if best.noise <= LEAST_NOISE * part.side:
        best, sds = yield from _exact(arranged, best, sds)
    if arranged.kept is not None and (likely.kept is not None or len(sds) == 2):
        # Other focal lengths, of the posterior or of other kinds of lens, are nearly as likely.
        sds = np.maximum(sds, arranged.kept)
    found = yield from _result(part, best, sds, reason, arranged.certain, None, misread, config)
    return found, structures_of_all(problem, best, settled.start)


def _exact(arranged: Arranged, best: Solution, sds: Float64) -> Steps[tuple[Solution, Float64]]:
    """Fit structures closely to clear keypoints, with cameras that no longer change.

    If cameras changed by shapes and bones explain the keypoints worse than those of geometry, the
    latter are returned, with their deviations: until here, noise below `LEAST_NOISE` was ignored.
    """
    problem, settled = arranged.checked.problem, arranged.checked.solution
    static = problem._replace(kept=np.ones(len(problem.poses), bool))
    exact = yield from learn(static, best, least_noise=LEAST_MEASURED)
    if best is settled or len(sds) == 2 or arranged.kept is None:
        return exact, sds
    before = yield from learn(static, settled, least_noise=LEAST_MEASURED)
    if exact.measured_noise > WORSE * before.measured_noise:
        return before, arranged.kept
    return exact, sds


def _share_left(arranged: Arranged, noisy: NoisyFrames | None) -> float:
    """Return the effective share of independent observations after noise removal."""
    if noisy is None:
        return 1.0
    return min(1.0, arranged.checked.solution.noise / noisy.noise) ** 2


def _refined(
    refined: RefinedCameras, noisy: NoisyFrames | None, edges: Int64 | None
) -> Steps[RefinedCameras]:
    """Use keypoints as they were detected, then bones."""
    # Geometry has used keypoints as they were detected. Two settled views have lenses from the
    # evidence of shapes: a skeleton adds information.
    settled = refined.kept is not None
    pair = settled and len(refined.best.rig.groups) == 2
    if noisy is not None and (not settled or (pair and edges is not None and len(edges) > 0)):
        detected = yield from _by_detected(refined, noisy, edges)
        refined = detected if detected and within(detected) else refined
        settled = refined.kept is not None
    problem, best = refined.problem, refined.best
    # Lengths of bones decide the lenses of two views, also where the image is far larger than the
    # subject and lens models leave more than the noise. Where geometry settled more views, they
    # correct only what lens models leave: they bend cameras as soon as there is noise.
    noise = best.measured_noise if settled else best.noise
    most = EXACT * problem.side if settled and not pair else CLEAR * problem.size
    if noise > most or (settled and noisy is not None):
        return refined
    try:
        best = yield from _by_clear(refined)
    except np.linalg.LinAlgError:  # they add nothing
        if refined.kept is None:
            raise
        return refined
    if settled and best.measured_noise > BENT * refined.best.measured_noise:
        return refined
    cleared = refined._replace(best=best, kept=None)
    return refined if best is refined.best or not within(cleared) else cleared


def _by_clear(refined: RefinedCameras) -> Steps[Solution]:
    """Adjust cameras and shapes to clear keypoints, and to constant lengths."""
    problem, best = refined.problem, refined.best
    pair = refined.kept is not None and len(refined.kept) == 2
    if pair:
        # From bones alone the six pairs of human36m end a third worse.
        best = yield from learn(problem, best)
    if find_bone_lengths(best.scene.points, problem.measured).steady:
        # With a wrong lens bones grow and shrink as they turn, even if shapes are most alike.
        best = yield from learn(problem, best, with_bones=True)
        if pair:  # the posterior's mean may be far off what clear keypoints determine
            best = yield from until_steady(problem, best, with_bones=True)
    return best


def _as_meant(
    keypoints: Float64, weights: Float64, config: FitConfig, image_sizes: ImageSizes | None
) -> tuple[FitConfig, tuple[Finding, ...]]:
    """Return the configuration with the poses in the convention that fits the keypoints."""
    if config.calibration is None:
        return config, ()
    usual = usual_rig(images_of(keypoints, weights, image_sizes))
    meant, findings = as_meant(keypoints, weights, usual, config.calibration)
    return config.model_copy(update={"calibration": tuple(meant)}), findings


def _by_detected(
    refined: RefinedCameras, noisy: NoisyFrames, edges: Int64 | None
) -> Steps[RefinedCameras | None]:
    """Adjust static cameras to keypoints as they were detected, and everything else to them.

    None if detected keypoints determine no more than shapes do, or if the cameras do not explain
    the clear ones as well as before.
    """
    problem, best = refined.problem, refined.best
    static = best.rig.static
    if not static.any() or best.given_poses is not None:
        return None
    if edges is None or not len(edges):
        edges = find_bone_lengths(best.scene.points, problem.measured).ends.T
    believed = rig_prior(
        problem._replace(kept=np.zeros_like(problem.kept)), best.rig, given_poses=None
    )
    # Shapes affect distortion most, and a wrong distortion is no good start.
    ours, usual = best.rig.lenses, problem.reference.lenses
    straight = ours._replace(
        distortion=np.where(static[:, None], usual.distortion, ours.distortion)
    )
    try:
        found = yield from adjust_to_detected(
            noisy, edges, best.rig._replace(lenses=straight), believed
        )
        if found is None or not found[1][static, FOCAL].max() < UNSURE:
            return None
        rig, sds = found
        adjusted = yield from learn(
            problem._replace(kept=static), best._replace(rig=rig), rounds=MORE_ROUNDS
        )
    except np.linalg.LinAlgError:
        return None
    if adjusted.noise > WORSE * best.noise:
        return None
    reason = f"{refined.reason}; cameras are adjusted to keypoints as they were detected"
    return refined._replace(best=adjusted, kept=sds, reason=reason)


def most_frames(views: int, keypoints: int) -> int:
    """Return how many frames a search can use in bounded time: half a second an iteration."""
    unknowns = (POSE + VIEW) * views + MOST_COMPONENTS
    return max(LEAST_FRAMES, min(MOST_FRAMES, OPERATIONS // (3 * keypoints * unknowns**2)))


def _result(
    problem: CalibrationProblem,
    best: Solution,
    sds: Float64,
    reason: str,
    certain: float,
    unit: float | None,
    findings: tuple[Finding, ...],
    config: FitConfig,
) -> Steps[SelfCalibration]:
    unit, of_unit = measured_unit(best, sds, config, unit)
    findings += of_unit
    if certain < DECIDED:
        findings += (Finding.of("handedness_not_observable", certainty=certain),)
    observed = problem.weights > 0  # (N, K, P)
    distances = reprojection_distances(problem, best.rig, best.scene)
    found = SelfCalibration(
        rig=best.rig,
        deviations=sds,
        shapes=best.shapes,
        network_errors=unknown_network_errors(problem.keypoints.shape[2]),
        settling=SETTLE_ALL,
        noise=best.measured_noise,
        unit=1.0 if unit is None else unit,
        reprojection_errors=(distances * observed).sum((0, 2)) / observed.sum((0, 2)).clip(1),
        reason=reason,
        findings=findings,
        handedness_certainty=certain,
    )
    declared = config.cameras == "static"
    of_cameras = noticed(camera_findings, problem, found, declared=declared)
    of_lenses = yield from attempt_steps(lens_findings(problem, best, sds), ())
    return replace(found, findings=without_symptoms((*findings, *of_cameras, *of_lenses)))
