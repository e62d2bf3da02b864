"""Choosing the representation that a client gets: by the query, or by its ``Accept`` header."""

from collections.abc import Mapping
from typing import Literal, TypeVar

from fastapi import Request

from service.http.errors import ApiError

AnyFormat = TypeVar("AnyFormat", bound=str)

OCTETS = "application/octet-stream"
NPZ = "application/x-npz"
BINARY_FORMATS: dict[str, Literal["safetensors", "npz"]] = {
    OCTETS: "safetensors",
    "application/vnd.safetensors": "safetensors",
    NPZ: "npz",
    "application/zip": "npz",
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
    known = ", ".join(media_type for media_type in formats if "*" not in media_type)
    raise ApiError(
        "not_acceptable", f"expected Accept to hold one of {known}, got {accept[:200]!r}"
    )
