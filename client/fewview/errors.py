"""Everything that the client raises.

::

    FewviewError
    ├── ApiError             the service answered that it would not: status, code, detail, errors
    │   ├── InvalidRequest   400, 406, 413, 415, 416, 422: what was sent is wrong, and where
    │   ├── Unauthorized     401: there is no key, or it is not in force
    │   ├── Forbidden        403: the key does not allow this
    │   ├── NotFound         404: there is no such dataset, fit, model or lift
    │   ├── Conflict         409, 412: not in the state that it is in, or that it was read in
    │   ├── TooManyRequests  429: too many jobs wait, or a key has its share
    │   └── Unavailable      502, 503, 504: the service or a part of it is away for the moment
    ├── ConnectionFailed     the service cannot be reached, or does not answer as one
    ├── JobFailed            a fit or a lift failed or was cancelled: code, message
    └── FormatError          a file cannot be read or written (a ValueError, too)
"""

from dataclasses import dataclass
from typing import Any, Protocol

LONGEST_PROBLEM, LONGEST_PART = 1000, 300  # characters of a `FormatError`


class FewviewError(Exception):
    """Any error of the client; its message has the remedy."""


@dataclass(frozen=True)
class FieldError:
    """What is wrong with one field.

    Attributes
    ----------
    pointer
        JSON pointer (RFC 6901) to the field, such as ``/config/steps``.
    detail
        What was expected, what came, and how to mend it.
    """

    pointer: str
    detail: str


class ApiError(FewviewError):
    """The service refused a request, with a reason (RFC 9457).

    Attributes
    ----------
    status
        Of HTTP.
    code
        Stable name of the problem, such as ``invalid_input``.
    title, detail
        The problem, and what is wrong this time.
    errors
        Each field at fault.
    sequence
        The frame of a stream that was refused; None where the stream itself was, and of others.
    """

    def __init__(
        self,
        status: int,
        *,
        code: str,
        title: str,
        detail: str,
        errors: tuple[FieldError, ...] = (),
        sequence: int | None = None,
    ) -> None:
        super().__init__(" ".join(filter(None, (detail or title, _REMEDIES.get(code)))))
        self.status, self.code, self.title, self.detail = status, code, title, detail
        self.errors, self.sequence = errors, sequence


class InvalidRequest(ApiError):  # noqa: N818
    """The request is wrong; ``errors`` name the fields."""


class Unauthorized(ApiError):  # noqa: N818
    """The service asks for a key, or does not take the one that was sent."""


class Forbidden(ApiError):  # noqa: N818
    """The key does not allow this."""


class NotFound(ApiError):  # noqa: N818
    """There is no such resource; it may have been deleted."""


class Conflict(ApiError):  # noqa: N818
    """The resource's state does not allow this."""


class TooManyRequests(ApiError):  # noqa: N818
    """Too many jobs wait; try again later."""


class Unavailable(ApiError):  # noqa: N818
    """The service is overloaded, or a part of it cannot be reached; try again later."""


class ConnectionFailed(FewviewError):  # noqa: N818
    """The service cannot be reached at the client's URL, or did not answer in time."""


class EndedJob(Protocol):
    """What ``Fit`` and ``LiftJob`` have (`fewview.api.forms`), which are not imported here."""

    @property
    def id(self) -> str:
        """What the service calls it."""

    @property
    def status(self) -> str:
        """``failed`` or ``cancelled``."""


class JobFailed(FewviewError):  # noqa: N818
    """A fit or a lift ended without a result.

    Attributes
    ----------
    job
        The ``Fit`` or ``LiftJob``, as the service last answered.
    code
        Why, such as ``unusable_capture``; ``cancelled`` if somebody cancelled it.
    message
        The same in words.
    """

    def __init__(self, job: EndedJob, code: str, message: str) -> None:
        super().__init__(f"{job.id} {job.status} ({code}): {message}")
        self.job, self.code, self.message = job, code, message


class FormatError(FewviewError, ValueError):
    """A file is not what its reader expects, or cannot be written; the message has the remedy.

    Each part has a bounded length, whatever the file holds.

    Attributes
    ----------
    problem
        What is wrong, in words.
    place
        The file, camera or folder where it is; "" if it is none of these.
    option
        The option that is wrong or missing, as Python names it; None if it is the files.
    remedy
        A value of the option that helps, or its form; "" if none is known.
    """

    def __init__(
        self, problem: str, *, place: object = "", option: str | None = None, remedy: str = ""
    ) -> None:
        self.problem, self.place = in_part(problem, LONGEST_PROBLEM), in_part(str(place))
        self.option, self.remedy = option, in_part(remedy)
        super().__init__(self.problem)

    def worded(self, option: str, given: str) -> str:
        """Return the message for people who give options in another way than Python.

        Parameters
        ----------
        option
            What the option is called there; "" to leave it out.
        given
            How the remedy is given there.
        """
        where = self.place or ("" if self.remedy else option)
        what = f"{where}: {self.problem}" if where else self.problem
        return f"{what}; give {given}" if self.remedy else what

    def __str__(self) -> str:
        return self.worded(self.option or "", f"{self.option}={self.remedy!r}")


def in_part(text: str, longest: int = LONGEST_PART) -> str:
    """Return a text of bounded length: where it is longer, its beginning and its end.

    Halves of characters, which files may hold and nothing can print, become question marks.
    """
    if len(text) > longest:
        end = longest // 4
        text = f"{text[: longest - end - 5]} ... {text[-end:]}"
    return text.encode(errors="replace").decode()


_REMEDIES = {  # by codes, which the message ends with
    "unauthorized": "Give a key as FEWVIEW_KEY or Client(key=...); `fewview key create` makes one "
    "where the service runs.",
    "forbidden": "`fewview key create` makes a key with other scopes where the service runs; give "
    "it as FEWVIEW_KEY or Client(key=...).",
}
_BY_STATUS: dict[int, type[ApiError]] = {
    400: InvalidRequest,
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    406: InvalidRequest,
    409: Conflict,
    412: Conflict,
    413: InvalidRequest,
    415: InvalidRequest,
    416: InvalidRequest,
    422: InvalidRequest,
    429: TooManyRequests,
    502: Unavailable,  # of a proxy before the service, as 504
    503: Unavailable,
    504: Unavailable,
}


def api_error(status: int, problem: dict[str, Any]) -> ApiError:
    """Return the error of a response that is not a success.

    Parameters
    ----------
    problem
        The problem details; what is missing of them is made up from the status.
    """
    kind = _BY_STATUS.get(status, ApiError)
    title = str(problem.get("title") or f"HTTP status {status}")
    return kind(
        status,
        code=str(problem.get("code") or ("unauthorized" if status == 401 else "unknown")),
        title=title,
        detail=str(problem.get("detail") or title),
        errors=tuple(
            FieldError(str(item.get("pointer", "")), str(item.get("detail", "")))
            for item in problem.get("errors") or ()
        ),
        sequence=problem.get("sequence"),
    )
