"""The result of a lift as a file: laid out from its chunks' records, read from their objects.

A chunk is stored as one safetensors file and one of JSON lines. The files of the whole lift are the
same two, and npz.
"""

import zlib
from collections.abc import Sequence
from math import prod
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from store.array_files import Array, LaidOutFile, Part, Span, npz_file, safetensors_header
from store.records import LiftChunk, LiftRecord

ResultFormat = TypeAliasType("ResultFormat", Literal["jsonl", "npz", "safetensors"])

DTYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "I32": np.dtype("<i4"),
    "I8": np.dtype("i1"),
    "U8": np.dtype("u1"),
}
_NAMES = {dtype: name for name, dtype in DTYPES.items()}

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
        np.ascontiguousarray(arrays[name], DTYPES[dtype]).tobytes() for name, dtype, _ in layout
    ]
    header = _header(layout, len(arrays[names[0]]), {})
    checksums = {name: zlib.crc32(part) for name, part in zip(names, parts, strict=True)}
    return Packed(b"".join((header, *parts)), layout, checksums)


def result_file(
    lift: LiftRecord, chunks: Sequence[LiftChunk], wanted: ResultFormat, metadata: dict[str, str]
) -> LaidOutFile:
    """Return the result of a lift that succeeded, laid out in a format.

    Parameters
    ----------
    chunks
        All of them, in the order of their frames.
    metadata
        Goes into a safetensors file.
    """
    if wanted == "jsonl":
        return LaidOutFile([Span(str(c.lines_key), 0, c.lines_bytes or 0) for c in chunks])
    layout: Layout = [(name, dtype, shape) for name, dtype, shape in lift.layout or []]
    spans = [_spans(layout, index, chunks) for index in range(len(layout))]
    if wanted == "safetensors":
        header = _header(layout, lift.frames, metadata)
        return LaidOutFile([header, *(span for array in spans for span in array)])
    checksums = {str(chunk.arrays_key): chunk.checksums or {} for chunk in chunks}

    def checksum_of(array: Array, part: Part) -> int:
        assert isinstance(part, Span)  # noqa: S101 (all parts of these arrays are)
        checksum: int = checksums[part.key][array.name]
        return checksum

    return npz_file(
        [
            Array(name, DTYPES[dtype], (lift.frames, *shape), parts)
            for (name, dtype, shape), parts in zip(layout, spans, strict=True)
        ],
        checksum_of,
    )


def _spans(layout: Layout, index: int, chunks: Sequence[LiftChunk]) -> list[Span]:
    """Return where the bytes of one array lie, chunk after chunk."""
    before = sum(_frame_bytes(*array) for array in layout[:index])
    size = _frame_bytes(*layout[index])
    headers = {n: len(_header(layout, n, {})) for n in {c.frames for c in chunks}}
    starts = [headers[chunk.frames] + before * chunk.frames for chunk in chunks]
    return [
        Span(str(chunk.arrays_key), start, start + size * chunk.frames)
        for chunk, start in zip(chunks, starts, strict=True)
    ]


def _frame_bytes(_name: str, dtype: str, shape: list[int]) -> int:
    return DTYPES[dtype].itemsize * prod(shape)


def _header(layout: Layout, frames: int, metadata: dict[str, str]) -> bytes:
    """Return what stands before the arrays of ``frames`` frames in a safetensors file."""
    arrays = [(n, d, (frames, *shape), DTYPES[d].itemsize) for n, d, shape in layout]
    return safetensors_header(arrays, metadata)
