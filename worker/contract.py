"""The queues' contract: the names of their jobs, and the fields of a job."""

import pickle
import re
import zlib
from collections.abc import Iterable
from typing import Any, cast

from pydantic import BaseModel, Field
from redis import Redis
from redis.exceptions import ResponseError
from rq.exceptions import NoSuchJobError
from rq.job import Job

from models.settings.config import FitConfig, Index, Refine
from models.settings.keypoints import MAX_VIEWS
from models.settings.rooms import FrameOfReference, Up
from models.settings.uncertainty import Uncertainty
from store.jobs import Priority
from store.labels import Metadata, Tags, Text
from store.mistakes import unknown
from worker import plain_data

FIT_JOB = "worker.jobs.fit"
LIFT_JOB = "worker.jobs.lift"
HELP_JOB = "worker.jobs.help_lift"
JOB_ID = re.compile(rb"[A-Za-z0-9_-]{1,200}")  # what RQ takes for one, and records can hold


# What is read of a job; its producer's callbacks, webhooks, retries and repetitions are not.
FIELDS = (
    *("data", "meta", "origin", "status", "created_at", "enqueued_at"),
    *("timeout", "result_ttl", "failure_ttl", "dependency_ids", "allow_dependency_failures"),
)
_RAW = tuple(name.encode() for name in FIELDS)
UNREADABLE = "This job cannot be read"
RESULT_SECONDS = 24 * 3600
FAILURE_SECONDS = 7 * 24 * 3600


class PlainDataSerializer:
    """Reads jobs from any RQ producer, whichever of RQ's serializers it uses, as plain data.

    RQ's default writes pickles, which can run code when they are read. Only strings, numbers,
    lists, tuples, dictionaries and the like are accepted here, and no more than a job may hold
    (``worker.plain_data``).
    """

    @staticmethod
    def dumps(value: Any) -> bytes:
        """Write plain data as RQ's default serializer does, so that any producer can read it."""
        return pickle.dumps(value)

    @staticmethod
    def loads(data: bytes) -> Any:
        """Read plain data; raise ``ValueError`` for anything else."""
        return plain_data.loads(data)


class KnownJob(Job):
    """A job that may call the functions named here and nothing else.

    It runs no callback, calls no webhook, and whatever a producer wrote can be read: what makes no
    sense becomes a job that asks for nothing, which is refused as others are.
    """

    success_callback = failure_callback = stopped_callback = None
    unreadable: str | None = None

    @classmethod
    def fetch_many(
        cls, job_ids: Iterable[str], connection: Redis, serializer: Any = None
    ) -> list[Job | None]:
        """Return jobs as ``fetch`` does; None for those that there are not."""
        found: list[Job | None] = []
        for job_id in job_ids:
            try:
                found.append(cls.fetch(job_id, connection, serializer))
            except NoSuchJobError:
                found.append(None)
        return found

    def refresh(self) -> None:
        """Read what Redis holds of the job, but nothing that is larger than a job may be.

        Raises
        ------
        NoSuchJobError
            If there is no job, or something else of its name.
        """
        with self.connection.pipeline() as pipeline:
            for name in FIELDS:
                pipeline.hstrlen(self.key, name)
            try:
                sizes = dict(zip(FIELDS, pipeline.execute(), strict=True))
            except ResponseError as error:
                if not is_of_wrong_type(error):
                    raise
                raise NoSuchJobError(f"{self.key} is no job") from error
        short = [name for name, size in sizes.items() if size <= plain_data.MAX_BYTES]
        values = self.connection.hmget(self.key, short)
        held = {
            name.encode(): value
            for name, value in zip(short, cast(list[bytes | None], values), strict=True)
            if value is not None
        }
        long = [name for name in FIELDS if name not in short]
        if long:
            held[b"data"] = b""
        self.restore(held)
        if long:
            self.unreadable = (
                f"{UNREADABLE}: expected {plain_data.MAX_BYTES} bytes at most of its {long[0]}"
            )

    def restore(self, raw_data: Any) -> None:
        """Take over what Redis holds of the job."""
        try:
            known = {name: raw_data[name] for name in _RAW if name in raw_data}
            if b"data" not in known:
                raise NoSuchJobError(f"{self.key} is no job")
            data = _inflated(known[b"data"])
            super().restore(known | {b"data": b""})
            self.data = data
            others = self._dependency_ids
            if not (isinstance(others, list) and all(isinstance(one, str) for one in others)):
                raise ValueError("expected a list of the identifiers of jobs as dependency_ids")
        except NoSuchJobError:
            raise
        except Exception as error:  # noqa: BLE001 (any, for anyone may have written it)
            origin = raw_data.get(b"origin", b"fits").decode(errors="replace").encode()
            super().restore({b"data": b"", b"origin": origin})
            self.unreadable = f"{UNREADABLE}: {error}"
        self.timeout = None  # until a worker sets its own
        self.result_ttl, self.failure_ttl = RESULT_SECONDS, FAILURE_SECONDS
        if not isinstance(self.meta, dict):
            self.meta = {}

    def dependencies_are_met(self, *how: Any, **more: Any) -> bool:
        """Return whether no other job is waited for; a job that cannot be read waits for none."""
        return not self._dependency_ids or super().dependencies_are_met(*how, **more)

    def check_function(self) -> None:
        """Raise ``ValueError`` if the job asks for another function, or cannot be read."""
        if self.unreadable is not None:
            raise ValueError(self.unreadable)
        if self.func_name not in (FIT_JOB, LIFT_JOB, HELP_JOB) or self.instance is not None:
            raise ValueError(
                f"These queues run {FIT_JOB!r} and {LIFT_JOB!r} only, not {self.func_name!r}."
            )

    @property
    def func(self) -> Any:
        """Return the job function."""
        self.check_function()
        return super().func


def is_of_wrong_type(error: Exception) -> bool:
    """Return whether Redis reports that a key has another type, because a stranger wrote it."""
    return isinstance(error, ResponseError) and "WRONGTYPE" in str(error)


def _inflated(data: bytes) -> bytes:
    """Return what RQ compressed, or the data itself; ``ValueError`` if that is too much."""
    inflater = zlib.decompressobj()
    try:
        inflated = inflater.decompress(data, plain_data.MAX_BYTES + 1)
    except zlib.error:
        return data
    if len(inflated) > plain_data.MAX_BYTES:
        raise ValueError(f"expected {plain_data.MAX_BYTES} bytes at most of its data")
    return inflated if inflater.eof else data


class FitArguments(BaseModel):
    """The arguments of :data:`FIT_JOB`, in this order."""

    dataset_id: Text
    config: FitConfig | None = None
    name: Text | None = None
    from_model: Text | None = None
    tags: Tags = []
    metadata: Metadata = {}
    priority: Priority = "normal"


class HelpArguments(BaseModel):
    """The arguments of :data:`HELP_JOB`."""

    lift_id: Text


class LiftArguments(BaseModel):
    """The arguments of :data:`LIFT_JOB`, in this order."""

    model_id: Text
    dataset_id: Text
    name: Text | None = None
    refine: Refine | None = None
    views: list[Index] | None = Field(None, max_length=MAX_VIEWS)
    frame: FrameOfReference = "canonical"
    up: Up | None = None
    tags: Tags = []
    metadata: Metadata = {}
    uncertainty: Uncertainty = "sd"


def arguments_of(job: KnownJob) -> dict[str, Any]:
    """Return the arguments of a job that asks for a fit or a lift, by name, not yet checked.

    Raises
    ------
    ValueError
        If there are unknown arguments.
    """
    known = tuple((LiftArguments if job.func_name == LIFT_JOB else FitArguments).model_fields)
    if len(job.args) > len(known):
        raise ValueError(f"expected {', '.join(known)}, got {len(job.args)} arguments")
    arguments = dict(zip(known, job.args, strict=False)) | job.kwargs
    if extra := sorted(set(arguments) - set(known)):
        raise ValueError(f"{extra[0]}: {unknown('field', extra[0], known)}")
    return arguments
