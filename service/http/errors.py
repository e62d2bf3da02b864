"""Every error as RFC 9457 problem details."""

import logging
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

import redis.exceptions
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from obstore.exceptions import BaseError as ObjectStoreError
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from store.errors import (
    CaptureError,
    ConfigError,
    ConflictError,
    InputError,
    KeyReusedError,
    LiftError,
    NotFoundError,
    QueueFullError,
    SourceError,
)

logger = logging.getLogger(__name__)

PROBLEM_JSON = "application/problem+json"

# code: status, title. The codes are part of the API: they are added to, never changed.
PROBLEMS = {
    "malformed_body": (400, "The body cannot be read"),
    "not_found": (404, "There is no such resource"),
    "method_not_allowed": (405, "The method is not allowed here"),
    "not_acceptable": (406, "No such representation"),
    "conflict": (409, "The state of the resource does not allow this"),
    "body_too_large": (413, "The body is too large"),
    "unsupported_media_type": (415, "The body's media type is not supported"),
    "idle": (408, "Nothing came for too long"),
    "range_not_satisfiable": (416, "The range lies outside the resource"),
    "invalid_input": (422, "The request is not valid"),
    "upgrade_required": (426, "This is spoken in another protocol"),
    "idempotency_key_reused": (422, "The idempotency key was used for another request"),
    "too_many_fits": (429, "Too many fits are waiting"),
    "too_many_lifts": (429, "Too many lifts are waiting"),
    "internal_error": (500, "Something went wrong inside"),
    "overloaded": (503, "Too many requests are in hand"),
    "unavailable": (503, "A part of the service cannot be reached"),
}

# What can be wrong with a body that carries arrays.
BODY_PROBLEMS = ("malformed_body", "body_too_large", "unsupported_media_type", "overloaded")


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
    errors: list[FieldError] = []


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
            detail=self.detail,
            errors=[FieldError(pointer=pointer, detail=detail) for pointer, detail in self.errors],
        )
        headers = dict(self.headers or {})
        if status == 413:  # or the server would read the rest of the body, to throw it away
            headers["Connection"] = "close"
        return Response(problem.model_dump_json(), status, headers, PROBLEM_JSON)


def invalid(pointer: str, detail: str) -> ApiError:
    """Return the error of one field that is not valid."""
    return ApiError(
        "invalid_input", f"{pointer.lstrip('/') or 'body'}: {detail}", errors=[(pointer, detail)]
    )


def from_validation(error: ValidationError | RequestValidationError) -> ApiError:
    """Return the errors that pydantic found, each with a pointer to its field."""
    found = []
    for item in error.errors():
        place = [str(part).replace("~", "~0").replace("/", "~1") for part in item["loc"]]
        if isinstance(error, RequestValidationError):  # query, path or header comes first
            place = place[1:]
        message = item["msg"].removeprefix("Value error, ")
        found.append(("/" + "/".join(place) if place else "", message))
    summary = "; ".join(f"{pointer.lstrip('/') or 'body'}: {text}" for pointer, text in found[:5])
    return ApiError("invalid_input", summary, errors=found[:50])


def problems(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of an operation that can end in these problems.

    All can end in ``invalid_input`` (of a parameter at least), ``internal_error``, ``unavailable``;
    those that read a body in ``overloaded``.
    """
    described: dict[int | str, dict[str, Any]] = {}
    for code in dict.fromkeys((*codes, "invalid_input", "internal_error", "unavailable")):
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


def install(app: FastAPI) -> None:
    """Have every error of ``app`` leave as problem details."""

    @app.exception_handler(ApiError)
    async def on_api_error(_request: Request, error: ApiError) -> Response:
        return error.response()

    @app.exception_handler(RequestValidationError)
    async def on_validation_error(_request: Request, error: RequestValidationError) -> Response:
        return from_validation(error).response()

    @app.exception_handler(NotFoundError)
    async def on_not_found(_request: Request, error: NotFoundError) -> Response:
        return ApiError("not_found", str(error)).response()

    @app.exception_handler(ConflictError)
    async def on_conflict(_request: Request, error: ConflictError) -> Response:
        return ApiError("conflict", str(error)).response()

    @app.exception_handler(CaptureError)
    @app.exception_handler(LiftError)
    @app.exception_handler(SourceError)
    async def on_input_error(_request: Request, error: InputError) -> Response:
        return invalid(f"/{error.field}", str(error)).response()

    @app.exception_handler(ConfigError)
    async def on_config_error(_request: Request, error: ConfigError) -> Response:
        return invalid(f"/config/{error.field}", str(error)).response()

    @app.exception_handler(KeyReusedError)
    async def on_key_reused(_request: Request, error: KeyReusedError) -> Response:
        return ApiError("idempotency_key_reused", str(error)).response()

    @app.exception_handler(QueueFullError)
    async def on_queue_full(_request: Request, error: QueueFullError) -> Response:
        return ApiError(
            f"too_many_{error.kind}s",
            f"{error} Try again when some have run.",
            headers={"Retry-After": "60"},
        ).response()

    @app.exception_handler(HTTPException)
    async def on_http_error(request: Request, error: HTTPException) -> Response:
        detail = str(error.detail)
        if detail == HTTPStatus(error.status_code).phrase:  # Starlette's own say no more
            detail = f"{detail}: {request.method} {request.url.path}"
        # Of several codes of a status, the first is what is raised in this form.
        codes = {status: code for code, (status, _) in reversed(PROBLEMS.items())}
        code = codes.get(error.status_code, "malformed_body")
        return ApiError(code, detail, headers=dict(error.headers or {})).response()

    @app.exception_handler(OperationalError)
    @app.exception_handler(ObjectStoreError)
    @app.exception_handler(redis.exceptions.RedisError)
    async def on_outage(_request: Request, error: Exception) -> Response:
        logger.error("Unavailable: %s", error)
        part = "objects"
        if isinstance(error, redis.exceptions.RedisError):
            part = "queue"
        elif isinstance(error, OperationalError):
            part = "records"
        return ApiError(
            "unavailable",
            f"The {part} cannot be reached at the moment; try again shortly.",
            headers={"Retry-After": "2"},
        ).response()

    @app.exception_handler(Exception)
    async def on_bug(_request: Request, _error: Exception) -> Response:
        return ApiError(
            "internal_error",
            "This is a fault in Fewview; its log says more.",
            headers={"Connection": "close"},  # as the server does after an exception
        ).response()


def problem_schemas() -> dict[str, Any]:
    """Return the schemas of problem details, by name, for the OpenAPI document."""
    template = "#/components/schemas/{model}"
    schema = Problem.model_json_schema(ref_template=template)
    return {**schema.pop("$defs"), "Problem": schema}
