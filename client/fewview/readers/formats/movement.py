"""movement's netCDF: a file for each camera, or one with a dimension of the cameras.

`position` (time, space, keypoint, individual) and `confidence`. NetCDF 4 is HDF5; what its axes
are shows in their sizes, in the order in which movement has them, with `view` or `camera` first.

Source: movement's documentation, "The movement datasets", and files that it writes.
"""

from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers import hdf5
from fewview.readers.sources import Source
from fewview.readers.views import View

NAMES = {  # of axes; older versions have the plural
    "space": ("space",),
    "keypoint": ("keypoint", "keypoints"),
    "individual": ("individual", "individuals"),
    "view": ("view", "views", "camera", "cameras"),
}
ORDER = ("time", "space", "keypoint", "individual")
AXES = ("time", "individual", "keypoint", "space")  # of what is read
Array = NDArray[Any]


def fits(source: Source) -> bool:
    """Whether this has movement's variables."""
    return {"position", "time", "space"} <= source.hdf5.keys()


def read(source: Source) -> list[View]:
    """Return the views of a file.

    Raises
    ------
    FormatError
        If it holds 3D points, or boxes, or arrays that do not fit its coordinates.
    """
    what = str(source)
    with hdf5.opened(source.path) as file:
        there = {axis: next(filter(file.__contains__, names), "") for axis, names in NAMES.items()}
        if "shape" in file or not there["keypoint"]:
            raise FormatError(
                "boxes of movement, without keypoints; give a dataset of poses", place=source
            )
        named = {
            axis: [hdf5.text(each) for each in hdf5.values(file[name], what).ravel()]
            for axis, name in there.items()
            if name
        }
        times = hdf5.values(file["time"], what).astype(np.float64).ravel()
        if sorted(named["space"]) != ["x", "y"]:
            raise FormatError(
                f"its points have {', '.join(named['space'])}; give the 2D poses of each camera",
                place=source,
            )
        views = "view" if "view" in named else ""
        sizes = {name: len(each) for name, each in named.items()} | {"time": len(times)}
        place = _laid_out(hdf5.values(file["position"], what), sizes, views, ORDER, what)
        sure = None
        if "confidence" in file:
            order = tuple(name for name in ORDER if name != "space")
            sure = hdf5.values(file["confidence"], what)
            if sure.ndim == file["position"].ndim - 2:  # of each individual
                sure = np.repeat(sure[..., None, :], sizes["keypoint"], axis=-2)
            sure = _laid_out(sure, sizes, views, order, what)
        fps = float(np.ravel(file.attrs.get("fps", 0))[0])
        seconds = hdf5.text(file.attrs.get("time_unit", "")) == "seconds"
    place = place[..., [named["space"].index(axis) for axis in "xy"]].astype(np.float32)
    people = named.get("individual", [""])
    numbers = np.arange(len(times))
    if not seconds and (np.diff(times) > 0).all() and (times == np.rint(times)).all():
        numbers = times.astype(np.int64)
    return [
        View(
            name if views else source.name,
            place[index],
            numbers,
            None if sure is None else sure[index].astype(np.float32),
            people=tuple(people) if len(set(people)) == len(people) else None,
            keypoint_names=tuple(named["keypoint"]),
            times=times if seconds and np.isfinite(times).all() else None,
            fps=fps if 0 < fps < np.inf else None,
        )
        for index, name in enumerate(named[views] if views else [source.name])
    ]


def _laid_out(
    values: Array, sizes: dict[str, int], views: str, order: tuple[str, ...], what: str
) -> Array:
    """Return an array with its axes as (views, time, individuals, keypoints, space).

    Raises
    ------
    FormatError
        If its shape is not that of the coordinates.
    """
    there = tuple(name for name in order if name in sizes or values.ndim > len(sizes))
    possible = [tuple(filter(None, (views, *there)))]
    if views:
        possible += [(*there, views), (there[0], views, *there[1:])]
    for axes in possible:
        if values.shape == tuple(sizes.get(name, 1) for name in axes):
            wanted = [name for name in chain([views], AXES) if name in axes]
            values = values.transpose([axes.index(name) for name in wanted])
            if not views:
                values = values[None]
            return values if "individual" in axes else np.expand_dims(values, 2)
    raise FormatError(
        f"an array {values.shape} that does not fit its coordinates, "
        + ", ".join(f"{name} {size}" for name, size in sizes.items()),
        place=what,
    )
