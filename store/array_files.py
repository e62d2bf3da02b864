"""Virtual files of arrays: only their layout is computed, and bytes are read from stored objects.

The place of each byte follows from the shapes of the arrays, so that any range of a file can be
read without all other parts, however long it is.
"""

import hashlib
import io
import json
import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from store.crc import combine

PIECE_BYTES = 1024 * 1024  # read at a time
TYPES = {  # as safetensors calls them
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "|i1",
    "U64": "<u8",
    "U32": "<u4",
    "U16": "<u2",
    "U8": "|u1",
    "BOOL": "|b1",
}

GetRange = Callable[[str, int, int], bytes]  # of an object, from a start up to an end


@dataclass(frozen=True)
class Span:
    """Bytes of an object, from ``start`` up to ``end``."""

    key: str
    start: int
    end: int

    def __len__(self) -> int:
        return self.end - self.start

    def read(self, get_range: GetRange, start: int, end: int) -> bytes:
        """Return its bytes from ``start`` up to ``end``, counted from its own start."""
        return get_range(self.key, self.start + start, self.start + end)


@dataclass(frozen=True)
class Filling:
    """The same few bytes, over and over."""

    unit: bytes
    count: int

    def __len__(self) -> int:
        return len(self.unit) * self.count

    def read(self, _get_range: GetRange, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end``."""
        first = start // len(self.unit)
        units = self.unit * (-(-end // len(self.unit)) - first)
        return units[start - first * len(self.unit) :][: end - start]


@dataclass(frozen=True)
class Patched:
    """Another part of which a few bytes are others: where they begin, and what they are.

    The bytes of one place are as many as those of the other and do not overlap.
    """

    part: Span | Filling
    patches: tuple[tuple[int, bytes], ...]  # by where they begin

    def __len__(self) -> int:
        return len(self.part)

    def read(self, get_range: GetRange, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end``."""
        data = bytearray(self.part.read(get_range, start, end))
        first = bisect_left(self.patches, (start,))
        for at, new in self.patches[max(0, first - 1) :]:  # the one before may reach in here
            if at >= end:
                break
            kept = new[max(0, start - at) : end - at]
            offset = max(0, at - start)
            data[offset : offset + len(kept)] = kept
        return bytes(data)


Part = bytes | Span | Filling | Patched


class Array(NamedTuple):
    """An array of a file."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    parts: Sequence[Part]  # little-endian, in C order


class LaidOutFile:
    """A file that lies in parts: bytes that are known, and what is read when it is asked for."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts = parts
        self._starts = [0, *accumulate(map(len, parts))]
        self.size = self._starts[-1]

    def checksum(self) -> str:
        """Return a digest that no other file has: objects are written once, under new keys."""
        digest = hashlib.sha256()
        for part in self._parts:
            known = part if isinstance(part, bytes) else f"{part}".encode()
            digest.update(len(known).to_bytes(8) + known)
        return digest.hexdigest()

    def read(self, get_range: GetRange, start: int, end: int) -> Iterator[bytes]:
        """Yield the bytes from ``start`` up to ``end``, in pieces of a size that is bounded."""
        index = bisect_right(self._starts, start) - 1
        while start < end:
            part, offset = self._parts[index], start - self._starts[index]
            size = min(end, self._starts[index + 1]) - start
            if not isinstance(part, bytes):
                size = min(size, PIECE_BYTES)
                yield part.read(get_range, offset, offset + size)
            elif size:
                yield part[offset : offset + size]
            start += size
            index += start == self._starts[index + 1]


def safetensors_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of a safetensors file, which stay in the bytes given and are not written.

    The library's own function copies them, and has all other threads wait for it.

    Raises
    ------
    ValueError
        If these bytes are no such file.
    """
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 + size:
        raise ValueError("its header is cut short")
    arrays = {}
    try:
        for name, entry in json.loads(data[8 : 8 + size]).items():
            if name == "__metadata__":
                continue
            dtype, shape = np.dtype(TYPES[entry["dtype"]]), entry["shape"]
            start, end = (8 + size + offset for offset in entry["data_offsets"])
            if not all(type(length) is int and length >= 0 for length in (*shape, start, end)):
                raise ValueError(f"the array {name!r} has no sizes that can be")
            if end > len(data) or end - start != dtype.itemsize * prod(shape) or start < 8 + size:
                raise ValueError(f"the array {name!r} lies outside the file, or is cut short")
            arrays[name] = np.frombuffer(data, dtype, prod(shape), start).reshape(shape)
    except (AttributeError, KeyError, RecursionError, TypeError) as error:
        raise ValueError(f"its header cannot be understood: {error!r:.200}") from error
    return arrays


def safetensors_header(
    arrays: Sequence[tuple[str, str, tuple[int, ...], int]], metadata: dict[str, str]
) -> bytes:
    """Return what stands before the arrays in a safetensors file.

    Of each array its name, its type as safetensors calls it, its shape, and the bytes of a number.
    """
    header: dict[str, Any] = {"__metadata__": metadata} if metadata else {}
    start = 0
    for name, dtype, shape, size in arrays:
        end = start + size * prod(shape)
        header[name] = {"data_offsets": [start, end], "dtype": dtype, "shape": list(shape)}
        start = end
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def npz_file(arrays: Sequence[Array], checksum_of: Callable[[Array, Part], int]) -> LaidOutFile:
    """Return an npz file: a zip file whose members are stored as they are.

    Sizes are written as ZIP64 (APPNOTE.TXT, 4.3.9 to 4.5.3), which holds for small ones too.

    Parameters
    ----------
    checksum_of
        Gives the CRC-32 of a part of an array.
    """
    parts: list[Part] = []
    directory = b""
    offset = 0
    for array in arrays:
        prefix = _npy_header(array.dtype, array.shape)
        checksum, size = zlib.crc32(prefix), len(prefix)
        for part in array.parts:
            checksum = combine(checksum, checksum_of(array, part), len(part))
            size += len(part)
        filename = f"{array.name}.npy".encode()
        common = struct.pack("<5HI2I", 45, 0, 0, 0, 33, checksum, _IN_EXTRA, _IN_EXTRA)
        names = struct.pack("<H", len(filename))
        sizes = struct.pack("<2H2Q", 1, 16, size, size)
        local = b"PK\x03\x04" + common + names + struct.pack("<H", len(sizes)) + filename + sizes
        parts += [local + prefix, *array.parts]
        extra = struct.pack("<2H3Q", 1, 24, size, size, offset)
        directory += b"PK\x01\x02" + struct.pack("<H", 45) + common + names
        directory += struct.pack("<4H2I", len(extra), 0, 0, 0, 0o600 << 16, _IN_EXTRA)
        directory += filename + extra
        offset += len(local) + size
    return LaidOutFile([*parts, directory, _zip_end(len(arrays), offset, len(directory))])


def _zip_end(count: int, offset: int, directory_bytes: int) -> bytes:
    """Return the end of a zip file whose directory begins at ``offset``."""
    end = offset + directory_bytes
    versions_disks = struct.pack("<2H2I", 45, 45, 0, 0)
    tail = struct.pack("<4Q", count, count, directory_bytes, offset)
    return (
        b"PK\x06\x06"
        + (struct.pack("<Q", 44) + versions_disks + tail)
        + (b"PK\x06\x07" + struct.pack("<IQI", 0, end, 1))
        + (b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, count, count, _IN_EXTRA, _IN_EXTRA, 0))
    )


_IN_EXTRA = 0xFFFFFFFF  # the number is in the ZIP64 field


def _npy_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return what stands before an array's bytes in an npy file."""
    header = io.BytesIO()
    about = {"descr": dtype.str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, about)
    return header.getvalue()
