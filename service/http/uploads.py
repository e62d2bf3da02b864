"""Request bodies, read within their limits: JSON, raw bytes, or multipart/form-data."""

import hashlib
import os
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

import orjson
from fastapi import Depends, Request
from pydantic import BaseModel, ValidationError
from starlette.datastructures import UploadFile

from service.http.errors import ApiError, from_validation, invalid
from service.settings import Settings

Body = TypeVar("Body", bound=BaseModel)

BINARY_TYPES = (
    "application/octet-stream",
    "application/vnd.safetensors",
    "application/x-safetensors",
    "application/x-npz",
    "application/npz",
    "application/zip",
)
LARGE_BYTES = 1024 * 1024
LARGE_AT_A_TIME = min(4, os.cpu_count() or 1)


@dataclass(frozen=True)
class Upload:
    """A body that has come whole and within the limits, not yet understood.

    Attributes
    ----------
    data
        The JSON text, or the bytes of an npz or safetensors file.
    is_json
        Which of the two.
    fields
        Text fields that came beside the file in a form.
    """

    data: bytes
    is_json: bool
    fields: dict[str, str] = field(default_factory=dict)

    def fingerprint(self) -> str:
        """Return a digest of everything in the body."""
        digest = hashlib.sha256(self.data)
        for name, text in sorted(self.fields.items()):
            digest.update(f"\0{name}\0{text}".encode())
        return digest.hexdigest()

    def json(self, model: type[Body]) -> Body:
        """Return the JSON body as ``model``."""
        if not self.is_json:
            raise ApiError("unsupported_media_type", "expected Content-Type application/json")
        try:
            return model.model_validate(orjson.loads(self.data))
        except orjson.JSONDecodeError as error:
            raise ApiError(
                "malformed_body",
                f"The body is not valid JSON: {error}. JSON knows no NaN or Infinity: write null "
                "for what was not observed.",
            ) from error
        except ValidationError as error:
            raise from_validation(error, model) from error

    def form(self, model: type[Body], extra: dict[str, Any]) -> Body:
        """Return the form's text fields as ``model``, with ``extra`` where they are silent.

        A field that is not a plain string in ``model`` is read as JSON.
        """
        values = dict(extra)
        for name, text in self.fields.items():
            known = model.model_fields.get(name)
            try:
                values[name] = text if known and known.annotation is str else orjson.loads(text)
            except orjson.JSONDecodeError as error:
                raise invalid(f"/{name}", f"expected JSON, got {text[:40]!r}") from error
        try:
            return model.model_validate(values)
        except ValidationError as error:
            raise from_validation(error, model) from error


async def read_upload(request: Request) -> AsyncIterator[Upload]:
    """Give a body of any of the accepted types; the size limits hold while it streams in.

    Working on a body takes many times its size in memory. Large ones take turns at that, a few at
    a time, and so leave the threads to the small ones.
    """
    upload = await read_body(request)
    if len(upload.data) < LARGE_BYTES:
        yield upload
    else:
        async with request.app.state.large_uploads:
            yield upload


async def read_body(request: Request) -> Upload:
    """Return a body of any of the accepted types; the size limits hold while it streams in.

    Raises
    ------
    ApiError
        413 for JSON that is too long, 415 for another type, 422 for a form without a file.
    """
    settings: Settings = request.app.state.settings
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        async with request.form(max_files=1, max_fields=16) as form:
            file = form.get("file")
            if not isinstance(file, UploadFile):
                raise invalid("/file", "expected an .npz or safetensors file in this form field")
            fields = {name: text for name, text in form.items() if isinstance(text, str)}
            return Upload(await file.read(), is_json=False, fields=fields)
    if media_type in BINARY_TYPES:
        return Upload(await request.body(), is_json=False)
    if media_type == "application/json" or media_type.endswith("+json"):
        pieces, size = [], 0
        async for piece in request.stream():
            pieces.append(piece)
            size += len(piece)
            if size > settings.max_json_bytes:
                raise ApiError(
                    "body_too_large",
                    f"JSON bodies may have {settings.max_json_bytes} bytes at most. Send "
                    "safetensors or npz (application/octet-stream), or the frames in parts.",
                )
        return Upload(b"".join(pieces), is_json=True)
    raise ApiError(
        "unsupported_media_type",
        f"expected Content-Type application/json, application/octet-stream (npz or safetensors) "
        f"or multipart/form-data, got {media_type or 'none'!r}",
    )


UploadBody = Annotated[Upload, Depends(read_upload, scope="function")]  # until it is answered
