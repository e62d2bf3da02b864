"""Answers that carry a lift's arrays: as JSON, safetensors or npz."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import orjson
from fastapi import Query, Request
from numpy.typing import NDArray
from starlette.responses import Response
from typing_extensions import TypeAliasType

from models.findings.finding import Finding, dumped
from service.http.downloads import bytes_response
from service.http.negotiation import BINARY_FORMATS, NPZ, OCTETS, accepted_format
from service.wire import arrays
from service.wire.schemas import frames_json

Format = TypeAliasType("Format", Literal["json", "safetensors", "npz"])
FormatQuery = Annotated[
    Format | None,
    Query(description="Representation; without it the `Accept` header decides."),
]

_JSON = "application/json"
_FORMATS: dict[str, Format] = {
    "*/*": "json",
    "application/*": "json",
    _JSON: "json",
    **BINARY_FORMATS,
}


def chosen_format(request: Request, asked: Format | None) -> Format:
    """Return the format that a client gets a lift's arrays in; raise ``ApiError`` 406 if none."""
    return accepted_format(request, asked, _FORMATS)


def arrays_response(
    request: Request,
    found: dict[str, NDArray[Any]],
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
        said = {**about, "frames": frames_json(found), "findings": dumped(findings)}
        body = orjson.dumps(said)
        return bytes_response(request, body, media_type=_JSON, filename=None)
    if chosen == "npz":
        return bytes_response(
            request, arrays.to_npz(found), media_type=NPZ, filename=f"{filename}.npz"
        )
    return bytes_response(
        request,
        arrays.to_safetensors(found, metadata_of(about, findings)),
        media_type=OCTETS,
        filename=f"{filename}.safetensors",
    )


def metadata_of(about: dict[str, str | None], findings: Sequence[Finding]) -> dict[str, str]:
    """Return what a safetensors file says beside its arrays."""
    metadata = {name: value for name, value in about.items() if value is not None}
    return metadata | {"findings": orjson.dumps(dumped(findings)).decode()}
