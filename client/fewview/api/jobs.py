"""What fits and lifts have in common: jobs that are followed, cancelled and deleted."""

import json
from collections.abc import Callable
from typing import Any, TypeVar

from fewview.api.forms import Job, form_in, read
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, operation
from fewview.api.retries import patiently, pause_before
from fewview.api.steps import Open, Read, Request, Sleep, Steps, nothing, path
from fewview.api.stored import Stored
from fewview.errors import ApiError, ConnectionFailed, JobFailed, NotFound

J = TypeVar("J", bound=Job)
MOST_TRIES = 3  # to get events, after which a job is only asked about now and then


class Jobs(Stored[Driver, J]):
    """``/fits`` or ``/lifts``; what a job made outlives it, its result does not."""

    @operation
    def cancel(self, job: J | str) -> Steps[J]:
        """Cancel a job; its work is lost.

        Raises
        ------
        Conflict
            It has ended.
        """
        where = path(self._plural, identifier(job), "cancel")
        return self._call(Request("POST", where, form_in(self._form)))

    @operation
    def wait(self, job: J | str, *, on_progress: Callable[[J], object] | None = None) -> Steps[J]:
        """Wait until a job has succeeded, and return it as it is then.

        The service sends events; where these do not get through, it is asked now and then.

        Parameters
        ----------
        on_progress
            Is called with the job whenever it has changed, a plain function for both clients.

        Raises
        ------
        JobFailed
            It failed or was cancelled.
        NotFound
            There is no such job, or it was deleted meanwhile.
        ConnectionFailed
            The service was away for longer than the client's ``patience``.
        """
        return self._wait(identifier(job), on_progress, lambda found: found.ended)

    def _wait(
        self, job_id: str, on_progress: Callable[[J], object] | None, enough: Callable[[J], bool]
    ) -> Steps[J]:
        """Wait until a job has ended, or is what is waited for."""
        following = _Following(job_id, on_progress or ignore, enough)
        failures = 0
        while True:
            if failures < MOST_TRIES:
                heard = yield from self._hear(following)
                failures = 0 if heard else failures + 1
            if not following.over:
                following.notify((yield from self._call(self._get(following.job_id))))
            found: J = following.job
            if following.over:
                return _succeeded(found) if found.ended else found
            yield Sleep(pause_before(failures + 2))

    def _hear(self, following: "_Following") -> Steps[bool]:
        """Follow a job's events; return whether any came."""
        where = path(self._plural, following.job_id, "events")
        last = following.last_event
        headers = {"Accept": "text/event-stream", **({"Last-Event-ID": last} if last else {})}
        request = Request("GET", where, nothing, headers=headers)
        heard = False
        try:
            yield from patiently(Open(request, events=True), self._patience)
            while (event := (yield Read())) is not None:
                heard, following.last_event = True, event.id
                following.notify(read(self._form, json.loads(event.data)))
                if event.event == "end" or following.over:
                    break
        except NotFound:
            raise
        except (ApiError, ConnectionFailed):  # then it is asked, which may fail likewise
            pass
        return heard


class _Following:
    """What is known of a job that is waited for."""

    def __init__(
        self, job_id: str, on_progress: Callable[[Any], object], enough: Callable[[Any], bool]
    ) -> None:
        self.job_id, self._on_progress, self._enough = job_id, on_progress, enough
        self.job: Any = None
        self.last_event = ""

    @property
    def over(self) -> bool:
        """Whether the job has ended, or is what is waited for."""
        return self.job is not None and (self.job.ended or self._enough(self.job))

    def notify(self, job: Job) -> None:
        """Pass on a job that has changed."""
        if self.job is None or job.raw != self.job.raw:
            self.job = job
            self._on_progress(job)


def ignore(_job: object) -> None:
    """Keep progress to oneself."""


def _succeeded(job: J) -> J:
    if job.status == "succeeded":
        return job
    if job.error is not None:
        raise JobFailed(job, job.error.code, job.error.message)
    raise JobFailed(job, job.status, f"it was {job.status}; create another to have its result")
