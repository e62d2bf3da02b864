"""What depends on whether a client has something as it is.

``If-None-Match`` (RFC 9110, 13.1.2): what a client has is not sent again. ``If-Match`` (13.1.1): a
record that has changed since it was read is left as it is.

The latter is compared in the transaction that changes the record, once that is locked
(`store.expectations`). ``If-Unmodified-Since`` is ignored (13.1.4), as no answer has a
``Last-Modified``.
"""

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import orjson
from sqlalchemy import inspect
from starlette.requests import HTTPConnection
from starlette.responses import Response

from service.http.errors import ApiError, invalid, problems
from store.expectations import Expected
from store.records import DatasetRecord, FitRecord, Job, LiftRecord, ModelRecord

T = TypeVar("T")

HEADER = "if-match"
LONGEST = 1000  # characters
# What has an `ETag`, by its parameter of a path.
KINDS: dict[str, Any] = {
    f"{kind.noun}_id": kind for kind in (DatasetRecord, FitRecord, LiftRecord, ModelRecord)
}
METHODS = ("POST", "PUT", "PATCH", "DELETE")


def etag_of(record: Any) -> str:
    """Return the strong entity tag (RFC 9110, 8.8.3) of what is stored of a record."""
    if isinstance(record, Job):
        return f'"{record.revision}"'
    # What is not read with the record is computed, or has a checksum beside it.
    written = [each.key for each in inspect(type(record)).column_attrs if not each.deferred]
    columns = {name: getattr(record, name) for name in written}
    return f'"{hashlib.sha256(orjson.dumps(columns)).hexdigest()[:32]}"'


def is_known(request: HTTPConnection, etag: str) -> bool:
    """Return whether the client already has this representation."""
    matches = [
        tag.strip().removeprefix("W/")
        for tag in request.headers.get("if-none-match", "").split(",")
    ]
    return etag in matches or "*" in matches


def tagged(request: HTTPConnection, response: Response, record: T, form: Callable[[T], Any]) -> Any:
    """Return the form of a record and set its `ETag`; or 304 for a client that has it as it is."""
    etag = etag_of(record)
    if is_known(request, etag):
        return Response(status_code=304, headers={"ETag": etag})
    response.headers["ETag"] = etag
    return form(record)


def expected_by(connection: HTTPConnection) -> Expected | None:
    """Return which record a request expects to be as it was read, if it has ``If-Match``.

    Raises
    ------
    ApiError
        422 for a header of more than `LONGEST` characters.
    """
    if_match = connection.headers.get(HEADER)
    if if_match is None or connection.scope.get("method") not in METHODS:
        return None
    if len(if_match) > LONGEST:
        raise invalid(f"/{HEADER}", f"expected {LONGEST} characters at most, got {len(if_match)}")
    tags = frozenset(tag.strip() for tag in if_match.split(","))
    for name in KINDS.keys() & connection.path_params.keys():
        return Expected(KINDS[name], connection.path_params[name], partial(_refuse_others, tags))
    return None


def _refuse_others(tags: frozenset[str], record: Any) -> None:
    """Raise ``ApiError`` (412) for a record with none of these tags, or for none (13.1.1)."""
    if record is None:
        raise ApiError("precondition_failed", "There is nothing of this name, so it has no ETag.")
    if "*" not in tags and etag_of(record) not in tags:
        raise ApiError(
            "precondition_failed",
            f"This {record.noun} has changed since you read it: expected If-Match "
            f"{etag_of(record)}; read it again, and change that.",
        )


def describe_preconditions(paths: dict[str, Any]) -> None:
    """Add the header and its answer, 412, to operations of the OpenAPI document that change."""
    words = (
        "The `ETag` of the resource as you read it: if it has changed since, nothing is changed "
        "(412)."
    )
    text = {"anyOf": [{"type": "string", "maxLength": LONGEST}, {"type": "null"}]}
    header = {
        "name": HEADER,
        "in": "header",
        "required": False,
        "schema": text | {"description": words, "title": "If-Match"},
        "description": words,
    }
    for path, operations in paths.items():
        if not any(f"{{{name}}}" in path for name in KINDS):
            continue
        for method, operation in operations.items():
            if method.upper() in METHODS:
                operation["parameters"].append(header)
                operation["responses"]["412"] = problems("precondition_failed")[412]
