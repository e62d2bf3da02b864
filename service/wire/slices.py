"""Reading the long lists of a JSON body some frames at a time: as lists they take little at once.

Only the brackets of JSON are looked at here, which is enough: whatever is not as it should
be, or might not be, is left to be read as a whole.
"""

import re
import secrets
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from service.http.errors import ApiError
from service.wire.arrays import Arrays
from service.wire.captures import POINTS, Shape, to_array

SLICE_BYTES = 1024 * 1024
QUOTE, COMMA, OPEN, CLOSE = b'",[]'


class Sliced(NamedTuple):
    """A body whose long lists were taken out of it.

    Attributes
    ----------
    body
        All else that it holds; some text stands where lists were.
    arrays
        What these make.
    """

    body: dict[str, Any]
    arrays: Arrays


class _NotSlicedError(Exception):
    pass


def read_in_slices(
    data: bytearray, names: Sequence[str], check: Callable[[bytearray], None], max_bytes: int
) -> Sliced | None:
    """Return what a body holds, or None where its lists are no arrays at first sight.

    Parameters
    ----------
    names
        Of the fields that are lists of numbers.
    check
        Raises if what is left of the text takes too much.
    max_bytes
        That an array may take.
    """
    try:
        return _read(data, names, check, max_bytes)
    except (_NotSlicedError, ApiError, ValueError):  # also of broken JSON, and of unequal slices
        return None


def _read(
    data: bytearray, names: Sequence[str], check: Callable[[bytearray], None], max_bytes: int
) -> Sliced:
    cuts = {name: _cuts(data, start) for name, start in _starts(data, names).items()}
    mark, remaining, done = secrets.token_hex(), bytearray(), 0
    for places in sorted(cuts.values()):
        remaining += data[done : places[0]] + b'"%b"' % mark.encode()
        done = places[-1] + 1
    remaining += data[done:]
    check(remaining)
    body = orjson.loads(remaining)
    if not isinstance(body, dict):
        raise _NotSlicedError
    if any(body.get(name) != (mark if name in cuts else None) for name in names):
        raise _NotSlicedError  # those lists were of other fields, or others are none
    arrays: Arrays = {}
    shape: Shape = (None, None, None, 2)
    for name in sorted(cuts, key=lambda name: name not in POINTS):
        arrays[name] = _array(data, cuts[name], name, shape, max_bytes)
        shape = arrays[name].shape if name in POINTS else shape
    return Sliced(body, arrays)


def _starts(data: bytearray, names: Sequence[str]) -> dict[str, int]:
    """Return where the lists of fields begin, if each name is there once."""
    field = rb'"(%b)"\s*:\s*\[' % b"|".join(name.encode() for name in names)
    found: dict[str, int] = {}
    for match in re.finditer(field, data):
        name = match[1].decode()
        if name in found:
            raise _NotSlicedError
        found[name] = match.end() - 1
    return found


def _cuts(data: bytearray, start: int) -> list[int]:
    """Return the places of a list's first bracket, of some of its commas, and of its last bracket.

    The commas stand between its own items, which hold no text.
    """
    cuts, depth = [start], 0
    for begin in range(start, len(data), SLICE_BYTES):
        block = np.frombuffer(data, np.uint8, min(SLICE_BYTES, len(data) - begin), begin)
        opened, closed = block == OPEN, block == CLOSE
        depths = depth + np.cumsum(opened.astype(np.int8) - closed, dtype=np.int32)
        ends = np.flatnonzero(depths == 0)
        inside = block[: ends[0]] if len(ends) else block
        if (inside == QUOTE).any():
            raise _NotSlicedError
        if len(ends):
            return [*cuts, begin + int(ends[0])]
        commas = np.flatnonzero((depths == 1) & (block == COMMA))
        if len(commas):
            cuts.append(begin + int(commas[-1]))
        depth = int(depths[-1])
    raise _NotSlicedError


def _array(
    data: bytearray, cuts: list[int], name: str, shape: Shape, max_bytes: int
) -> NDArray[Any]:
    """Return the array that slices of a list make."""
    parts: list[NDArray[Any]] = []
    for part in _parts(data, cuts, name, shape, max_bytes):
        parts.append(part)
        max_bytes -= 4 * part.size
        if max_bytes < 0:
            raise _NotSlicedError
    return np.concatenate(parts)


def _parts(
    data: bytearray, cuts: list[int], name: str, shape: Shape, max_bytes: int
) -> Iterator[NDArray[Any]]:
    for start, end in pairwise(cuts):
        items = orjson.loads(b"[" + data[start + 1 : end] + b"]")
        part = to_array(items, name, shape, max_bytes)
        yield part
        if name in POINTS:  # a slice may have nulls alone
            shape = (None, *part.shape[1:])
