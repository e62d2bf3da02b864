"""One attempt at a fit: dataset in, model and reconstruction out, interruptible at every step."""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save

from models.calibrating.handedness import DECIDED
from models.capture.metrics import Reflection, pa_mpjpe, pck
from models.findings import advice
from models.findings.finding import dumped, log_findings
from models.lifting.film import Film, film_of
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.numerics.tensor_files import WeightsError
from models.numerics.threads import use_cores, use_threads
from models.settings.config import FitConfig
from models.training.trainer import Trainer
from store import attempts, datasets, lookup, models
from store.attempts import Attempt
from store.capture import Capture, Float64
from store.database import Store
from store.errors import LeaseLostError
from store.fits import load_fitted
from store.records import DatasetRecord, FitRecord, ModelRecord
from worker.cores import usable_cores
from worker.first_answers import FirstAnswer, reconstruct, unless_away
from worker.heartbeat import Heartbeat
from worker.needs import gpu_pays
from worker.outcomes import Outcomes, recorded
from worker.patience import patiently
from worker.reports import make_report
from worker.rooms import best_frame
from worker.settings import WorkerSettings
from worker.time_slice import FitTurn

logger = logging.getLogger(__name__)

CHECKPOINT_SHARE = 20  # checkpoints may take a twentieth of the time, however large they are


def run_attempt(
    store: Store,
    attempt: Attempt,
    heartbeat: Heartbeat,
    settings: WorkerSettings,
    turn: FitTurn | None = None,
) -> None:
    """Run a claimed fit until it succeeds, fails, is cancelled, or has to give its worker up.

    Without a ``turn`` it gives way to no other fit. The outcome is in the fit's record; see
    :func:`worker.outcomes.recorded` for errors. A fault of ours, and RQ's own timeout, fail the fit
    and are raised again.
    """
    use_threads(settings.fit_threads)
    use_cores(settings.cores or usable_cores())  # which changes no digit, and is over soon
    fail = partial(_fail, store, attempt)
    outcomes = Outcomes(
        fail=fail,
        try_again=partial(attempts.give_up, store, attempt),
        fault=partial(fail, "internal_error"),
        unusable="unusable_capture",
    )
    with recorded(attempt.fit_id, outcomes):
        _run(store, attempt, heartbeat, settings, turn)


def _run(
    store: Store,
    attempt: Attempt,
    heartbeat: Heartbeat,
    settings: WorkerSettings,
    turn: FitTurn | None = None,
) -> None:
    started = time.monotonic()
    waiting = partial(patiently, hurry=lambda: heartbeat.leave or heartbeat.lost)
    fit, dataset, capture, checkpoint = waiting(partial(_load, store, attempt))
    config = FitConfig.model_validate(fit.config)
    source = partial(waiting, partial(_load_prior, store, fit))
    device = _device(settings, capture, config)
    times = datasets.times_of(dataset, capture)
    trainer = _resume(capture, times, dataset, config, source, checkpoint, device)

    def stopped() -> bool:
        """End the attempt if it has to end now; return whether it did."""
        if heartbeat.lost:
            raise LeaseLostError
        if heartbeat.cancel:
            attempts.end(store, attempt, "cancelled")
        elif heartbeat.leave:
            attempts.save_checkpoint(store, attempt, trainer.checkpoint())
            attempts.release(store, attempt)
        elif max(trainer.seconds, time.monotonic() - started) > settings.max_fit_seconds:
            limit = settings.max_fit_seconds
            _fail(store, attempt, "timed_out", f"The fit took longer than {limit} s.")
        else:
            return False
        return True

    shown = capture.keypoints, capture.confidence, times
    first = FirstAnswer(store, attempt, trainer, shown)
    waiting(partial(first.resume, fit))
    next_checkpoint = time.monotonic() + settings.checkpoint_seconds
    for progress in trainer.run():
        heartbeat.progress = _finite(asdict(progress))
        if stopped() or not first.go_on(stopped):
            return
        # What goes on between steps would start over, and what comes after them ends by itself.
        between = progress.stage == "training" and progress.stopped_by is None
        if turn is not None and between and turn.is_over():
            if _save_checkpoint(store, attempt, trainer.checkpoint()):
                attempts.release(store, attempt)
                return
            turn.begin_again()
        now = time.monotonic()
        if now >= next_checkpoint:
            _save_checkpoint(store, attempt, trainer.checkpoint())
            took = time.monotonic() - now
            next_checkpoint = now + max(settings.checkpoint_seconds, CHECKPOINT_SHARE * took)

    prior = trainer.result()
    film = film_of(prior, shown)
    lift = reconstruct(film, stopped)
    if lift is not None:
        result = _stored_form(prior, film, lift, dataset)
        described = _describe(fit, dataset, capture, prior, lift)
        done = {"progress": heartbeat.progress, "describe": described, **result}
        waiting(partial(attempts.succeed, store, attempt, **done))
        log_findings(logger, f"Fit {fit.id}", prior.findings)


def _stored_form(
    prior: FittedPrior, film: Film, lift: LiftedFrames, dataset: DatasetRecord
) -> dict[str, Any]:
    """Return what is stored of a result as objects."""
    return {
        "weights": prior.to_bytes(),
        "reconstruction": save(lift.arrays),
        "report": advice.attempt(make_report, None, film, lift, dataset.skeleton),
    }


def _describe(
    fit: FitRecord,
    dataset: DatasetRecord,
    capture: Capture,
    prior: FittedPrior,
    lift: LiftedFrames,
) -> dict[str, Any]:
    """Return columns of the record of a fit's model."""
    frame = advice.attempt(best_frame, None, prior.cameras, lift.arrays, dataset.skeleton)
    return {
        "dataset_id": fit.dataset_id,
        "views": capture.keypoints.shape[1],
        "keypoints": capture.keypoints.shape[2],
        "frames": capture.frames,
        "config": fit.config,
        "skeleton": dataset.skeleton,
        "training_curve": [_finite(point._asdict()) for point in prior.curve],
        "findings": dumped(prior.findings),
        "metrics": _finite(evaluate(prior, lift, capture)) | {"frame_of_reference": frame},
    }


def _device(settings: WorkerSettings, capture: Capture, config: FitConfig) -> str:
    """Choose where to train."""
    if settings.fit_device != "auto":
        return settings.fit_device
    pays = gpu_pays(config, *capture.keypoints.shape[:3])
    return "cuda" if pays and torch.cuda.is_available() else "cpu"


def _load(store: Store, attempt: Attempt) -> tuple[FitRecord, DatasetRecord, Capture, bytes | None]:
    fit = lookup.get(store, FitRecord, attempt.fit_id)
    dataset = lookup.get(store, DatasetRecord, fit.dataset_id)
    capture = load_fitted(store, fit)
    return fit, dataset, capture, attempts.load_checkpoint(store, fit.id)


def _save_checkpoint(store: Store, attempt: Attempt, checkpoint: bytes) -> bool:
    """Save a checkpoint, if that can be: the next will do as well. Return whether it was saved."""
    return unless_away(
        f"Fit {attempt.fit_id} goes on without a checkpoint",
        partial(attempts.save_checkpoint, store, attempt, checkpoint),
    )


def _load_prior(store: Store, fit: FitRecord) -> FittedPrior | None:
    """Load the prior that a fit starts with, None if it starts with none."""
    if fit.from_model is None:
        return None
    model = lookup.get(store, ModelRecord, fit.from_model)
    return FittedPrior.from_bytes(models.load_weights(store, model))


def _resume(
    capture: Capture,
    times: Float64 | None,
    dataset: DatasetRecord,
    config: FitConfig,
    source: Callable[[], FittedPrior | None],
    checkpoint: bytes | None,
    device: str,
) -> Trainer:
    sizes = dataset.image_sizes and [  # JSON has no tuples
        size and tuple(size) for size in dataset.image_sizes
    ]
    make = partial(
        Trainer,
        capture.keypoints,
        config,
        confidence=capture.confidence,
        times=times,
        image_sizes=sizes,
        edges=(dataset.skeleton or {}).get("edges"),
        device=device,
    )
    if checkpoint is not None:
        try:
            return make(checkpoint=checkpoint)
        except WeightsError:
            logger.exception("The checkpoint cannot be used: starting anew")
    return make(start=source())


def evaluate(prior: FittedPrior, lift: LiftedFrames, capture: Capture) -> dict[str, Any]:
    """Measure the lift of a capture; the ground truth, if there is one, is used here alone.

    Returns
    -------
    dict
        ``reprojection_error`` in pixels, mean over all views of all frames; ``pa_mpjpe`` and
        ``pck`` (share of keypoints within ``pck_threshold``) in the truth's unit, or None. A
        mirror image counts as an error if the fit could decide the handedness.
    """
    figures: dict[str, Any] = {
        "reprojection_error": float(np.nanmean(lift.reprojection_errors)),
        "frames_lifted": int(np.isfinite(lift.points3d).any((1, 2)).sum()),
        "pa_mpjpe": None,
        "pck": None,
        "pck_threshold": None,
    }
    if capture.points3d is not None:
        accuracy = pa_mpjpe(lift.points3d, capture.points3d, reflection=_reflection(prior))
        threshold = prior.config.pck_threshold
        figures |= {
            "pa_mpjpe": accuracy.mean,
            "pck": pck(accuracy, threshold),
            "pck_threshold": threshold,
        }
    return figures


def _reflection(prior: FittedPrior) -> Reflection:
    """Return whether a mirror image is allowed: only if the fit could not decide the handedness."""
    found = prior.cameras
    decided = found is not None and found.handedness_certainty >= DECIDED
    return "never" if decided else "either"


def _fail(store: Store, attempt: Attempt, code: str, message: str) -> None:
    attempts.end(store, attempt, "failed", error={"code": code, "message": message})


def _finite(figures: dict[str, Any]) -> dict[str, Any]:
    """Return the figures with None for numbers that JSON cannot represent."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in figures.items()
    }
