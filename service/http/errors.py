"""Every error as RFC 9457 problem details."""

import logging
from collections.abc import Callable, Sequence
from http import HTTPStatus
from typing import Any

import redis.exceptions
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from obstore.exceptions import BaseError as ObjectStoreError
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy.exc import DatabaseError, InterfaceError, OperationalError, TimeoutError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.http.methods import allow
from store.errors import (
    CaptureError,
    ConfigError,
    ConflictError,
    DamagedError,
    InputError,
    KeyReusedError,
    LiftError,
    NotFoundError,
    QueueFullError,
    QuotaError,
    ShareError,
    SourceError,
    in_words,
)
from store.integrity import RECORDS_DAMAGED, is_corrupt
from store.mistakes import Mistake, mistakes, summary
from store.space import is_full
from worker.logs import request_id

logger = logging.getLogger(__name__)

PROBLEM_JSON = "application/problem+json"

# code: status, title. The codes are part of the API: they are added to, never changed.
PROBLEMS = {
    "malformed_body": (400, "The body cannot be read"),
    "malformed_request": (400, "The request is no HTTP that can be read"),
    "unauthorized": (401, "The request has no key that is in force"),
    "origin_not_allowed": (403, "Web pages of this origin may not do this"),
    "forbidden": (403, "The key does not allow this"),
    "not_found": (404, "There is no such resource"),
    "method_not_allowed": (405, "The method is not allowed here"),
    "not_acceptable": (406, "No such representation"),
    "conflict": (409, "The state of the resource does not allow this"),
    "precondition_failed": (412, "The resource has changed since it was read"),
    "body_too_large": (413, "The body is too large"),
    "unsupported_media_type": (415, "The body's media type is not supported"),
    "idle": (408, "Nothing came for too long"),
    "range_not_satisfiable": (416, "The range lies outside the resource"),
    "invalid_input": (422, "The request is not valid"),
    "upgrade_required": (426, "This is spoken in another protocol"),
    "idempotency_key_reused": (422, "The idempotency key was used for another request"),
    "share_exhausted": (429, "The key or its project has its share of what all have together"),
    "too_many_fits": (429, "Too many fits are waiting"),
    "too_many_lifts": (429, "Too many lifts are waiting"),
    "quota_exceeded": (429, "The key has taken all that it may"),
    "host_not_allowed": (421, "The service has another name"),
    "head_too_large": (431, "The request's head is too large"),
    "internal_error": (500, "Something went wrong inside"),
    "object_damaged": (500, "A stored object is damaged"),
    "records_damaged": (500, "The records are damaged"),
    "overloaded": (503, "Too many requests are in hand"),
    "storage_full": (507, "There is no space left"),
    "unavailable": (503, "A part of the service cannot be reached"),
    "draining": (503, "The service is stopping"),
}

# What can be wrong with a body that carries arrays.
BODY_PROBLEMS = (
    "malformed_body",
    "origin_not_allowed",
    "body_too_large",
    "unsupported_media_type",
    "idle",
    "overloaded",
)


class FieldError(BaseModel):
    """What is wrong with one field."""

    pointer: str = Field(description="JSON pointer (RFC 6901) to the field, or its name.")
    detail: str = Field(description="What was expected, what came, and how to mend it.")


class Problem(BaseModel):
    """RFC 9457 problem details."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "urn:fewview:problem:invalid_input",
                "title": "The request is not valid",
                "status": 422,
                "code": "invalid_input",
                "detail": "keypoints: expected 17 keypoints as in the model, got 16",
                "request_id": "7f9c2ba4e88f827d616045507605853e",
                "errors": [
                    {
                        "pointer": "/keypoints",
                        "detail": "expected 17 keypoints as in the model, got 16",
                    }
                ],
            }
        }
    )

    type: str
    title: str
    status: int
    code: str = Field(description="Stable name of the problem, for programs.")
    detail: str
    request_id: str | None = Field(
        None, description="As in `X-Request-Id`, and in the lines of the log."
    )
    errors: list[FieldError] = []


class _ProblemResponse(Response):
    """A problem, which leaves its code in the request's state for who counts them."""

    code = ""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer."""
        scope.setdefault("state", {})["problem"] = self.code
        await super().__call__(scope, receive, send)


class ApiError(Exception):
    """An error with its problem details.

    Parameters
    ----------
    code
        One of :data:`PROBLEMS`.
    detail
        What happened and how to mend it.
    errors
        ``(pointer, detail)`` of each field at fault.
    headers
        Further response headers.
    """

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        errors: Sequence[tuple[str, str]] = (),
        headers: dict[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.code, self.detail, self.errors, self.headers = code, detail, errors, headers

    def response(self) -> Response:
        """Return the problem as a response."""
        status, title = PROBLEMS[self.code]
        problem = Problem(
            type=f"urn:fewview:problem:{self.code}",
            title=title,
            status=status,
            code=self.code,
            detail=_written(self.detail),
            request_id=request_id.get(),
            errors=[
                FieldError(pointer=_written(pointer), detail=_written(detail))
                for pointer, detail in self.errors
            ],
        )
        headers = dict(self.headers or {})
        if status in (401, 408, 413):  # or the remaining body would be read, to be thrown away
            headers["Connection"] = "close"
        response = _ProblemResponse(problem.model_dump_json(), status, headers, PROBLEM_JSON)
        response.code = self.code
        return response


def _written(text: str) -> str:
    """Return a text without halves of characters, which no answer can hold."""
    return text.encode(errors="replace").decode()


def invalid(pointer: str, detail: str) -> ApiError:
    """Return the error of one field that is not valid."""
    return ApiError(
        "invalid_input", f"{pointer.lstrip('/') or 'body'}: {detail}", errors=[(pointer, detail)]
    )


def from_validation(error: ValidationError, kind: type[BaseModel]) -> ApiError:
    """Return the errors that pydantic found as it was to make a ``kind`` of what came."""
    return of_mistakes(mistakes(error.errors(include_url=False, include_input=False), kind))


def _of_parameters(error: RequestValidationError) -> ApiError:
    # Where a parameter was, in the query, the path or a header, comes first in its place.
    return of_mistakes(mistakes([{**item, "loc": item["loc"][1:]} for item in error.errors()]))


def of_mistakes(found: list[Mistake]) -> ApiError:
    """Return the error of what is wrong with a request, field by field."""
    return ApiError("invalid_input", summary(found), errors=found)


def problems(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of an operation that can end in these problems.

    All can end in ``unauthorized``, ``forbidden``, ``quota_exceeded``,
    ``invalid_input`` (of a parameter at least), ``host_not_allowed``,
    ``head_too_large``, ``internal_error``, ``object_damaged``, ``records_damaged``,
    ``storage_full``, ``unavailable``, ``overloaded``, ``share_exhausted``.
    """
    described: dict[int | str, dict[str, Any]] = {}
    of_all = (
        "unauthorized",
        "forbidden",
        "quota_exceeded",
        "invalid_input",
        "host_not_allowed",
        "head_too_large",
        "internal_error",
        "object_damaged",
        "records_damaged",
        "storage_full",
        "unavailable",
        "overloaded",
        "share_exhausted",
    )
    for code in dict.fromkeys((*codes, *of_all)):
        status, title = PROBLEMS[code]
        entry = described.setdefault(
            status,
            {
                "description": title,
                "content": {PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}},
            },
        )
        if title not in entry["description"]:
            entry["description"] += f"; {title[0].lower()}{title[1:]}"
    return described


def translated(error: Exception) -> ApiError:
    """Return the problem that an error becomes, wherever it was raised."""
    kind = next(kind for kind in type(error).__mro__ if kind in TRANSLATIONS)
    return TRANSLATIONS[kind](error)


def install(app: FastAPI) -> None:
    """Have every error of ``app`` leave as problem details."""
    for kind, to_api_error in TRANSLATIONS.items():
        app.add_exception_handler(kind, _handler(to_api_error))


def _handler(to_api_error: Callable[[Any], ApiError]) -> Callable[[Request, Any], Any]:
    async def handle(request: Request, error: Any) -> Response:
        if isinstance(error, HTTPException):
            error = _with_methods(request, _with_place(request, error))
        return to_api_error(error).response()

    return handle


def _with_place(request: Request, error: HTTPException) -> HTTPException:
    """Return Starlette's own error, which has only a status, with the method and path."""
    if error.detail != HTTPStatus(error.status_code).phrase:
        return error
    detail = f"{error.detail}: {request.method} {request.url.path}"
    return HTTPException(error.status_code, detail, error.headers)


def _with_methods(request: Request, error: HTTPException) -> HTTPException:
    """Return Starlette's own error of a wrong method with all methods that are right."""
    if error.status_code != HTTPStatus.METHOD_NOT_ALLOWED:
        return error
    return HTTPException(error.status_code, error.detail, {"Allow": allow(request)})


def _of_http(error: HTTPException) -> ApiError:
    # Of several codes of a status, the first is what is raised in this form.
    codes = {status: code for code, (status, _) in reversed(PROBLEMS.items())}
    code = codes.get(error.status_code, "malformed_body")
    return ApiError(code, str(error.detail), headers=dict(error.headers or {}))


def _of_full_queue(error: QueueFullError) -> ApiError:
    return ApiError(
        f"too_many_{error.kind}s",
        f"{error} Try again when some have run.",
        headers={"Retry-After": "60"},
    )


def _of_excess(code: str) -> Callable[[Exception], ApiError]:
    return lambda error: ApiError(code, str(error), headers={"Retry-After": "60"})


def _of_outage(part: str) -> Callable[[Exception], ApiError]:
    def to_api_error(error: Exception) -> ApiError:
        if is_full(error):
            return _of_full_disk(error)
        logger.error("Unavailable: %s", error)
        return ApiError(
            "unavailable",
            f"The {part} cannot be reached at the moment; try again shortly.",
            headers={"Retry-After": "2"},
        )

    return to_api_error


def _of_full_disk(error: Exception) -> ApiError:
    logger.error("There is no space left: %s", in_words(error))
    return ApiError(
        "storage_full",
        "There is no space left to store this, and nothing of it was stored. Delete what is not "
        "needed, or have whoever runs the service make space.",
    )


def _of_files(error: OSError) -> ApiError:
    if is_full(error):
        return _of_full_disk(error)
    logger.error("A fault, or a file that cannot be used", exc_info=error)
    return of_bug(error)


def _of_database(error: DatabaseError) -> ApiError:
    if not is_corrupt(error):
        logger.error("A fault in what the records were asked", exc_info=error)
        return of_bug(error)
    logger.error("The records are damaged: %s", in_words(error))
    return ApiError("records_damaged", RECORDS_DAMAGED)


def _of_damage(error: DamagedError) -> ApiError:
    logger.error("%s", error)
    return ApiError("object_damaged", str(error))


def of_bug(_error: Exception) -> ApiError:
    """Return the error for an unforeseen exception, without any details of it."""
    return ApiError(
        "internal_error",
        "This is a fault in Fewview; its log has the details.",
        headers={"Connection": "close"},  # as the server does after an exception
    )


def _of_input(error: InputError) -> ApiError:
    return invalid(f"/{error.field}", str(error))


# What leaves the endpoints, and the problem that it becomes.
TRANSLATIONS: dict[type[Exception], Callable[[Any], ApiError]] = {
    ApiError: lambda error: error,
    RequestValidationError: _of_parameters,
    NotFoundError: lambda error: ApiError("not_found", str(error)),
    ConflictError: lambda error: ApiError("conflict", str(error)),
    DamagedError: _of_damage,
    CaptureError: _of_input,
    LiftError: _of_input,
    SourceError: _of_input,
    InputError: _of_input,
    ConfigError: lambda error: invalid(f"/config/{error.field}", str(error)),
    KeyReusedError: lambda error: ApiError("idempotency_key_reused", str(error)),
    QueueFullError: _of_full_queue,
    QuotaError: _of_excess("quota_exceeded"),
    ShareError: _of_excess("share_exhausted"),
    HTTPException: _of_http,
    DatabaseError: _of_database,
    OperationalError: _of_outage("records"),
    InterfaceError: _of_outage("records"),  # a connection that was lost
    TimeoutError: _of_outage("records"),  # all connections are in use
    ObjectStoreError: _of_outage("objects"),
    redis.exceptions.RedisError: _of_outage("queue"),
    OSError: _of_files,
    Exception: of_bug,
}


def problem_schemas() -> dict[str, Any]:
    """Return the schemas of problem details, by name, for the OpenAPI document."""
    template = "#/components/schemas/{model}"
    schema = Problem.model_json_schema(ref_template=template)
    return {**schema.pop("$defs"), "Problem": schema}
