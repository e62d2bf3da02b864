"""Putting back what the queue lost, and recording what others put on it."""

import logging
import time
from contextlib import suppress
from functools import partial

from pydantic import ValidationError
from redis import Redis
from redis.exceptions import RedisError
from rq.exceptions import DeserializationError, NoSuchJobError, StopRequested
from sqlalchemy.exc import DataError, IntegrityError, SQLAlchemyError, StatementError

from models.settings.config import FitConfig
from store import clock, fits, jobs, lifts, lookup
from store.database import Store
from store.errors import InputError, NotFoundError
from store.labels import Labels, storable
from store.mistakes import mistakes, summary
from store.records import FitRecord, LiftRecord
from worker import counts
from worker.contract import (
    HELP_JOB,
    LIFT_JOB,
    FitArguments,
    KnownJob,
    LiftArguments,
    PlainDataSerializer,
    arguments_of,
)
from worker.outcomes import FAULT
from worker.patience import is_outage
from worker.queue import WorkQueue, enqueue_again, open_queues
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

GRACE_SECONDS = 2.0
LONGEST_MESSAGE = 2000  # characters that are kept of what is wrong with a job


class Reconciler:
    """Keeps records and queue in step. Every worker runs one; running many is harmless."""

    def __init__(self, store: Store, connection: Redis, settings: WorkerSettings) -> None:
        self._store = store
        self._settings = settings
        self._connection = connection
        self._queues = open_queues(connection)
        self._lost_since: dict[str, float] = {}
        self._known: set[str] = set()
        self._steady_since = time.monotonic()

    def unsettle(self) -> None:
        """Note that the records cannot be reached: for one lease, expired leases are ignored."""
        self._steady_since = time.monotonic()

    def step(self) -> None:
        """Adopt jobs without a record; queue again the work that no job carries.

        Work must be without a job for a while: between leaving the queue and being claimed, a
        job is in neither place for a moment.
        """
        for queue in self._queues:
            self._set_misnamed_aside(queue)
        waiting = {job_id: queue for queue in self._queues for job_id in queue.get_job_ids()}
        taken = {  # maybe by a worker that died
            job_id: queue
            for queue in self._queues
            for job_id in queue.intermediate_queue.get_job_ids()
        }
        seen = taken | waiting
        for job_id, queue in seen.items():
            if job_id not in self._known:
                self.adopt(queue, job_id)
        self._known.intersection_update(seen)  # bounded by the queues' length
        now = time.monotonic()
        expired = now - self._steady_since > self._settings.lease_seconds
        queued = fits.recover(
            self._store,
            expired=expired,
            on_loss=partial(counts.add, self._connection, "fit_lease_losses"),
        )
        if time.monotonic() - now > clock.PROMPT_SECONDS:
            self.unsettle()
        work: dict[str, str | LiftRecord] = {fit.job_id: fit.id for fit in queued}
        work |= {
            jobs.waiting_job(lift): lift for lift in lifts.recover(self._store, expired=expired)
        }
        lost = work.keys() - waiting.keys()
        self._lost_since = {job_id: self._lost_since.get(job_id, now) for job_id in lost}
        for job_id, found in work.items():
            if job_id in lost and now - self._lost_since[job_id] >= GRACE_SECONDS:
                with suppress(NotFoundError):  # it was cancelled and deleted meanwhile
                    self._put_back(job_id, found)
                del self._lost_since[job_id]

    def _put_back(self, job_id: str, found: str | LiftRecord) -> None:
        """Queue a fit, of which the identifier is known, or a lift again."""
        record = lookup.get(self._store, FitRecord, found) if isinstance(found, str) else found
        logger.warning("%s was on no queue: putting it back", record.id)
        for queue in self._queues:
            queue.intermediate_queue.remove(job_id)
        enqueue_again(self._connection, self._store, record)

    def adopt(self, queue: WorkQueue, job_id: str) -> bool:
        """Record the request of a job on a queue, if it is new; return whether it may run.

        An error of one job does not affect others: the job is set aside.
        """
        try:
            if not self._record(queue, job_id):
                return False
        except (StopRequested, RedisError):
            raise
        except Exception as error:
            if not _is_of_the_job(error):
                raise
            logger.exception("The job %s on the queue %s is set aside", job_id, queue.name)
            self._set_aside(queue, job_id.encode(), "internal_error", FAULT)
            return False
        self._known.add(job_id)
        return True

    def _record(self, queue: WorkQueue, job_id: str) -> bool:
        """Record what a job asks for, unless that is known; return whether there is such a job."""
        if (
            jobs.by_job(self._store, FitRecord, job_id) is None
            and lifts.helped(self._store, job_id) is None
        ):
            try:
                job = KnownJob.fetch(job_id, self._connection, PlainDataSerializer)
            except NoSuchJobError:
                queue.remove(job_id)
                queue.intermediate_queue.remove(job_id)
                return False
            if isinstance(job, KnownJob) and not calls(job, HELP_JOB) and recorded_as(job) is None:
                adopt(self._store, job, self._settings)
        return True

    def _set_misnamed_aside(self, queue: WorkQueue) -> None:
        for name in queue.intermediate_queue.misnamed():
            why = "a job's identifier is 1 to 200 letters, digits, underscores and dashes"
            logger.warning("%r on the queue %s is set aside: %s", name[:200], queue.name, why)
            self._set_aside(queue, name, "invalid_arguments", f"job_id: {why}")

    def _set_aside(self, queue: WorkQueue, name: bytes, code: str, message: str) -> None:
        """Take a job from its queue; its failure is recorded, if the records can hold it."""
        refuse = partial(
            jobs.refuse,
            self._store,
            job_id=storable(name.decode(errors="replace"))[:200],
            error={"code": code, "message": message},
            dataset_id="",
        )
        if queue.name == "lifts":
            refuse(LiftRecord, name="lift", model_id="")
        else:
            refuse(FitRecord, name="fit", config={})
        queue.connection.lrem(queue.key, 0, name)  # type: ignore[arg-type]
        queue.intermediate_queue.set_aside(name)


def _is_of_the_job(error: Exception) -> bool:
    """Return whether an error is due to the job itself, and not to an outage."""
    if isinstance(error, StatementError) and isinstance(error.orig, StopRequested):
        return False  # SIGTERM raised it
    if isinstance(error, SQLAlchemyError):
        return isinstance(error, DataError | IntegrityError) or type(error) is StatementError
    return not is_outage(error)


def calls(job: KnownJob, function: str) -> bool:
    """Return whether a job calls a function; one that cannot be read calls none."""
    try:
        return bool(job.func_name == function)
    except DeserializationError:
        return False


def recorded_as(job: KnownJob) -> str | None:
    """Return the identifier of the fit or the lift that a job was recorded as, if it ever was.

    A job that was, and has no record any more, is of a fit or a lift that was deleted.
    """
    noted = job.meta.get("fit_id") or job.meta.get("lift_id")
    return noted if isinstance(noted, str) else None


def adopt(store: Store, job: KnownJob, settings: WorkerSettings) -> str:
    """Record the fit or the lift that a job of any producer asks for; return its identifier.

    A job that can never run is recorded as failed, so that its producer can read why.
    """
    is_lift = calls(job, LIFT_JOB)
    arguments: dict[str, object] = {}
    try:
        job.check_function()
        arguments = arguments_of(job)
        if is_lift:
            identifier = _create_lift(store, job, arguments, settings)
        else:
            identifier = _create_fit(store, job, arguments)
    except (
        DeserializationError,
        TypeError,
        ValueError,
        NotFoundError,
        InputError,
    ) as error:
        identifier = _refuse(store, job, arguments, error)
    job.meta["lift_id" if is_lift else "fit_id"] = identifier
    job.save_meta()  # type: ignore[no-untyped-call]
    return identifier


def _refuse(store: Store, job: KnownJob, arguments: dict[str, object], error: Exception) -> str:
    """Record a fit or a lift that failed before it began, with the fields of its job."""

    def text_of(name: str, otherwise: str = "") -> str:
        return storable(str(arguments.get(name) or otherwise))[:200]

    code = f"{error.kind}_not_found" if isinstance(error, NotFoundError) else "invalid_arguments"
    refusal = partial(
        jobs.refuse,
        store,
        job_id=job.id,
        error={"code": code, "message": storable(_in_words(error)[:LONGEST_MESSAGE])},
        dataset_id=text_of("dataset_id"),
    )
    if calls(job, LIFT_JOB):
        return refusal(LiftRecord, name=text_of("name", "lift"), model_id=text_of("model_id"))
    return refusal(
        FitRecord, name=text_of("name", "fit"), config={}, from_model=text_of("from_model") or None
    )


def _in_words(error: Exception) -> str:
    if isinstance(error, ValidationError):
        kinds = {kind.__name__: kind for kind in (FitArguments, LiftArguments)}
        return summary(mistakes(error.errors(), kinds.get(error.title)))
    return str(error.__cause__ or error)


def _create_fit(store: Store, job: KnownJob, arguments: dict[str, object]) -> str:
    asked = FitArguments.model_validate(arguments)
    return fits.create(
        store,
        dataset_id=asked.dataset_id,
        name=(asked.name or "fit")[:200],
        config=(asked.config or FitConfig()).model_dump(mode="json", exclude_unset=True),
        from_model=asked.from_model,
        priority=asked.priority,
        labels=Labels(tags=asked.tags, metadata=asked.metadata),
        job_id=job.id,
    ).id


def _create_lift(
    store: Store, job: KnownJob, arguments: dict[str, object], settings: WorkerSettings
) -> str:
    asked = LiftArguments.model_validate(arguments)
    return lifts.create(
        store,
        model_id=asked.model_id,
        dataset_id=asked.dataset_id,
        name=(asked.name or "lift")[:200],
        refine=asked.refine,
        frame=asked.frame,
        up=asked.up,
        uncertainty=asked.uncertainty,
        views=asked.views,
        labels=Labels(tags=asked.tags, metadata=asked.metadata),
        chunk_frames=settings.lift_chunk_frames,
        job_id=job.id,
    ).id
