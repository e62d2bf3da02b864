"""Answers that carry a lift's arrays: as JSON, safetensors or npz."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Literal

import orjson
from fastapi import Query, Request
from starlette.responses import Response
from typing_extensions import TypeAliasType

from models.findings.finding import Finding, dumped
from models.lifting.frames_json import frames_to_json
from service.http.downloads import bytes_response
from service.http.negotiation import BINARY_FORMATS, NPZ, OCTETS, accepted_format
from service.wire.arrays import Arrays, to_npz, to_safetensors

Format = TypeAliasType("Format", Literal["json", "safetensors", "npz"])
FormatQuery = Annotated[
    Format | None,
    Query(description="Representation; without it the `Accept` header decides."),
]

JSON = "application/json"
PART_BYTES = 512 * 1024  # of arrays that are written as JSON at a time
_FORMATS: dict[str, Format] = {
    "*/*": "json",
    "application/*": "json",
    JSON: "json",
    **BINARY_FORMATS,
}


def chosen_format(request: Request, asked: Format | None) -> Format:
    """Return the format that a client gets a lift's arrays in; raise ``ApiError`` 406 if none."""
    return accepted_format(request, asked, _FORMATS)


def arrays_response(
    request: Request,
    found: Arrays,
    about: dict[str, str | None],
    findings: Sequence[Finding],
    *,
    format: Format | None,
    filename: str,
) -> Response:
    """Answer with a lift's arrays in the format the client accepts.

    ``about`` and ``findings`` go into the JSON object beside ``frames``, or into the safetensors
    metadata, the findings as JSON.
    """
    chosen = chosen_format(request, format)
    if chosen == "json":
        body = b"".join(json_pieces(parts_of(found), about, findings))
        return bytes_response(request, body, media_type=JSON, filename=None)
    if chosen == "npz":
        return bytes_response(request, to_npz(found), media_type=NPZ, filename=f"{filename}.npz")
    return bytes_response(
        request,
        to_safetensors(found, metadata_of(about, findings)),
        media_type=OCTETS,
        filename=f"{filename}.safetensors",
    )


def parts_of(found: Arrays) -> Iterator[Arrays]:
    """Yield a lift's arrays, some frames at a time.

    To write many keeps all other threads of this process waiting.
    """
    frames = len(found["points3d"])
    each = sum(array.nbytes for array in found.values()) // max(frames, 1)
    step = max(1, PART_BYTES // max(each, 1))
    for start in range(0, frames, step):
        yield {name: array[start : start + step] for name, array in found.items()}


def json_pieces(
    parts: Iterable[Arrays], about: dict[str, str | None], findings: Sequence[Finding]
) -> Iterator[bytes]:
    """Yield the JSON of a lift whose arrays come in parts, frame after frame.

    Between its beginning and its end there is a piece for each part, so that no more than one has
    to be in memory.
    """
    yield orjson.dumps(about)[:-1] + b',"frames":['
    comma = b""
    for part in parts:
        yield comma + b",".join(frames_to_json(part))
        comma = b","
    yield b'],"findings":' + orjson.dumps(dumped(findings)) + b"}"


def metadata_of(about: dict[str, str | None], findings: Sequence[Finding]) -> dict[str, str]:
    """Return the strings of a safetensors file besides its arrays."""
    metadata = {name: value for name, value in about.items() if value is not None}
    return metadata | {"findings": orjson.dumps(dumped(findings)).decode()}
