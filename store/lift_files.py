"""The result of a lift as a file: laid out from its chunks' records, read from their objects.

A chunk is stored as one safetensors file and one of JSON lines. The files of the whole lift (the
same two, and npz) are never written: where each of their bytes lies follows from the number of
frames, so that any range of them can be read without the rest, however long the lift.
"""

import hashlib
import io
import json
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import prod
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from store.crc import combine
from store.records import LiftChunk, LiftJob

ResultFormat = TypeAliasType("ResultFormat", Literal["jsonl", "npz", "safetensors"])

PIECE_BYTES = 1024 * 1024  # read at a time

_DTYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "I32": np.dtype("<i4"),
    "I8": np.dtype("i1"),
    "U8": np.dtype("u1"),
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}

# Of each array, in the order of safetensors: its name, its type as that calls it, and the shape it
# has for one frame.
Layout = list[tuple[str, str, list[int]]]


class Packed(NamedTuple):
    """A chunk's arrays, packed."""

    data: bytes  # safetensors
    layout: Layout
    checksums: dict[str, int]  # CRC-32 of each array's bytes


def pack(arrays: dict[str, NDArray[Any]]) -> Packed:
    """Return a chunk's arrays, frames first, as safetensors with all that is to be known of it."""
    names = sorted(arrays, key=lambda name: (-arrays[name].dtype.itemsize, name))
    layout = [
        (name, _NAMES[arrays[name].dtype.newbyteorder("<")], list(arrays[name].shape[1:]))
        for name in names
    ]
    parts = [
        np.ascontiguousarray(arrays[name], _DTYPES[dtype]).tobytes() for name, dtype, _ in layout
    ]
    header = _safetensors_header(layout, len(arrays[names[0]]), {})
    checksums = {name: zlib.crc32(part) for name, part in zip(names, parts, strict=True)}
    return Packed(b"".join((header, *parts)), layout, checksums)


@dataclass(frozen=True)
class Span:
    """Bytes of an object, from ``start`` up to ``end``."""

    key: str
    start: int
    end: int


class ResultFile:
    """A file that lies in parts: bytes that are known, and spans of objects."""

    def __init__(self, parts: Sequence[bytes | Span]) -> None:
        self._parts = parts
        sizes = (len(p) if isinstance(p, bytes) else p.end - p.start for p in parts)
        self._starts = [0, *accumulate(sizes)]
        self.size = self._starts[-1]

    def checksum(self) -> str:
        """Return a digest that no other file has: objects are written once, under new keys."""
        digest = hashlib.sha256()
        for part in self._parts:
            known = part if isinstance(part, bytes) else f"{part}".encode()
            digest.update(len(known).to_bytes(8) + known)
        return digest.hexdigest()

    def read(
        self, get_range: Callable[[str, int, int], bytes], start: int, end: int
    ) -> Iterator[bytes]:
        """Yield the bytes from ``start`` up to ``end``, in pieces of a size that is bounded."""
        index = bisect_right(self._starts, start) - 1
        while start < end:
            part, offset = self._parts[index], start - self._starts[index]
            size = min(end, self._starts[index + 1]) - start
            if isinstance(part, Span):
                size = min(size, PIECE_BYTES)
                yield get_range(part.key, part.start + offset, part.start + offset + size)
            elif size:
                yield part[offset : offset + size]
            start += size
            index += start == self._starts[index + 1]


def result_file(
    lift: LiftJob, chunks: Sequence[LiftChunk], wanted: ResultFormat, metadata: dict[str, str]
) -> ResultFile:
    """Return the result of a lift that succeeded, laid out in a format.

    Parameters
    ----------
    chunks
        All of them, in the order of their frames.
    metadata
        Goes into a safetensors file.
    """
    if wanted == "jsonl":
        return ResultFile([Span(str(c.lines_key), 0, c.lines_bytes or 0) for c in chunks])
    layout: Layout = [(name, dtype, shape) for name, dtype, shape in lift.layout or []]
    if wanted == "npz":
        return ResultFile(_npz(lift.frames, layout, chunks))
    header = _safetensors_header(layout, lift.frames, metadata)
    return ResultFile([header, *(s for n in range(len(layout)) for s in _spans(layout, n, chunks))])


def _spans(layout: Layout, index: int, chunks: Sequence[LiftChunk]) -> list[Span]:
    """Return where the bytes of one array lie, chunk after chunk."""
    before = sum(_frame_bytes(*array) for array in layout[:index])
    size = _frame_bytes(*layout[index])
    headers = {n: len(_safetensors_header(layout, n, {})) for n in {c.frames for c in chunks}}
    starts = [headers[chunk.frames] + before * chunk.frames for chunk in chunks]
    return [
        Span(str(chunk.arrays_key), start, start + size * chunk.frames)
        for chunk, start in zip(chunks, starts, strict=True)
    ]


def _frame_bytes(_name: str, dtype: str, shape: list[int]) -> int:
    return _DTYPES[dtype].itemsize * prod(shape)


def _safetensors_header(layout: Layout, frames: int, metadata: dict[str, str]) -> bytes:
    """Return what stands before the arrays of ``frames`` frames in a safetensors file."""
    header: dict[str, Any] = {"__metadata__": metadata} if metadata else {}
    start = 0
    for array in layout:
        name, dtype, shape = array
        end = start + frames * _frame_bytes(*array)
        header[name] = {"data_offsets": [start, end], "dtype": dtype, "shape": [frames, *shape]}
        start = end
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _npz(frames: int, layout: Layout, chunks: Sequence[LiftChunk]) -> list[bytes | Span]:
    """Return the parts of an npz file: a zip file whose members are stored as they are.

    Sizes are written as ZIP64 (APPNOTE.TXT, 4.3.9 to 4.5.3), which holds for small ones too.
    """
    parts: list[bytes | Span] = []
    directory = b""
    offset = 0
    for index, array in enumerate(layout):
        name, dtype, shape = array
        prefix = _npy_header(_DTYPES[dtype], (frames, *shape))
        checksum = zlib.crc32(prefix)
        for chunk in chunks:
            known = (chunk.checksums or {})[name]
            checksum = combine(checksum, known, chunk.frames * _frame_bytes(*array))
        size = len(prefix) + frames * _frame_bytes(*array)
        filename = f"{name}.npy".encode()
        common = struct.pack("<5HI2I", 45, 0, 0, 0, 33, checksum, _IN_EXTRA, _IN_EXTRA)
        names = struct.pack("<H", len(filename))
        sizes = struct.pack("<2H2Q", 1, 16, size, size)
        local = b"PK\x03\x04" + common + names + struct.pack("<H", len(sizes)) + filename + sizes
        parts += [local + prefix, *_spans(layout, index, chunks)]
        extra = struct.pack("<2H3Q", 1, 24, size, size, offset)
        directory += b"PK\x01\x02" + struct.pack("<H", 45) + common + names
        directory += struct.pack("<4H2I", len(extra), 0, 0, 0, 0o600 << 16, _IN_EXTRA)
        directory += filename + extra
        offset += len(local) + size
    count = len(layout)
    end = offset + len(directory)
    versions_disks = struct.pack("<2H2I", 45, 45, 0, 0)
    tail = struct.pack("<4Q", count, count, len(directory), offset)
    return [
        *parts,
        directory,
        b"PK\x06\x06" + struct.pack("<Q", 44) + versions_disks + tail,
        b"PK\x06\x07" + struct.pack("<IQI", 0, end, 1),
        b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, count, count, _IN_EXTRA, _IN_EXTRA, 0),
    ]


_IN_EXTRA = 0xFFFFFFFF  # says that the number stands in the ZIP64 field


def _npy_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return what stands before an array's bytes in an npy file."""
    header = io.BytesIO()
    about = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, about)
    return header.getvalue()
