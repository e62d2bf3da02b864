"""Request bodies, read within their limits: JSON, raw bytes, or multipart/form-data."""

import codecs
import io
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, TypeVar

import orjson
from fastapi import Depends, Request
from pydantic import BaseModel, ValidationError
from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData, UploadFile

from service.http.errors import ApiError, from_validation, invalid
from service.http.json_bounds import check_bounds
from service.http.zips import ZIP_FAULTS, TooManyMembersError, members_of
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
HOW_TO_SEND_FILES = (
    "Detectors' files (CSV, H5, JSON, zip) become a dataset in a form, one for each camera: "
    "curl -F files=@cam1.csv -F files=@cam2.csv ADDRESS/datasets. Folders are sent as one zip: "
    "curl -F folders=@capture.zip ADDRESS/datasets"
)
CHARSETS = ("utf-8", "ascii", "iso8859-1")  # of forms
LARGE_BYTES = 1024 * 1024
NULL_BYTES = 256  # counted for a null of JSON: it may mean a keypoint, a view or a frame
# Times the largest JSON body: what a body may take as lists, while it is read in a process of its
# own. Captures take 10 to 15.
DECODED = 16
# What each array of a JSON body may take, for nulls may stand for much, and all arrays of an npz,
# which may be packed: so many times the body, or this.
AS_ARRAYS, SMALL_ARRAYS = 4, 16 * 1024 * 1024


@dataclass(frozen=True)
class File:
    """A file of a form, under the name that it has where it comes from.

    Attributes
    ----------
    holds_folders
        Whether it is a zip of files and folders, which stand for it.
    """

    name: str
    data: bytes
    holds_folders: bool = False


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
    files
        Those that a form calls `files`, and `folders`, if any; `data` are those of the first.
    max_decoded_bytes
        Approximate memory limit of the decoded JSON, bytes.
    max_array_bytes
        What each array of JSON may take, and all of an npz together.
    """

    data: bytes
    is_json: bool
    fields: dict[str, str] = field(default_factory=dict)
    files: tuple[File, ...] = ()
    max_decoded_bytes: int = 0
    max_array_bytes: int = 0

    @cached_property
    def decoded_bytes(self) -> int:
        """About how much there will be to work on: npz may be packed, JSON full of nulls.

        Of a large body its size: to look through it would take long.
        """
        size = len(self.data)
        if size >= LARGE_BYTES:
            return size
        if self.is_json:
            return size + NULL_BYTES * self.data.count(b"null")
        if not self.data.startswith(b"PK"):
            return size
        try:
            return size + sum(member.file_size for member in members_of(self.data))
        except (*ZIP_FAULTS, TooManyMembersError):  # none, or one that cannot be read
            return size

    @property
    def is_large(self) -> bool:
        """Whether to work on it takes so much that large ones take turns."""
        return self.decoded_bytes >= LARGE_BYTES

    def form(
        self, model: type[Body], extra: dict[str, Any], kind: type[BaseModel] | None = None
    ) -> Body:
        """Return the form's text fields as ``model``, with ``extra`` where they are silent.

        A field that is not a plain string in ``model`` is read as JSON. One that is not known is
        answered with those of ``kind``, which may be more than the model's.
        """
        values = dict(extra)
        for name, text in self.fields.items():
            known = model.model_fields.get(name)
            try:
                value = text if known and known.annotation is str else orjson.loads(text)
            except orjson.JSONDecodeError as error:
                raise invalid(f"/{name}", f"expected JSON, got {text[:40]!r}") from error
            check_bounds({name: value}, model)  # before there is another
            values[name] = value if known else None
        check_bounds(values, model)
        try:
            return model.model_validate(values)
        except ValidationError as error:
            raise from_validation(error, kind or model) from error


async def read_upload(request: Request) -> AsyncIterator[Upload]:
    """Give a body of any of the accepted types; the size limits hold while it streams in.

    Working on a body takes many times its size in memory. Large ones take turns at that, a few at
    a time, and so leave the threads to the small ones.
    """
    async with _in_turn(request, await read_body(request)) as upload:
        yield upload


async def read_files(request: Request) -> AsyncIterator[Upload]:
    """Give a body as `read_upload` does; a form may have files of detectors.

    Reading such files may take minutes even if they are small, in a separate process. So they have
    separate turns, and large uploads do not wait for them.
    """
    settings: Settings = request.app.state.settings
    upload = await read_body(request, max_files=settings.max_views)
    async with _in_turn(request, upload):
        yield upload


@asynccontextmanager
async def _in_turn(request: Request, upload: Upload) -> AsyncIterator[Upload]:
    state = request.app.state
    if upload.files:
        async with state.readers.turn(request):
            yield upload
    elif upload.is_large:
        async with state.large_uploads.turn(request):
            yield upload
    else:
        yield upload


async def read_body(request: Request, *, max_files: int = 1) -> Upload:
    """Return a body of any of the accepted types; the size limits hold while it streams in.

    Raises
    ------
    ApiError
        413 for JSON that is too long, 415 for another type or charset, 422 for a form without a
        file.
    """
    settings: Settings = request.app.state.settings
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        _check_charset(request.headers["content-type"])
        async with request.form(max_files=max_files, max_fields=16) as form:
            found = await _of_form(form, several=max_files > 1)
            return replace(found, max_array_bytes=_as_arrays(len(found.data), settings))
    if media_type in BINARY_TYPES:
        whole = io.BytesIO()  # which is grown in place: to join pieces would take long at the end
        async for piece in request.stream():
            whole.write(piece)
        most = _as_arrays(whole.tell(), settings)
        return Upload(whole.getvalue(), is_json=False, max_array_bytes=most)
    if media_type == "application/json" or media_type.endswith("+json"):
        whole, size = io.BytesIO(), 0
        async for piece in request.stream():
            size += whole.write(piece)
            if size > settings.max_json_bytes:
                raise ApiError(
                    "body_too_large",
                    f"JSON bodies may have {settings.max_json_bytes} bytes at most. Send "
                    "safetensors or npz (application/octet-stream), or the frames in parts.",
                )
        return Upload(
            whole.getvalue(),
            is_json=True,
            max_decoded_bytes=DECODED * settings.max_json_bytes,
            max_array_bytes=_as_arrays(size, settings),
        )
    hint = HOW_TO_SEND_FILES if max_files > 1 else "JSON: curl -H 'Content-Type: application/json'"
    raise ApiError(
        "unsupported_media_type",
        f"expected Content-Type application/json, application/octet-stream (npz or safetensors) "
        f"or multipart/form-data, got {media_type or 'none'!r}. {hint}",
    )


def _as_arrays(size: int, settings: Settings) -> int:
    """Return what a body of so many bytes may take as arrays."""
    return min(settings.max_body_bytes, max(AS_ARRAYS * size, SMALL_ARRAYS))


def _check_charset(content_type: str) -> None:
    """Refuse a form whose texts are in another encoding than those that every tool knows."""
    charset = parse_options_header(content_type)[1].get(b"charset", b"utf-8").decode("latin-1")
    try:
        known = codecs.lookup(charset).name in CHARSETS
    except (LookupError, ValueError):
        known = False
    if not known:
        raise ApiError(
            "unsupported_media_type",
            f"expected a form in UTF-8, got the charset {charset[:40]!r}; leave the charset out",
        )


async def _of_form(form: FormData, *, several: bool) -> Upload:
    def named(name: str) -> list[UploadFile]:
        return [part for part in form.getlist(name) if isinstance(part, UploadFile)]

    one, many = named("file"), named("files") if several else []
    folders = named("folders") if several else []
    if len(one) + bool(many) + len(folders) > 1:
        raise ApiError(
            "malformed_body",
            "expected one `file` of arrays, or `files`, one for each camera, or one zip of "
            "`folders`",
        )
    if not one and not many and not folders:
        raise invalid(
            "/file",
            "expected an .npz or safetensors file in this form field"
            + (
                ", or detectors' files as `files`, one for each camera, or a zip of folders as "
                "`folders`"
                if several
                else ""
            ),
        )
    fields = {name: text for name, text in form.items() if isinstance(text, str)}
    listed = [(part, part in folders) for part in (*one, *many, *folders)]
    files = tuple([File(part.filename or "", await _whole(part), of) for part, of in listed])
    return Upload(files[0].data, is_json=False, fields=fields, files=() if one else files)


async def _whole(part: UploadFile) -> bytes:
    """Return the bytes of a part, read some at a time: at once, all others would have to wait."""
    whole = io.BytesIO()
    while piece := await part.read(LARGE_BYTES):
        whole.write(piece)
    return whole.getvalue()


# Until it is answered.
UploadBody = Annotated[Upload, Depends(read_upload, scope="function")]
FilesBody = Annotated[Upload, Depends(read_files, scope="function")]
