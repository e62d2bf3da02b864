"""Fits that tests store as a worker does, without one: priors that were made before."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from models.findings.finding import dumped
from models.lifting.film import film_of
from models.lifting.fitted_prior import FittedPrior
from store import attempts, fits
from store.attempts import Attempt
from store.database import Store
from worker.reports import make_report
from worker.rooms import best_frame


def put_fit(
    records: Store,
    dataset: str,
    prior: FittedPrior,
    keypoints: NDArray[Any],
    *,
    name: str = "stored",
    skeleton: dict[str, Any] | None = None,
    times: int = 1,
    attempt: Attempt | None = None,
) -> str:
    """Store a fit to keypoints (N, K, P, 2), its frames so many times; return its identifier.

    An ``attempt`` is of a fit that has begun.
    """
    film = film_of(prior, (keypoints.astype(np.float32), None, None))
    lift = film.lift(film.own)
    frames, views, count = keypoints.shape[:3]
    config = prior.config.model_dump(mode="json")
    attempt = attempt or begin_fit(records, dataset, config, name)
    error = float(np.nanmean(lift.arrays["reprojection_errors"]))
    attempts.succeed(
        records,
        attempt,
        weights=prior.to_bytes(),
        reconstruction=save(
            {key: np.concatenate([array] * times) for key, array in lift.arrays.items()}
        ),
        report=None if times > 1 else make_report(film, lift, skeleton),
        progress=None,
        describe={
            "dataset_id": dataset,
            "views": views,
            "frames": times * frames,
            "keypoints": count,
            "findings": dumped(prior.findings),
            "config": config,
            "skeleton": skeleton,
            "training_curve": [point._asdict() for point in prior.curve],
            "metrics": {
                "reprojection_error": error,
                "frames_lifted": times * frames,
                "frame_of_reference": best_frame(prior.cameras, lift.arrays, skeleton),
            },
        },
    )
    return attempt.fit_id


def begin_fit(records: Store, dataset: str, config: dict[str, Any], name: str) -> Attempt:
    """Begin a fit, as a worker does."""
    made = fits.create(records, dataset_id=dataset, name=name, config=config)
    attempt = attempts.claim(records, made.id, lease_seconds=600)
    assert attempt is not None
    return attempt


def put_first_answer(
    records: Store, attempt: Attempt, prior: FittedPrior, keypoints: NDArray[Any]
) -> None:
    """Store the first answer of a fit that has begun."""
    film = film_of(prior, (keypoints.astype(np.float32), None, None))
    attempts.save_first_answer(
        records,
        attempt,
        model=prior.to_bytes(),
        reconstruction=save(film.lift(film.own).arrays),
        findings=dumped(prior.findings),
    )
