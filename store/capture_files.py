"""A dataset's capture as an npz file, as `POST /datasets` takes it: laid out from its chunks."""

import json
import struct
import zlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import select

from store.array_files import Array, Filling, LaidOutFile, Part, Patched, Span, npz_file
from store.capture import ARRAYS, checksums_in
from store.corrections import Corrections, values_of
from store.database import Store
from store.errors import DamagedError
from store.lookup import lost
from store.objects import Objects
from store.records import Chunk, DatasetRecord

DTYPES: dict[str, np.dtype[Any]] = {name: np.dtype("<f4") for name in ARRAYS} | {
    "times": np.dtype("<f8")
}
FILLED_IN = {"confidence": 1.0, "points3d": np.nan}  # where only some chunks have them
UNKNOWN_SIZE = [0, 0]  # of images, which npz cannot leave out for one view
LONGEST_HEADER = 1024 * 1024  # bytes, of an object; ours take some hundred


class _Place(NamedTuple):
    """Where the bytes of an array lie in an object, and their CRC-32 if it is noted there."""

    start: int
    end: int
    checksum: int | None


def capture_file(store: Store, dataset: DatasetRecord, corrected: Corrections = ()) -> LaidOutFile:
    """Return the capture of a dataset as it is now, laid out as an npz file.

    Keypoints and their confidence have the corrections given, as `store.corrections.applied` makes
    them.

    Raises ``NotFoundError`` if the dataset was deleted since its record was read.
    """
    query = select(Chunk).where(Chunk.dataset_id == dataset.id).order_by(Chunk.first_frame)
    with store.reading() as session:
        chunks = list(session.scalars(query))
    try:
        return npz_file(
            [*_of_frames(store, dataset, chunks, corrected), *_of_description(dataset)],
            lambda _array, part: _checksum(store.objects, part),
        )
    except FileNotFoundError as error:
        raise lost(store, DatasetRecord, dataset.id, error) from error


def _of_frames(
    store: Store, dataset: DatasetRecord, chunks: Sequence[Chunk], corrected: Corrections
) -> list[Array]:
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
            part: Span | Filling
            if name in layout:
                part = Span(chunk.key, layout[name].start, layout[name].end)
            else:
                value = np.array(FILLED_IN[name], dtype)
                part = Filling(value.tobytes(), chunk.frames * int(np.prod(shapes[name])))
            patches = _patches(name, chunk, (views, keypoints), corrected)
            parts.append(Patched(part, patches) if patches else part)
        frames = sum(chunk.frames for chunk in chunks)
        arrays.append(Array(name, dtype, (frames, *shapes[name]), parts))
    return arrays


def _patches(
    name: str, chunk: Chunk, sides: tuple[int, int], corrected: Corrections
) -> tuple[tuple[int, bytes], ...]:
    """Return what corrections change of an array of (views, keypoints) in a chunk, by offset."""
    if name not in ("keypoints", "confidence"):
        return ()
    views, keypoints = sides
    patches = []
    for each in corrected:
        frame, view, keypoint = each.place
        frame -= chunk.first_frame
        if 0 <= frame < chunk.frames:
            pixels, trust = values_of(each)
            new = struct.pack("<2f", *pixels) if name == "keypoints" else struct.pack("<f", trust)
            patches.append((((frame * views + view) * keypoints + keypoint) * len(new), new))
    return tuple(sorted(patches))


def _of_description(dataset: DatasetRecord) -> list[Array]:
    """Return the arrays of a dataset's file besides its frames."""
    skeleton = dataset.skeleton or {}
    sizes = dataset.image_sizes and [size or UNKNOWN_SIZE for size in dataset.image_sizes]
    values = {
        "keypoint_names": skeleton.get("keypoint_names") or None,
        "edges": skeleton.get("edges") or None,
        "image_sizes": sizes or None,
        "view_names": dataset.view_names or None,
        "fps": dataset.fps,
    }
    arrays = []
    for name, value in values.items():
        if value is not None:
            array = np.asarray(value)
            array = array.astype(array.dtype.newbyteorder("<"))
            arrays.append(Array(name, array.dtype, array.shape, [array.tobytes()]))
    return arrays


# Objects are written once, so what was read of one holds for good.
@lru_cache(maxsize=100_000)
def _layout(objects: Objects, key: str) -> dict[str, _Place]:
    """Return where the arrays of a chunk lie in its object, by name."""
    try:
        size = int.from_bytes(objects.peek(key, 0, 8), "little")
        if size > LONGEST_HEADER:
            raise DamagedError(key)
        header = json.loads(objects.peek(key, 8, 8 + size))
        sums = checksums_in(header)
        return {
            name: _Place(8 + size + start, 8 + size + end, sums.get(name))
            for name, (start, end) in (
                (name, header[name]["data_offsets"]) for name in DTYPES if name in header
            )
        }
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DamagedError(key) from error


def _checksum(objects: Objects, part: Part) -> int:
    """Return the CRC-32 of a part."""
    if isinstance(part, Span):
        noted = {(p.start, p.end): p.checksum for p in _layout(objects, part.key).values()}
        if (known := noted.get((part.start, part.end))) is not None:
            return known
    return read_checksum(objects, part)


@lru_cache(maxsize=100_000)
def read_checksum(objects: Objects, part: Part) -> int:
    """Return the same of what an older version wrote, having read it a piece at a time."""
    checksum = 0
    whole = LaidOutFile([part])
    for piece in whole.read(objects.get_range, 0, whole.size):
        checksum = zlib.crc32(piece, checksum)
    return checksum
