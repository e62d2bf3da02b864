"""Large arrays: they lie in temporary files, and are worked on block by block.

An hour of four cameras at 100 frames per second takes gigabytes. So an array of more than `LARGE`
bytes is a memory map of a file without a name. The file is gone as soon as nobody uses the array,
however the process ends. All frames are worked on in blocks. After each block, the process releases
the pages that it touched, and the system keeps them while it has memory. A forked process shares
these arrays with its parent, which sees what it changes.

Processes that read untrusted files may only write into the folder of an upload. There `TMPDIR` is
this folder, and the limit of their address space counts these maps, too.
"""

import errno
import mmap
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import IO, Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError

LARGE = 2**26  # bytes
BLOCK = 2**21  # bytes that are worked on at a time, which fit into a core's cache
Array = NDArray[Any]
Some = TypeVar("Some", bound=Array)


class _OwnMap(mmap.mmap):
    """A map that is shared with its file: it keeps what is written to pages that are released."""


def gathered(parts: Iterable[Array]) -> Array:
    """Return an array (N, ...) of all parts (B, ...) in their order; it may be changed.

    Raises
    ------
    FormatError
        If there is no room for the file of a large array.
    """
    coming = iter(parts)
    kept, size = [], 0
    for part in coming:
        kept.append(part)
        size += part.nbytes
        if size > LARGE:
            break
    else:
        return np.concatenate(kept)
    shape, dtype, frames = kept[0].shape[1:], kept[0].dtype, 0
    with _file() as file:
        for part in chain(kept, coming):
            file.write(np.ascontiguousarray(part).data)
            frames += len(part)
        file.flush()
        return np.ndarray((frames, *shape), dtype, buffer=_OwnMap(file.fileno(), 0))


def built(part: Callable[[slice], Array], *sources: Array | None) -> Array:
    """Return a new array (N, ...) whose blocks a function returns, from those of `sources`."""
    none = part(slice(0, 0))  # an array without frames has a shape, too
    return gathered(chain([none], map(part, blocks(*sources))))


def rows_of(array: Some, kept: NDArray[np.bool_]) -> Some:
    """Return the rows that are kept (N,) of an array (N, ...); the array itself if all are."""
    return array if kept.all() else in_order(array, np.flatnonzero(kept))


def in_order(array: Some, rows: NDArray[np.intp]) -> Some:
    """Return a new array of these rows (N,), in their order, of an array (M, ...)."""
    return cast(Some, built(lambda block: array[rows[block]], rows, array))


def taken(array: Some, index: Sequence[int] | NDArray[np.intp], axis: int) -> Some:
    """Return a new array with these of an axis, which is not that of the frames (N, ...)."""
    places = np.asarray(index, np.intp)
    return cast(Some, built(lambda block: np.take(array[block], places, axis), array))


def blocks(*arrays: Array | None) -> Iterator[slice]:
    """Yield slices of frames, together all N of the first array, some `BLOCK` bytes of all arrays.

    After each, the memory that large arrays take is released.
    """
    given = [array for array in arrays if array is not None]
    frames = len(given[0])
    size = sum(array.nbytes // max(len(array), 1) for array in given)
    step = max(1, BLOCK // max(size, 1))
    for start in range(0, frames, step):
        try:
            yield slice(start, min(start + step, frames))
        finally:
            for array in given:
                _release(array)


def save(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write an npz of numbers and texts, as ``numpy.savez`` does, but block by block.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for name, given in arrays.items():
            array = np.require(given, requirements="C")
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                header = np.lib.format.header_data_from_array_1_0(array)
                np.lib.format.write_array_header_1_0(file, header)
                rows = np.atleast_1d(array)
                for block in blocks(rows):
                    file.write(rows[block].tobytes())


def _release(array: Array) -> None:
    """Give back the pages of an array that lies in a file; the file keeps what is in them."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    if isinstance(owner, _OwnMap) and hasattr(mmap, "MADV_DONTNEED"):  # else the system has to
        owner.madvise(mmap.MADV_DONTNEED)


@contextmanager
def _file() -> Iterator[IO[bytes]]:
    """Give a file without a name; a full disk raises `FormatError`, full memory `MemoryError`."""
    try:
        with TemporaryFile(prefix="fewview-") as file:
            yield file
    except OSError as error:
        if error.errno == errno.ENOMEM:
            raise MemoryError(str(error)) from error
        raise FormatError(
            f"no room for what is read ({error.strerror or error}); TMPDIR can name another folder",
            place=gettempdir(),
        ) from error
