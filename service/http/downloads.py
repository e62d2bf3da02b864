"""Responses of bytes: whole or a range of them, with an entity tag, as RFC 9110 has it."""

import hashlib
import re
from collections.abc import AsyncIterator, Callable, Iterator
from itertools import chain, islice

from fastapi import Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse

from service.http.errors import ApiError
from service.http.places import Turns
from service.http.preconditions import is_known

_ONE_RANGE = re.compile(r"bytes=\s*([0-9]{0,18})-([0-9]{0,18})\s*")


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
    if is_known(request, etag):
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
    return StreamingResponse(_in_turns(request, _begun(body)), status_code, headers, media_type)


def streamed_response(
    request: Request, pieces: Iterator[bytes], *, media_type: str, checksum: str
) -> Response:
    """Answer a GET with bytes that are made piece by piece, of unknown size: without ranges.

    ``checksum`` is its entity tag.
    """
    etag = f'"{checksum}"'
    headers = _headers(None) | {"ETag": etag}
    if is_known(request, etag):
        return Response(status_code=304, headers=headers)
    in_turns = _in_turns(request, _begun(pieces))
    return StreamingResponse(in_turns, headers=headers, media_type=media_type)


def _begun(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Have errors of what is read first become problem details: the first piece may be a header."""
    first = list(islice(pieces, 2))
    return chain(first, pieces)


async def _in_turns(request: Request, pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Give pieces that are made one by one, as the client takes them, each in a turn."""
    turns: Turns = request.app.state.endpoints
    piece: bytes | None = b""
    while piece is not None:
        async with turns.turn(request, patient=True):
            piece = await run_in_threadpool(next, pieces, None)
        if piece:
            yield piece


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
    one_range = _ONE_RANGE.fullmatch(header)
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
