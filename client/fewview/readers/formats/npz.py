"""Fewview's own npz: `keypoints` of all views, and what else is known of them."""

import math
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers.budget import take
from fewview.readers.npy import read_header
from fewview.readers.sources import ZIP, Source
from fewview.readers.views import View, bounded

KNOWN = (
    "keypoints",
    "confidence",
    "points3d",
    "times",
    "fps",
    "keypoint_names",
    "edges",
    "image_sizes",
    "view_names",
    "frame_numbers",
)
Arrays = dict[str, NDArray[Any]]


def fits(source: Source) -> bool:
    """Whether this is a zip file with `keypoints.npy` in it."""
    if not source.begins(ZIP):
        return False
    try:
        with zipfile.ZipFile(source.path) as file:
            return "keypoints.npy" in file.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def read(source: Source) -> list[View]:
    """Return the views of a file.

    Raises
    ------
    FormatError
        If an array cannot be read, or does not fit the others.
    """
    arrays = _arrays(source)
    keypoints = arrays["keypoints"]
    if keypoints.dtype.kind not in "fiu" or keypoints.ndim != 4 or keypoints.shape[-1] != 2:
        raise FormatError(
            f"`keypoints` is {keypoints.dtype} of shape {keypoints.shape}, not numbers "
            "(frames, views, keypoints, 2)",
            place=source,
        )
    n, k, p, _ = keypoints.shape
    _check(source, arrays, n, k, p)
    times = arrays["times"].astype(np.float64) if "times" in arrays else None
    sizes, names = arrays.get("image_sizes"), arrays.get("keypoint_names")
    views, confidence, truth = (
        arrays.get("view_names"),
        arrays.get("confidence"),
        arrays.get("points3d"),
    )
    return [
        View(
            source.name
            if views is None and k == 1
            else f"view {v + 1}"
            if views is None
            else str(views[v]),
            keypoints[:, v, None].astype(np.float32),
            arrays.get("frame_numbers", np.arange(n)).astype(np.int64),
            None if confidence is None else confidence[:, v, None].astype(np.float32),
            people=("",),
            keypoint_names=None if names is None else tuple(map(str, names)),
            edges=_edges(arrays),
            # An array cannot leave out the size of one view: 0 is unknown.
            image_size=(int(sizes[v, 0]), int(sizes[v, 1]))
            if sizes is not None and sizes[v].all()
            else None,
            times=None if times is None else times if times.ndim == 1 else times[:, v],
            fps=float(arrays["fps"].reshape(-1)[0]) if "fps" in arrays else None,
            points3d=None if truth is None else truth.astype(np.float32),
            pixels_from_zero=True,
        )
        for v in range(k)
    ]


def _arrays(source: Source) -> Arrays:
    """Read what is known; sizes are looked at first, and nothing is ever unpickled."""
    found: Arrays = {}
    try:
        with zipfile.ZipFile(source.path) as file:
            for name in (name for name in KNOWN if f"{name}.npy" in file.namelist()):
                with file.open(f"{name}.npy") as member:
                    header = read_header(name, member)
                    bounded([math.prod(header.shape)], f"{source}: `{name}`")
                    take(math.prod(header.shape) * header.dtype.itemsize, source)
                with file.open(f"{name}.npy") as member:
                    found[name] = np.lib.format.read_array(member, allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"an npz file that cannot be read ({error})", place=source) from error
    return found


def _check(source: Source, arrays: Arrays, n: int, k: int, p: int) -> None:
    for name, kinds, shapes in (
        ("confidence", "fiub", [(n, k, p)]),
        ("points3d", "fiu", [(n, p, 3)]),
        ("times", "fiu", [(n,), (n, k)]),
        ("fps", "fiu", [(), (1,)]),
        ("keypoint_names", "U", [(p,)]),
        ("view_names", "U", [(k,)]),
        ("frame_numbers", "iu", [(n,)]),
        ("image_sizes", "fiu", [(k, 2)]),
    ):
        if name in arrays:
            array = arrays[name]
            if array.dtype.kind not in kinds or array.shape not in shapes:
                raise FormatError(
                    f"`{name}` is {array.dtype} of shape {array.shape}; {n} frames, {k} "
                    f"views and {p} keypoints ask for {' or '.join(map(str, shapes))}",
                    place=source,
                )
    numbers = arrays.get("frame_numbers")
    if numbers is not None and np.any(np.diff(numbers.astype(np.int64)) <= 0):
        raise FormatError("`frame_numbers` must rise from frame to frame", place=source)


def _edges(arrays: Arrays) -> tuple[tuple[int, int], ...] | None:
    edges = arrays.get("edges")
    if edges is None or edges.dtype.kind not in "iu" or edges.ndim != 2 or edges.shape[1] != 2:
        return None
    return tuple((int(a), int(b)) for a, b in edges)
