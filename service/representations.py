"""Responses that carry arrays: JSON, safetensors or npz, whole or a range of them."""

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal, TypeVar

import orjson
from fastapi import Query, Request
from numpy.typing import NDArray
from starlette.responses import Response, StreamingResponse

from service import arrays
from service.errors import ApiError
from service.wire import frames_json

Format = Literal["json", "safetensors", "npz"]
AnyFormat = TypeVar("AnyFormat", bound=str)
FormatQuery = Annotated[
    Format | None,
    Query(description="Representation; without it the `Accept` header decides."),
]

OCTETS = "application/octet-stream"
NPZ = "application/x-npz"
BINARY_FORMATS: dict[str, Literal["safetensors", "npz"]] = {
    OCTETS: "safetensors",
    "application/vnd.safetensors": "safetensors",
    NPZ: "npz",
    "application/zip": "npz",
}
_JSON = "application/json"
_FORMATS: dict[str, Format] = {
    "*/*": "json",
    "application/*": "json",
    _JSON: "json",
    **BINARY_FORMATS,
}


def binary_responses(description: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI response of an operation that also answers with an array file."""
    return {
        200: {
            "description": description,
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        }
    }


def accepted_format(
    request: Request, asked: AnyFormat | None, formats: Mapping[str, AnyFormat]
) -> AnyFormat:
    """Return what the client wants: the query's word, or the first known type it accepts.

    Parameters
    ----------
    formats
        What a client may accept, by media type.

    Raises
    ------
    ApiError
        406 if it accepts nothing that there is.
    """
    if asked is not None:
        return asked
    accept = request.headers.get("accept") or "*/*"
    if accept in formats:
        return formats[accept]
    ranked = []
    for position, item in enumerate(accept.split(",")):
        media_type, *parameters = (part.strip() for part in item.split(";"))
        quality = next((p[2:] for p in parameters if p.startswith("q=")), "1")
        try:
            ranked.append((-float(quality), position, media_type.lower()))
        except ValueError:
            continue
    for weight, _, media_type in sorted(ranked):
        if weight < 0 and media_type in formats:
            return formats[media_type]
    raise ApiError(
        "not_acceptable",
        f"expected Accept to hold {next(t for t in formats if '*' not in t)}, "
        f"{OCTETS} (safetensors) or {NPZ}, got {accept[:200]!r}",
    )


def arrays_response(
    request: Request,
    found: dict[str, NDArray[Any]],
    about: dict[str, str | None],
    *,
    format: Format | None,
    filename: str,
) -> Response:
    """Answer with a lift's arrays in the format the client accepts.

    ``about`` goes into the JSON object beside ``frames``, or into the safetensors metadata.
    """
    chosen = accepted_format(request, format, _FORMATS)
    if chosen == "json":
        body = orjson.dumps({**about, "frames": frames_json(found)})
        return bytes_response(request, body, media_type=_JSON, filename=None)
    if chosen == "npz":
        return bytes_response(
            request, arrays.to_npz(found), media_type=NPZ, filename=f"{filename}.npz"
        )
    metadata = {name: value for name, value in about.items() if value is not None}
    return bytes_response(
        request,
        arrays.to_safetensors(found, metadata),
        media_type=OCTETS,
        filename=f"{filename}.safetensors",
    )


def bytes_response(
    request: Request,
    body: bytes,
    *,
    media_type: str,
    filename: str | None,
    checksum: str | None = None,
) -> Response:
    """Answer with bytes, honouring ``If-None-Match``, ``Range`` and ``If-Range`` (RFC 9110).

    Only a GET has these; other answers go out as they are.
    """
    if request.method != "GET":
        return Response(body, media_type=media_type, headers=_headers(filename))
    return ranged_response(
        request,
        len(body),
        lambda start, end: body[start:end],
        media_type=media_type,
        filename=filename,
        checksum=checksum or hashlib.sha256(body).hexdigest(),
    )


def ranged_response(
    request: Request,
    size: int,
    read: Callable[[int, int], bytes | Iterator[bytes]],
    *,
    media_type: str,
    filename: str | None,
    checksum: str,
) -> Response:
    """Answer a GET with a file of ``size`` bytes, or with the range of it that is asked for.

    Parameters
    ----------
    read
        Gives the bytes from a start up to an end, whole or in pieces to be streamed.
    checksum
        Of the file as it is in this format: its entity tag.
    """
    headers, etag = _headers(filename), f'"{checksum}"'
    headers |= {"ETag": etag, "Accept-Ranges": "bytes"}
    matches = [
        tag.strip().removeprefix("W/")
        for tag in request.headers.get("if-none-match", "").split(",")
    ]
    if etag in matches or "*" in matches:
        return Response(status_code=304, headers=headers)
    wanted = request.headers.get("range")
    span = None
    if wanted is not None and request.headers.get("if-range", etag) == etag:
        span = _parse_range(wanted, size)
    start, end = span or (0, size)
    if span is not None:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    status_code = 200 if span is None else 206
    body = read(start, end)
    if isinstance(body, bytes):
        return Response(body, status_code, headers, media_type)
    headers["Content-Length"] = str(end - start)
    return StreamingResponse(body, status_code, headers, media_type)


def _headers(filename: str | None) -> dict[str, str]:
    headers = {"Vary": "Accept"}
    if filename is not None:
        headers["Content-Disposition"] = f'attachment; filename="{filename}"'
    return headers


def _parse_range(header: str, size: int) -> tuple[int, int] | None:
    """Return start and end of the one range asked for; None for what may be ignored.

    Raises
    ------
    ApiError
        416 for a range beyond the end.
    """
    one_range = re.fullmatch(r"bytes=\s*([0-9]{0,18})-([0-9]{0,18})\s*", header)
    first, last = one_range.groups() if one_range else ("", "")
    if first == last == "":
        return None  # several ranges, another unit, or no range at all
    if first == "":
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
    if start >= size or start >= end:
        raise ApiError(
            "range_not_satisfiable",
            f"expected a range within {size} bytes, got {header!r}",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, end
