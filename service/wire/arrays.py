"""Arrays on the wire: JSON, npz and safetensors in; the same three out.

Nothing is ever unpickled, and no array is allocated before the bytes that fill it have come.
"""

import io
import math
import zipfile
from functools import partial
from itertools import chain
from typing import IO, Any, NamedTuple

import numpy as np
import orjson
from fewview.readers.npy import read_header
from numpy.typing import NDArray
from safetensors.numpy import save

from service.http.errors import ApiError, invalid
from service.http.uploads import HOW_TO_SEND_FILES
from service.http.zips import (
    MAX_MEMBERS,
    ZIP_FAULTS,
    ZIP_MAGIC,
    TooManyMembersError,
    members_of,
)
from store.array_files import PIECE_BYTES, safetensors_arrays

Arrays = dict[str, NDArray[Any]]

_MAX_HEADER = 1_000_000  # bytes of a safetensors header; a capture's has a few hundred
_FEW = 1000  # items


class Unlisted(NamedTuple):
    """Lists that hold nothing but nulls, of which the sizes alone are known."""

    frames: int
    views: int | None


def from_bytes(data: bytes, *, max_bytes: int) -> Arrays:
    """Read an npz or a safetensors file; how it begins shows which it is.

    Raises
    ------
    ApiError
        400 for anything that is neither, is cut short, or holds pickled members; 413 for an npz
        that unpacks to more than ``max_bytes``.
    """
    if data.startswith(ZIP_MAGIC):
        return _from_npz(data, max_bytes)
    try:
        if int.from_bytes(data[:8], "little") > _MAX_HEADER:
            raise ValueError("no header at its start")
        return safetensors_arrays(data)
    except ValueError as error:
        other = _other_kind(data)
        if other is not None:
            detail = f"The body is {other}, neither an .npz file nor safetensors. "
            raise ApiError("malformed_body", detail + HOW_TO_SEND_FILES) from error
        raise ApiError(
            "malformed_body",
            "The body is neither an .npz file nor safetensors, or it was cut short "
            f"({len(data)} bytes came): {error}",
        ) from error


def _other_kind(data: bytes) -> str | None:
    """Return what a body is that people take for arrays, None if it is none of these."""
    if data.startswith(b"\x89HDF\r\n\x1a\n"):
        return "an HDF5 file"
    if data.startswith(b"\x93NUMPY"):
        return "a single .npy array"
    try:
        text = data[:1000].decode("utf-8-sig", errors="strict" if len(data) <= 1000 else "ignore")
    except UnicodeDecodeError:
        return None
    if not text.strip() or (not text.isprintable() and not set(text) & set("\n,;\t{[")):
        return None
    if "\0" in text:
        return None
    return "JSON" if text.lstrip()[:1] in ("{", "[") else "text, such as CSV"


def _from_npz(data: bytes, max_bytes: int) -> Arrays:
    too_large = ApiError(
        "body_too_large",
        f"The .npz file of {len(data)} bytes unpacks to more than {max_bytes} bytes or "
        f"{MAX_MEMBERS} arrays. Save it with numpy.savez, which packs nothing, or send it in "
        "parts: POST /datasets/{id}/frames.",
    )
    try:
        members = members_of(data)
        if sum(member.file_size for member in members) > max_bytes:
            raise too_large
        arrays = {}
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for member in members:
                with archive.open(member) as stream:
                    name = member.filename.removesuffix(".npy")
                    arrays[name] = _from_npy(name, stream, member.file_size)
        return arrays
    except TooManyMembersError:
        raise too_large from None
    except ZIP_FAULTS as error:
        raise ApiError("malformed_body", f"The .npz file cannot be read: {error}") from error


def _from_npy(name: str, stream: IO[bytes], size: int) -> NDArray[Any]:
    """Read one member; numpy would believe the header and allocate whatever it promises."""
    shape, fortran_order, dtype = read_header(name, stream)
    if dtype.hasobject:
        raise ApiError(
            "malformed_body",
            f"The array {name!r} of the .npz file holds pickled objects, which are never read. "
            "Save numbers, as in keypoints.astype('float32'), and text as numpy.array(names, str).",
        )
    if math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"the array {name!r} is cut short")
    data = bytearray()  # which is grown in place: to join pieces would take twice as much
    # Read as a whole, it would keep all other threads waiting.
    for piece in iter(partial(stream.read, PIECE_BYTES), b""):
        data += piece
    values = np.frombuffer(data, dtype, count=math.prod(shape))
    return values.reshape(shape, order="F" if fortran_order else "C")


def to_safetensors(arrays: Arrays, metadata: dict[str, str]) -> bytes:
    """Return the arrays as safetensors bytes, the same for the same arrays and metadata."""
    data = save({name: np.ascontiguousarray(a) for name, a in arrays.items()}, metadata)
    # The library writes metadata in an order of chance; a download that is resumed needs one.
    size = int.from_bytes(data[:8], "little")
    header = orjson.dumps(orjson.loads(data[8 : 8 + size]), option=orjson.OPT_SORT_KEYS)
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + data[8 + size :]


def to_npz(arrays: Arrays) -> bytes:
    """Return the arrays as an npz file's bytes, the same for the same arrays.

    ``numpy.savez`` notes the time in them, and so a download could not be resumed.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def from_nested(
    value: object,
    pointer: str,
    *,
    axes: tuple[str, ...],
    sizes: tuple[int | None, ...],
    max_bytes: int,
) -> NDArray[np.float32]:
    """Turn nested lists into an array; ``null`` at any level means not observed, and gives NaN.

    Parameters
    ----------
    axes
        What each axis is, for the error message.
    sizes
        The sizes that are known beforehand, for input that is null as far as that axis.
    max_bytes
        Largest array to make: a few nulls can mean many numbers.

    An ``Unlisted`` represents lists of nulls.

    Raises
    ------
    ApiError
        422, naming the first list that has the wrong length or holds something else than numbers.
    """
    with np.errstate(over="ignore"):
        values = _from_regular(value, len(axes), max_bytes)
        if values is None:
            values = _from_gapped(value, pointer, axes, sizes, max_bytes)
    if np.isinf(values).any():
        raise invalid(pointer, "expected finite numbers, got infinity; write null for unobserved")
    return values


def _from_regular(value: object, axes: int, max_bytes: int) -> NDArray[np.float32] | None:
    """Convert lists that have one length per axis: the fast path, in steps of whole axes.

    Returns None for what :func:`_from_gapped` has to complete, or to refuse with its place.
    """
    level: list[Any] = [value]
    shape: list[int] = []
    for _ in range(axes):
        kinds = set(map(type, level))
        if kinds == {list, type(None)}:
            found = next(len(item) for item in level if item is not None)
            listed = sum(len(item) for item in level if item is not None)
            # Where nearly all is null, lists would take many times what came.
            if 4 * len(level) * found > max_bytes or len(level) * found > 8 * listed + _FEW:
                return None
            nulls = [None] * found
            level = [nulls if item is None else item for item in level]
        elif kinds != {list}:
            return None
        lengths = set(map(len, level))
        if len(lengths) > 1:
            return None
        shape.append(lengths.pop())
        level = list(chain.from_iterable(level))
    if not set(map(type, level)) <= {int, float, type(None)}:
        return None
    return np.array(level, np.float32).reshape(shape)


def _from_gapped(
    value: object,
    pointer: str,
    axes: tuple[str, ...],
    sizes: tuple[int | None, ...],
    max_bytes: int,
) -> NDArray[np.float32]:
    found: list[int | None] = [None] * len(axes)
    if isinstance(value, Unlisted):
        found[:2] = value
    else:
        _measure(value, found, 0)
    shape = []
    for axis, measured, known in zip(axes, found, sizes, strict=True):
        size = known if measured is None else measured
        if size is None:
            raise invalid(
                pointer,
                f"expected lists nested as ({', '.join(axes)}) with something observed, "
                f"found no list of {axis}",
            )
        shape.append(size)
    if 4 * math.prod(shape) > max_bytes:
        raise invalid(
            pointer,
            f"expected at most {max_bytes} bytes as float32, got {4 * math.prod(shape)} "
            f"({' x '.join(map(str, shape))}); send the frames in parts",
        )
    values = np.full(shape, np.nan, np.float32)
    if not isinstance(value, Unlisted):
        _fill(values, value, pointer, axes)
    return values


def _measure(value: object, sizes: list[int | None], axis: int) -> None:
    """Note the length of the first list met on each axis; :func:`_fill` checks the others."""
    if not isinstance(value, list):
        return
    if sizes[axis] is None:
        sizes[axis] = len(value)
    for item in value:
        if isinstance(item, list):
            if None not in sizes[axis + 1 :]:
                return
            _measure(item, sizes, axis + 1)


def _fill(target: NDArray[np.float32], value: object, pointer: str, axes: tuple[str, ...]) -> None:
    if value is None:
        return
    axis = axes[-target.ndim]
    if not isinstance(value, list) or len(value) != len(target):
        raise invalid(pointer, f"expected {len(target)} {axis}, got {_describe(value)}")
    for index, item in enumerate(value):
        place = f"{pointer}/{index}"
        if target.ndim > 1:
            _fill(target[index], item, place, axes)
        elif item is not None:
            if isinstance(item, bool) or not isinstance(item, int | float):
                raise invalid(place, f"expected a number or null, got {_describe(item)}")
            target[index] = item


def _describe(value: object) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if value is None:
        return "null"
    return "an object" if isinstance(value, dict) else f"{type(value).__name__} {value!r:.40}"
