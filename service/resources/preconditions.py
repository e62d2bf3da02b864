"""``If-Match`` (RFC 9110, 13.1.1): a record that has changed since it was read is left as it is.

``PATCH`` compares in the transaction that changes. What deletes, appends, cancels or points an
alias elsewhere compares before it begins: what changes a record between the two is not noticed.
``If-Unmodified-Since`` is ignored (13.1.4), as no answer has a ``Last-Modified``.
"""

import hashlib
from collections.abc import Callable
from typing import Any

import orjson
from sqlalchemy import inspect
from starlette.concurrency import run_in_threadpool
from starlette.requests import HTTPConnection

from service.http.dependencies import get_store
from service.http.errors import ApiError
from store import lookup
from store.errors import NotFoundError
from store.records import DatasetRecord, FitRecord, Job, LiftRecord, ModelRecord

HEADER = "if-match"
# What has an `ETag`, by its parameter of a path.
KINDS: dict[str, Any] = {
    f"{kind.noun}_id": kind for kind in (DatasetRecord, FitRecord, LiftRecord, ModelRecord)
}
COMPARED_HERE = ("POST", "PUT", "DELETE")


def etag_of(record: Any) -> str:
    """Return the strong entity tag (RFC 9110, 8.8.3) of what is stored of a record."""
    if isinstance(record, Job):
        return f'"{record.revision}"'
    written = [each.key for each in inspect(type(record)).columns if each.computed is None]
    columns = {name: getattr(record, name) for name in written}
    return f'"{hashlib.sha256(orjson.dumps(columns)).hexdigest()[:32]}"'


def unchanged_since(if_match: str | None) -> Callable[[Any], None]:
    """Return what raises ``ApiError`` (412) for a record with none of these tags (13.1.1)."""

    def check(record: Any) -> None:
        tags = [tag.strip() for tag in (if_match or "*").split(",")]
        if "*" not in tags and etag_of(record) not in tags:
            raise ApiError(
                "precondition_failed",
                f"This {record.noun} has changed since you read it: expected If-Match "
                f"{etag_of(record)}; read it again, and change that.",
            )

    return check


async def refuse_if_changed(connection: HTTPConnection) -> None:
    """Raise ``ApiError`` (412) for a change of a record that has none of the tags given."""
    if_match = connection.headers.get(HEADER)
    if if_match is None or connection.scope.get("method") not in COMPARED_HERE:
        return
    for name in KINDS.keys() & connection.path_params.keys():
        store = await get_store(connection)
        identifier = connection.path_params[name]
        try:
            record = await run_in_threadpool(lookup.get, store, KINDS[name], identifier)
        except NotFoundError as error:
            if connection.scope["method"] != "PUT":
                return  # the operation itself answers that
            raise ApiError("precondition_failed", f"{error} So it has no ETag.") from error
        unchanged_since(if_match)(record)


def describe_preconditions(paths: dict[str, Any]) -> None:
    """Add the header and its answer to the OpenAPI document, as `PATCH` has them."""
    of_patch = paths["/fits/{fit_id}"]["patch"]
    header = next(each for each in of_patch["parameters"] if each["name"] == HEADER)
    for path, operations in paths.items():
        if not any(f"{{{name}}}" in path for name in KINDS):
            continue
        for method, operation in operations.items():
            if method.upper() in COMPARED_HERE:
                operation["parameters"].append(header)
                operation["responses"]["412"] = of_patch["responses"]["412"]
