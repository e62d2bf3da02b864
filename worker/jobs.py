"""The job that people put on the queue."""

import logging
from typing import Any

from rq import get_current_job

from store import attempts, fits
from store.database import Store
from worker.pulse import Pulse
from worker.queue import FitJob
from worker.reconciler import adopt
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)


def fit(
    dataset_id: str,
    config: dict[str, Any] | None = None,
    name: str | None = None,
) -> dict[str, str | None]:
    """Fit a model to a dataset; the body of ``Queue("fits").enqueue("worker.jobs.fit", ...)``.

    Parameters
    ----------
    dataset_id
        A stored dataset.
    config
        Fields of :class:`models.config.FitConfig`; what is left out has its default.
    name
        For people to tell fits and models apart.

    Returns
    -------
    dict
        ``fit_id``, ``status`` and ``model_id``, as ``GET /fits/{id}`` gives them.

    Raises
    ------
    RuntimeError
        If the fit failed: its code and message, as in the record.
    """
    job = get_current_job()
    assert isinstance(job, FitJob)  # noqa: S101 (RQ runs this function in a job)
    settings = WorkerSettings()
    store = Store(settings)
    try:
        known = fits.by_job(store, job.id)
        fit_id = adopt(store, job) if known is None else known.id
        attempt = attempts.claim(store, fit_id, lease_seconds=settings.lease_seconds)
        if attempt is not None:
            logger.info("Fit %s: attempt %d starts", fit_id, attempt.number)
            with Pulse(store, attempt) as pulse:
                from worker.fitting import run_attempt  # noqa: PLC0415 (torch takes seconds)

                run_attempt(store, pulse, settings)
        record = fits.get(store, fit_id)
        logger.info("Fit %s: %s", fit_id, record.status)
    finally:
        store.close()
    if record.error is not None:
        raise RuntimeError(f"{record.error['code']}: {record.error['message']}")
    return {"fit_id": record.id, "status": record.status, "model_id": record.model_id}
