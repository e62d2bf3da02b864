"""Request bodies that carry arrays: JSON, raw bytes, or multipart/form-data."""

import hashlib
import os
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

import numpy as np
import orjson
from fastapi import Depends, Request
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from starlette.datastructures import UploadFile

from service import arrays
from service.arrays import Arrays
from service.errors import ApiError, from_validation, invalid
from service.settings import Settings
from store.capture import Capture
from store.errors import CaptureError

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
POINT_AXES = ("frames", "views", "keypoints", "x y")
TRUTH_AXES = ("frames", "keypoints", "x y z")


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
            raise from_validation(error) from error

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
            raise from_validation(error) from error


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


def to_capture(
    keypoints: object,
    confidence: object = None,
    points3d: object = None,
    *,
    settings: Settings,
    keypoints_field: str = "keypoints",
    expected_keypoints: int | None = None,
) -> Capture:
    """Check nested lists or arrays against the limits and return the capture they make."""
    sizes = (None, None, expected_keypoints, 2)
    limit = settings.max_body_bytes
    try:
        pixels = _array(keypoints, keypoints_field, POINT_AXES, sizes, limit)
        shape = pixels.shape
        most = (settings.max_frames, settings.max_views, settings.max_keypoints)
        for axis, count, allowed in zip(POINT_AXES, shape, most, strict=False):
            if count > allowed:
                raise CaptureError("keypoints", f"expected at most {allowed} {axis}, got {count}")
        return Capture.checked(
            pixels,
            None
            if confidence is None
            else _array(confidence, "confidence", POINT_AXES[:3], shape[:3], limit),
            None
            if points3d is None
            else _array(points3d, "points3d", TRUTH_AXES, (shape[0], shape[2], 3), limit),
        )
    except CaptureError as error:
        name = keypoints_field if error.field == "keypoints" else error.field
        raise invalid(f"/{name}", str(error)) from error


def read_arrays(upload: Upload, settings: Settings, known: frozenset[str]) -> Arrays:
    """Read the arrays of an upload's file that an operation knows; captures come with others."""
    found = arrays.from_bytes(upload.data, max_bytes=settings.max_body_bytes)
    return {name: array for name, array in found.items() if name in known}


def _array(
    value: object,
    name: str,
    axes: tuple[str, ...],
    sizes: tuple[int | None, ...],
    max_bytes: int,
) -> NDArray[np.float32]:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "iuf":
            raise invalid(f"/{name}", f"expected an array of numbers, got {value.dtype}")
        if value.ndim != len(axes):
            raise invalid(f"/{name}", f"expected axes ({', '.join(axes)}), got shape {value.shape}")
        with np.errstate(over="ignore"):  # what becomes infinite is refused with the infinite
            return value.astype(np.float32)
    return arrays.from_nested(value, f"/{name}", axes=axes, sizes=sizes, max_bytes=max_bytes)
