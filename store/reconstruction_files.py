"""A stored reconstruction as a file: laid out, and read from its object by ranges."""

import json
from typing import Any, Literal

from store.array_files import Array, LaidOutFile, Span, npz_file, safetensors_header
from store.capture_files import read_checksum
from store.database import Store
from store.fits import reconstruction_key
from store.lift_files import DTYPES
from store.lookup import lost
from store.records import FitJob


def reconstruction_file(
    store: Store, fit: FitJob, wanted: Literal["npz", "safetensors"], metadata: dict[str, str]
) -> LaidOutFile | None:
    """Return the reconstruction of a fit in a format; None for an older version's, which is less.

    Raises as ``fits.load_reconstruction`` does.

    Parameters
    ----------
    metadata
        Goes into a safetensors file.
    """
    key, objects = reconstruction_key(fit), store.objects
    try:
        size = int.from_bytes(objects.get_range(key, 0, 8), "little")
        header: dict[str, Any] = json.loads(objects.get_range(key, 8, 8 + size))
    except FileNotFoundError as error:
        raise lost(store, FitJob, fit.id, error) from error
    header.pop("__metadata__", None)
    if "camera_models" not in header:
        return None
    found = sorted(header.items(), key=lambda item: item[1]["data_offsets"])
    begin = 8 + size
    if wanted == "safetensors":
        arrays = [(n, a["dtype"], tuple(a["shape"]), DTYPES[a["dtype"]].itemsize) for n, a in found]
        end = begin + max(about["data_offsets"][1] for _, about in found)
        return LaidOutFile([safetensors_header(arrays, metadata), Span(key, begin, end)])
    return npz_file(
        [
            Array(
                name,
                DTYPES[about["dtype"]],
                tuple(about["shape"]),
                [Span(key, *(begin + offset for offset in about["data_offsets"]))],
            )
            for name, about in found
        ],
        lambda _array, part: read_checksum(objects, part),
    )
