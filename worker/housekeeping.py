"""The hourly work of one of all workers: deleting old records and objects without a record."""

import logging

from store import housekeeping, retention, webhooks
from store.database import Store
from worker.queue import connect, forget_cancelled, open_queues
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)


def keep_house(settings: WorkerSettings) -> None:
    """Delete what ended long ago, condemned objects, and jobs that were cancelled long ago."""
    store = Store(settings)
    for job in retention.prune(store, settings.retention):
        logger.info("%s, %s, was kept long enough: deleted", job.id, job.status)
    housekeeping.sweep(store)
    webhooks.forget(store)
    store.close()
    with connect(str(settings.redis_url), retries=1) as connection:
        for queue in open_queues(connection):
            forget_cancelled(queue)
