"""Responses that carry arrays: JSON, safetensors or npz, whole or a range of them."""

import hashlib
import re
from typing import Annotated, Any, Literal

import orjson
from fastapi import Query, Request
from numpy.typing import NDArray
from starlette.responses import Response

from service import arrays
from service.errors import ApiError
from service.wire import frames_json

Format = Literal["json", "safetensors", "npz"]
FormatQuery = Annotated[
    Format | None,
    Query(description="Representation; without it the `Accept` header decides."),
]

_JSON = "application/json"
_SAFETENSORS = "application/vnd.safetensors"
_NPZ = "application/x-npz"
_FORMATS: dict[str, Format] = {
    "*/*": "json",
    "application/*": "json",
    _JSON: "json",
    "application/octet-stream": "safetensors",
    _SAFETENSORS: "safetensors",
    _NPZ: "npz",
    "application/zip": "npz",
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


def accepted_format(request: Request, asked: Format | None) -> Format:
    """Return what the client wants: the query's word, or the first known type it accepts.

    Raises
    ------
    ApiError
        406 if it accepts nothing that there is.
    """
    if asked is not None:
        return asked
    accept = request.headers.get("accept") or "*/*"
    ranked = []
    for position, item in enumerate(accept.split(",")):
        media_type, *parameters = (part.strip() for part in item.split(";"))
        quality = next((p[2:] for p in parameters if p.startswith("q=")), "1")
        try:
            ranked.append((-float(quality), position, media_type.lower()))
        except ValueError:
            continue
    for weight, _, media_type in sorted(ranked):
        if weight < 0 and media_type in _FORMATS:
            return _FORMATS[media_type]
    raise ApiError(
        "not_acceptable",
        f"expected Accept to hold application/json, application/octet-stream (safetensors) or "
        f"{_NPZ}, got {accept[:200]!r}",
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
    chosen = accepted_format(request, format)
    if chosen == "json":
        body = orjson.dumps({**about, "frames": frames_json(found)})
        return bytes_response(request, body, media_type=_JSON, filename=None)
    if chosen == "npz":
        return bytes_response(
            request, arrays.to_npz(found), media_type=_NPZ, filename=f"{filename}.npz"
        )
    metadata = {name: value for name, value in about.items() if value is not None}
    return bytes_response(
        request,
        arrays.to_safetensors(found, metadata),
        media_type="application/octet-stream",
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
    headers = {"Vary": "Accept"}
    if filename is not None:
        headers["Content-Disposition"] = f'attachment; filename="{filename}"'
    if request.method != "GET":
        return Response(body, media_type=media_type, headers=headers)
    etag = f'"{checksum or hashlib.sha256(body).hexdigest()}"'
    headers |= {"ETag": etag, "Accept-Ranges": "bytes"}
    matches = [
        tag.strip().removeprefix("W/")
        for tag in request.headers.get("if-none-match", "").split(",")
    ]
    if etag in matches or "*" in matches:
        return Response(status_code=304, headers=headers)
    wanted = request.headers.get("range")
    if wanted is None or request.headers.get("if-range", etag) != etag:
        return Response(body, media_type=media_type, headers=headers)
    span = _parse_range(wanted, len(body))
    if span is None:
        return Response(body, media_type=media_type, headers=headers)
    start, end = span
    headers["Content-Range"] = f"bytes {start}-{end - 1}/{len(body)}"
    return Response(body[start:end], status_code=206, media_type=media_type, headers=headers)


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
