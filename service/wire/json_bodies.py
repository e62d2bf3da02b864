"""Reading JSON bodies: small ones here, large ones in a process of their own.

To parse JSON and to make arrays of its lists keeps all other threads of a process waiting, and
takes many times the memory of the text. What comes back of a large body are its arrays, and of
everything else what was valid, which is little.
"""

from functools import partial
from typing import Any, TypeVar

import orjson
from pydantic import BaseModel, ValidationError

from service.http.errors import ApiError, from_validation
from service.http.json_bounds import check_bounds
from service.http.uploads import Upload
from service.wire.arrays import Arrays, Unlisted
from service.wire.captures import Converted, convert
from service.wire.json_kinds import refuse_converted
from service.wire.sandbox import EndedError, Limits, shared
from service.wire.slices import read_in_slices

Body = TypeVar("Body", bound=BaseModel)

# What JSON takes as lists of numbers: of each list or object, and of each of its items.
LIST_BYTES, ITEM_BYTES = 88, 32
TIMES_DECODED = 2  # that a process may take of the bytes of all lists: numbers are listed twice
RETRY_SECONDS = "5"
IN_PARTS = "Send safetensors or npz (application/octet-stream), or the frames in parts."


def read_json(upload: Upload, kind: type[Body]) -> Body:
    """Return a JSON body as a ``kind``; its fields that are lists of numbers may be arrays.

    Those come as `captures.to_array` takes them.

    Raises
    ------
    ApiError
        415 if it is no JSON, 400 if it is broken, 413 if it takes too much, 422 if it is not valid.
    """
    if not upload.is_json:
        raise ApiError("unsupported_media_type", "expected Content-Type application/json")
    if upload.is_large:
        return kind.model_validate(_read_apart(upload, kind))
    return _understood(upload.data, kind, upload.max_decoded_bytes)[1]


def _understood(
    data: bytes | bytearray, kind: type[Body], max_decoded_bytes: int
) -> tuple[dict[str, Any], Body]:
    """Return what a body holds, as plain data and as a ``kind``."""
    _refuse_costly(data, max_decoded_bytes)
    try:
        body = orjson.loads(data)
    except orjson.JSONDecodeError as error:
        raise ApiError(
            "malformed_body",
            f"The body is not valid JSON: {error}. JSON knows no NaN or Infinity: write null "
            "for what was not observed.",
        ) from error
    return body, _checked(body, kind)


def _checked(body: Any, kind: type[Body]) -> Body:
    check_bounds(body, kind)
    try:
        made = kind.model_validate(body)
    except ValidationError as error:
        raise from_validation(error, kind) from error
    refuse_converted(body, made)
    return made


def _refuse_costly(data: bytes | bytearray, most: int) -> None:
    """Refuse JSON that would take many times the memory that a capture of its length takes."""
    if (LIST_BYTES + ITEM_BYTES) * len(data) <= most:
        return
    count = data.count
    cost = LIST_BYTES * (count(b"[") + count(b"{")) + ITEM_BYTES * count(b",")
    if cost > most:
        raise ApiError(
            "body_too_large",
            f"JSON may take some {most} bytes as lists of numbers at most, this would take "
            f"{cost}. {IN_PARTS}",
        )


def _read_apart(upload: Upload, kind: type[BaseModel]) -> dict[str, Any]:
    asked = {
        "module": kind.__module__,
        "kind": kind.__name__,
        "max_decoded_bytes": upload.max_decoded_bytes,
        "max_array_bytes": upload.max_array_bytes,
    }
    try:
        most = TIMES_DECODED * upload.max_decoded_bytes
        answer, arrays = shared.work(
            [__name__, kind.__module__], asked, upload.data, limits=Limits(most, most)
        )
    except EndedError as error:
        raise ApiError(
            "overloaded",
            "Reading the body ended without an answer, as if there were not memory enough: try "
            f"again in {RETRY_SECONDS} s. {IN_PARTS}",
            headers={"Retry-After": RETRY_SECONDS},
        ) from error
    if "problem" in answer:
        raise _problem(answer["problem"])
    refused = {name: _problem(problem) for name, problem in answer["refused"].items()}
    unlisted = {name: Unlisted(*sizes) for name, sizes in answer["unlisted"].items()}
    others: dict[str, Any] = answer["others"]
    return others | arrays | refused | unlisted


def work(asked: dict[str, Any], data: bytearray) -> tuple[dict[str, Any], Arrays]:
    """Read a body in a separate process: its arrays, and all other valid fields as JSON.

    Otherwise return the error, of the body as a whole (``problem``) or of an array (``refused``),
    which the caller may ignore.
    """
    module = __import__(asked["module"], fromlist=[asked["kind"]])
    kind: type[BaseModel] = getattr(module, asked["kind"])
    try:
        others, found = _parted(data, kind, asked["max_decoded_bytes"], asked["max_array_bytes"])
    except ApiError as error:
        return {"problem": _plain(error)}, {}
    except MemoryError:
        detail = f"JSON of so many numbers takes more memory than there is. {IN_PARTS}"
        return {"problem": _plain(ApiError("body_too_large", detail))}, {}
    arrays, refused, unlisted = {}, {}, {}
    for name, value in found.items():
        if isinstance(value, ApiError):
            refused[name] = _plain(value)
        elif isinstance(value, Unlisted):
            unlisted[name] = value
        else:
            arrays[name] = value
    return {"others": others, "refused": refused, "unlisted": unlisted}, arrays


def _parted(
    data: bytearray, kind: type[BaseModel], max_decoded_bytes: int, max_array_bytes: int
) -> tuple[dict[str, Any], Converted]:
    """Return the fields of a valid body that are no arrays, and what the others make."""
    names = [name for name, field in kind.model_fields.items() if field.annotation is Any]
    costly = partial(_refuse_costly, most=max_decoded_bytes)
    found: Converted
    if names and (sliced := read_in_slices(data, names, costly, max_array_bytes)):
        body, found = sliced.body, {**sliced.arrays}
        _checked(body, kind)
    else:
        body, _ = _understood(data, kind, max_decoded_bytes)
        lists = {name: body[name] for name in names if body.get(name) is not None}
        found = convert(lists, max_array_bytes)
    fields = [name for name in kind.model_fields if name in body]
    others = {name: body[name] for name in fields if name not in names or body[name] is None}
    return others, found


def _plain(error: ApiError) -> dict[str, Any]:
    return {"code": error.code, "detail": error.detail, "errors": list(error.errors)}


def _problem(plain: dict[str, Any]) -> ApiError:
    errors = [(pointer, detail) for pointer, detail in plain["errors"]]
    return ApiError(plain["code"], plain["detail"], errors=errors)
