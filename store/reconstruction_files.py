"""A stored reconstruction, read from its object by ranges: as a file, or some frames at a time."""

import json
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.settings.uncertainty import Uncertainty, of_uncertainty
from store.answers import reconstruction_key
from store.array_files import Array, LaidOutFile, Span, npz_file, safetensors_header
from store.capture_files import read_checksum
from store.database import Store
from store.lift_files import DTYPES
from store.lookup import lost
from store.records import FitRecord

PART_BYTES = 256 * 1024  # of arrays read at a time; as JSON they take six times as much


class _Stored(NamedTuple):
    """An array of a stored reconstruction, frames first."""

    name: str
    dtype: str  # as safetensors calls it
    shape: tuple[int, ...]
    span: Span


def reconstruction_file(
    store: Store,
    fit: FitRecord,
    wanted: Literal["npz", "safetensors"],
    metadata: dict[str, str],
    uncertainty: Uncertainty,
) -> LaidOutFile | None:
    """Return the reconstruction of a fit in a format; None for an older version's, which is less.

    Raises as ``answers.load_reconstruction`` does.

    Parameters
    ----------
    metadata
        Goes into a safetensors file.
    uncertainty
        How much of it is wanted, of what is stored.
    """
    found = _stored(store, fit)
    kept = of_uncertainty({array.name: array for array in found}, uncertainty)
    found = list(kept.values())
    if all(array.name != "camera_models" for array in found):
        return None
    if wanted == "safetensors":
        arrays = [(name, kind, shape, DTYPES[kind].itemsize) for name, kind, shape, _ in found]
        return LaidOutFile([safetensors_header(arrays, metadata), *(array.span for array in found)])
    return npz_file(
        [Array(name, DTYPES[kind], shape, [span]) for name, kind, shape, span in found],
        lambda _array, part: read_checksum(store.objects, part),
    )


def reconstruction_parts(
    store: Store, fit: FitRecord, wanted: range | None = None
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the arrays of a fit's reconstruction for some of its frames after others.

    Raises as ``answers.load_reconstruction`` does.

    Parameters
    ----------
    wanted
        Which of its frames; None for all.
    """
    found = _stored(store, fit)
    frames = found[0].shape[0]
    wanted = range(frames) if wanted is None else wanted
    sizes = [len(array.span) // frames for array in found]  # bytes of a frame
    step = max(1, PART_BYTES // sum(sizes))
    for some in (wanted[start : start + step] for start in range(0, len(wanted), step)):
        runs = [(some[0], some[-1] + 1)] if some.step == 1 else [(n, n + 1) for n in some]
        ranges = [
            (array.span.start + first * size, array.span.start + last * size)
            for array, size in zip(found, sizes, strict=True)
            for first, last in runs
        ]
        try:
            read = store.objects.get_ranges(reconstruction_key(fit), ranges)
        except FileNotFoundError as error:
            raise lost(store, FitRecord, fit.id, error) from error
        yield {
            name: np.frombuffer(b"".join(pieces), DTYPES[kind]).reshape(-1, *shape[1:])
            for (name, kind, shape, _), pieces in zip(found, _batches(read, len(runs)), strict=True)
        }


def _stored(store: Store, fit: FitRecord) -> list[_Stored]:
    """Return the arrays of a fit's reconstruction in the order of their bytes."""
    key, objects = reconstruction_key(fit), store.objects
    try:
        size = int.from_bytes(objects.get_range(key, 0, 8), "little")
        header: dict[str, Any] = json.loads(objects.get_range(key, 8, 8 + size))
    except FileNotFoundError as error:
        raise lost(store, FitRecord, fit.id, error) from error
    header.pop("__metadata__", None)
    spans = {
        name: Span(key, *(8 + size + offset for offset in about["data_offsets"]))
        for name, about in header.items()
    }
    return [
        _Stored(name, header[name]["dtype"], tuple(header[name]["shape"]), span)
        for name, span in sorted(spans.items(), key=lambda item: item[1].start)
    ]


def _batches(items: list[bytes], size: int) -> Iterator[list[bytes]]:
    return (items[start : start + size] for start in range(0, len(items), size))
