"""What would grow goes in time: ended fits that nobody is to keep, jobs that were cancelled."""

import pytest
from redis import Redis
from rq import Queue
from rq.job import Job
from rq.registry import CanceledJobRegistry
from sqlalchemy import text

from store import fits, lookup
from store.database import Store
from store.errors import NotFoundError
from store.records import FitRecord
from worker.housekeeping import keep_house
from worker.settings import WorkerSettings

DAY = 24 * 3600


def test_what_was_kept_long_enough_goes(
    store: Store, settings: WorkerSettings, redis: Redis, dataset_id: str
) -> None:
    old, recent = (
        fits.create(store, dataset_id=dataset_id, name=name, config={}) for name in ("old", "new")
    )
    for fit in (old, recent):
        fits.cancel(store, fit.id)
    with store.writing() as session:
        aged = text("UPDATE fits SET finished_at = finished_at - :age WHERE id = :id")
        session.execute(aged, {"age": 31 * DAY, "id": old.id})
    queue = Queue("fits", connection=redis)
    forgotten, remembered = (queue.enqueue("worker.jobs.fit", dataset_id) for _ in range(2))
    for job in (forgotten, remembered):
        job.cancel()
    cancelled = CanceledJobRegistry(queue=queue)
    redis.zincrby(cancelled.key, -8 * DAY, forgotten.id)

    keep_house(settings)
    assert lookup.get(store, FitRecord, old.id).name == "old"  # as long as nobody asks for less
    assert cancelled.get_job_ids() == [remembered.id]
    assert not Job.exists(forgotten.id, connection=redis)
    keep_house(settings.model_copy(update={"keep_failed_days": 30.0}))
    with pytest.raises(NotFoundError):
        lookup.get(store, FitRecord, old.id)
    assert lookup.get(store, FitRecord, recent.id).name == "new"
