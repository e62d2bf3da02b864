"""What was wrong with single views' pixels: findings of a fit, and keypoints mended before it."""

import numpy as np
from numpy.typing import NDArray

from models.calibrating.image_sizes import ImageSizes
from models.calibrating.self_calibration import CalibrationTask, task_of, with_geometry
from models.capture.observations import pixels_of
from models.causes.cause import Cause, mended
from models.causes.cause_search import find_causes
from models.findings.advice import attempt, attempt_steps
from models.numerics.steps import Steps, finished
from models.settings.config import FitConfig
from models.training.keypoints_of_fit import ObservedCapture, observe
from models.training.synchronising import InStep


def with_causes(task: CalibrationTask) -> Steps[CalibrationTask]:
    """Return the task with the geometry of all views, and findings of what is wrong with some.

    Pixels of single views are held against static cameras that keypoints show: where cameras move
    or have poses as they were given, the task stays as it is.
    """
    if _given(task):
        return task
    task = yield from with_geometry(task)
    if task.config.mend == "auto":  # it was undone before
        return task
    nothing: tuple[Cause, ...] = ()
    causes = yield from attempt_steps(find_causes(task.problem), nothing)
    findings = tuple(cause.finding(applied=False) for cause in causes)
    return task._replace(misread=task.misread + findings)


def observe_mended(
    read: InStep, image_sizes: ImageSizes | None, known: NDArray[np.bool_] | None, config: FitConfig
) -> tuple[ObservedCapture, ImageSizes | None]:
    """Prepare keypoints as `observe` does; with `mend: auto` causes are found and undone first.

    Returns them with the sizes of the images as they then are.
    """
    seen = observe(read, image_sizes, known, config)
    if config.mend == "off":
        return seen, image_sizes
    causes = attempt(_causes_of, (), seen, image_sizes, config)
    if not causes:
        return seen, image_sizes
    keypoints, confidence, sizes = mended(read.keypoints, read.confidence, image_sizes, causes)
    read = read._replace(keypoints=keypoints, confidence=confidence)
    seen = observe(read, sizes, known, config)
    findings = tuple(cause.finding(applied=True) for cause in causes)
    capture = seen.capture._replace(findings=(*seen.capture.findings, *findings), mends=causes)
    return seen._replace(capture=capture), sizes


def _causes_of(
    seen: ObservedCapture, image_sizes: ImageSizes | None, config: FitConfig
) -> tuple[Cause, ...]:
    several = seen.observations.usable.sum(1) > 1
    if not several.any():
        return ()
    clear, detected = seen.observations.frames(several), seen.detected.frames(several)
    task = task_of(
        pixels_of(clear)[0],
        clear.weights.astype(np.float64),
        config,
        image_sizes,
        detected=pixels_of(detected)[0],
    )
    if _given(task):
        return ()
    return finished(find_causes(finished(with_geometry(task)).problem))


def _given(task: CalibrationTask) -> bool:
    return task.config.cameras == "moving" or bool(task.problem.posed)
