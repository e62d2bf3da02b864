"""The queues' contract: the names of their jobs, and what a job may say."""

import io
import json
import pickle
import re
from typing import Any

from pydantic import BaseModel, Field
from rq.exceptions import NoSuchJobError
from rq.job import Job

from models.settings.config import FitConfig, Index, Refine
from models.settings.keypoints import MAX_VIEWS
from models.settings.rooms import FrameOfReference, Up
from store.labels import Metadata, Tags, Text
from store.mistakes import unknown

FIT_JOB = "worker.jobs.fit"
LIFT_JOB = "worker.jobs.lift"
HELP_JOB = "worker.jobs.help_lift"
JOB_ID = re.compile(rb"[A-Za-z0-9_-]{1,200}")  # what RQ takes for one, and records can hold


class PlainDataSerializer:
    """Reads jobs from any RQ producer, whichever of RQ's serializers it uses, as plain data.

    RQ's default writes pickles, which can run code when they are read. Only strings, numbers,
    lists, tuples, dictionaries and the like are accepted here: a pickle that names any class or
    function is refused before it can do anything.
    """

    @staticmethod
    def dumps(value: Any) -> bytes:
        """Write plain data as RQ's default serializer does, so that any producer can read it."""
        return pickle.dumps(value)

    @staticmethod
    def loads(data: bytes) -> Any:
        """Read plain data; raise ``pickle.UnpicklingError`` or ``ValueError`` for anything else."""
        if data[:1] in (b"[", b"{", b'"'):  # a pickle starts otherwise
            return json.loads(data)
        return _PlainDataUnpickler(io.BytesIO(data)).load()


class _PlainDataUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(
            f"A job's arguments must be plain data; this one holds {module}.{name}."
        )

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("A job's arguments must be plain data.")


class KnownJob(Job):
    """A job that may call the functions named here and nothing else.

    It runs no callback, calls no webhook, and whatever a producer wrote can be read: what makes no
    sense becomes a job that asks for nothing, which is refused as others are.
    """

    success_callback = failure_callback = stopped_callback = None
    unreadable: str | None = None

    def restore(self, raw_data: Any) -> None:
        """Take over what Redis holds of the job."""
        try:
            super().restore(raw_data)
        except NoSuchJobError:
            raise
        except Exception as error:  # noqa: BLE001 (any, for anyone may have written it)
            origin = raw_data.get(b"origin", b"fits").decode(errors="replace").encode()
            super().restore({b"data": b"", b"origin": origin})
            self.unreadable = f"This job cannot be read: {error}"
        self.webhooks = []
        if not isinstance(self.meta, dict):
            self.meta = {}

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


class FitArguments(BaseModel):
    """What :data:`FIT_JOB` may be told, in this order."""

    dataset_id: Text
    config: FitConfig | None = None
    name: Text | None = None
    from_model: Text | None = None
    tags: Tags = []
    metadata: Metadata = {}


class LiftArguments(BaseModel):
    """What :data:`LIFT_JOB` may be told, in this order."""

    model_id: Text
    dataset_id: Text
    name: Text | None = None
    refine: Refine | None = None
    views: list[Index] | None = Field(None, max_length=MAX_VIEWS)
    frame: FrameOfReference = "canonical"
    up: Up | None = None
    tags: Tags = []
    metadata: Metadata = {}


def arguments_of(job: KnownJob) -> dict[str, Any]:
    """Return what a job that asks for a fit or a lift says, by name, not yet checked.

    Raises
    ------
    ValueError
        If there is something among it that nobody asked for.
    """
    known = tuple((LiftArguments if job.func_name == LIFT_JOB else FitArguments).model_fields)
    if len(job.args) > len(known):
        raise ValueError(f"expected {', '.join(known)}, got {len(job.args)} arguments")
    arguments = dict(zip(known, job.args, strict=False)) | job.kwargs
    if extra := sorted(set(arguments) - set(known)):
        raise ValueError(f"{extra[0]}: {unknown('field', extra[0], known)}")
    return arguments
