"""Arrays as bytes, as they travel: safetensors both ways, npz for what holds text."""

import io
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAFETENSORS = "application/octet-stream"  # also what the service takes npz as
_LENGTH = struct.Struct("<Q")
_DTYPES = {
    "BOOL": "?",
    "I8": "<i1",
    "U8": "<u1",
    "I16": "<i2",
    "U16": "<u2",
    "I32": "<i4",
    "U32": "<u4",
    "I64": "<i8",
    "U64": "<u8",
    "F32": "<f4",
    "F64": "<f8",
}
_NAMES = {np.dtype(dtype): name for name, dtype in _DTYPES.items()}


def to_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as the bytes of an .npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def to_safetensors(
    arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str] | None = None
) -> bytes:
    """Return arrays of numbers, and strings about them, as the bytes of a safetensors file."""
    header: dict[str, Any] = {"__metadata__": dict(metadata)} if metadata else {}
    bodies, end = [], 0
    for name, array in arrays.items():
        body = np.ascontiguousarray(array).tobytes()
        place = [end, end := end + len(body)]
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": array.shape,
            "data_offsets": place,
        }
        bodies.append(body)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return b"".join((_LENGTH.pack(len(text)), text, *bodies))


def read_safetensors(data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return the arrays in a safetensors file, which cannot be written to, and its metadata.

    Raises
    ------
    ValueError, KeyError
        If these are no such bytes.
    """
    if len(data) < _LENGTH.size:
        raise ValueError(f"expected a safetensors file, got {len(data)} bytes")
    (length,) = _LENGTH.unpack_from(data)
    start = _LENGTH.size + length
    header = json.loads(data[_LENGTH.size : start])
    metadata = header.pop("__metadata__", {})
    arrays = {}
    for name, entry in header.items():
        first, last = entry["data_offsets"]
        body = memoryview(data)[start + first : start + last]
        arrays[name] = np.frombuffer(body, _DTYPES[entry["dtype"]]).reshape(entry["shape"])
    return arrays, metadata
