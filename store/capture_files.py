"""A dataset's capture as an npz file, as `POST /datasets` takes it: laid out from its chunks."""

import json
import zlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from sqlalchemy import select

from store.array_files import Array, Filling, LaidOutFile, Part, Span, npz_file
from store.capture import ARRAYS
from store.database import Store
from store.errors import NotFoundError
from store.objects import Objects
from store.records import Chunk, Dataset

DTYPES: dict[str, np.dtype[Any]] = {name: np.dtype("<f4") for name in ARRAYS} | {
    "times": np.dtype("<f8")
}
FILLED_IN = {"confidence": 1.0, "points3d": np.nan}  # where only some chunks have them
UNKNOWN_SIZE = [0, 0]  # of images, which npz cannot leave out for one view


def capture_file(store: Store, dataset: Dataset) -> LaidOutFile:
    """Return the capture of a dataset as it is now, laid out as an npz file.

    Raises ``NotFoundError`` if the dataset was deleted since its record was read.
    """
    query = select(Chunk).where(Chunk.dataset_id == dataset.id).order_by(Chunk.first_frame)
    with store.reading() as session:
        chunks = list(session.scalars(query))
    try:
        return npz_file(
            [*_of_frames(store, dataset, chunks), *_of_description(dataset)],
            lambda _array, part: _checksum(store.objects, part),
        )
    except FileNotFoundError as error:
        raise NotFoundError("dataset", dataset.id) from error


def _of_frames(store: Store, dataset: Dataset, chunks: Sequence[Chunk]) -> list[Array]:
    layouts = [_layout(store.objects, chunk.key) for chunk in chunks]
    views, keypoints = dataset.views, dataset.keypoints
    shapes: dict[str, tuple[int, ...]] = {
        "keypoints": (views, keypoints, 2),
        "confidence": (views, keypoints),
        "points3d": (keypoints, 3),
        "times": (views,) if len(dataset.last_times or ()) > 1 else (),
    }
    arrays = []
    for name, dtype in DTYPES.items():
        if not any(name in layout for layout in layouts):
            continue
        parts: list[Part] = []
        for chunk, layout in zip(chunks, layouts, strict=True):
            if name in layout:
                parts.append(Span(chunk.key, *layout[name]))
            else:
                value = np.array(FILLED_IN[name], dtype)
                parts.append(Filling(value.tobytes(), chunk.frames * int(np.prod(shapes[name]))))
        frames = sum(chunk.frames for chunk in chunks)
        arrays.append(Array(name, dtype, (frames, *shapes[name]), parts))
    return arrays


def _of_description(dataset: Dataset) -> list[Array]:
    """Return what a dataset's file says besides its frames."""
    skeleton = dataset.skeleton or {}
    sizes = dataset.image_sizes and [size or UNKNOWN_SIZE for size in dataset.image_sizes]
    said = {
        "keypoint_names": skeleton.get("keypoint_names") or None,
        "edges": skeleton.get("edges") or None,
        "image_sizes": sizes or None,
        "view_names": dataset.view_names or None,
        "fps": dataset.fps,
    }
    arrays = []
    for name, value in said.items():
        if value is not None:
            array = np.asarray(value)
            array = array.astype(array.dtype.newbyteorder("<"))
            arrays.append(Array(name, array.dtype, array.shape, [array.tobytes()]))
    return arrays


# Objects are written once, so what was read of one holds for good.
@lru_cache(maxsize=100_000)
def _layout(objects: Objects, key: str) -> dict[str, tuple[int, int]]:
    """Return where the arrays of a chunk lie in its object, by name."""
    size = int.from_bytes(objects.get_range(key, 0, 8), "little")
    header = json.loads(objects.get_range(key, 8, 8 + size))
    return {
        name: (8 + size + about["data_offsets"][0], 8 + size + about["data_offsets"][1])
        for name, about in header.items()
        if name in DTYPES
    }


@lru_cache(maxsize=100_000)
def _checksum(objects: Objects, part: Part) -> int:
    """Return the CRC-32 of a part, having read it a piece at a time."""
    checksum = 0
    whole = LaidOutFile([part])
    for piece in whole.read(objects.get_range, 0, whole.size):
        checksum = zlib.crc32(piece, checksum)
    return checksum
