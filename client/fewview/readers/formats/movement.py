"""movement's netCDF: a file for each camera, or one with a dimension of the cameras.

`position` (time, space, keypoint, individual) and `confidence`, with their axes in any order. An
axis of another name is that of the cameras. NetCDF 4 is HDF5, and numbers its axes in attributes;
references to them, which HDF5 has too, are not followed, as broken ones end the process.

Source: movement's documentation, "The movement datasets", files that it writes, and the CF
conventions on packed data and missing values.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers import hdf5
from fewview.readers.sources import Source
from fewview.readers.views import View

NAMES = {  # of axes; older versions have the plural
    "time": ("time",),
    "space": ("space",),
    "keypoint": ("keypoint", "keypoints"),
    "individual": ("individual", "individuals"),
}
VIEW = "view"  # the axis that is none of these
AXES = (VIEW, "time", "individual", "keypoint", "space")  # of what is read
USUAL = (VIEW, "time", "space", "keypoint", "individual")  # order, where axes have no numbers
SCALE = "DIMENSION_SCALE"
_AXIS_OF = {name: axis for axis, names in NAMES.items() for name in names}
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
        if "shape" in file or not any(name in file for name in NAMES["keypoint"]):
            raise FormatError(
                "boxes of movement, without keypoints; give a dataset of poses", place=source
            )
        place, called = _laid_out(file, "position", what)
        named = {
            axis: [hdf5.text(each) for each in np.ravel(hdf5.values(file[name], what))]
            for axis, name in called.items()
            if axis != "time" and name in file
        }
        times = np.ravel(hdf5.values(file["time"], what)).astype(np.float64)
        space = named.get("space", [])
        if sorted(space) != ["x", "y"]:
            raise FormatError(
                f"its points have {', '.join(space)}; give the 2D poses of each camera",
                place=source,
            )
        sure = _laid_out(file, "confidence", what)[0] if "confidence" in file else None
        fps = float(np.ravel(file.attrs.get("fps", 0))[0])
        seconds = hdf5.text(file.attrs.get("time_unit", "")) == "seconds"
    if sure is not None and sure.shape[3] == 1:  # of each individual
        sure = np.repeat(sure, place.shape[3], axis=3)
    sizes = (len(times), len(named.get("keypoint", ())), place.shape[:4])
    if sizes != (place.shape[1], place.shape[3], (sure if sure is not None else place).shape[:4]):
        raise FormatError(
            f"positions {place.shape} of views, times, individuals, keypoints, space do not fit "
            "its coordinates and confidences",
            place=source,
        )
    place = place[..., [space.index(axis) for axis in "xy"]].astype(np.float32)
    people = named.get("individual", [""])
    numbers = np.arange(len(times))
    if not seconds and (np.diff(times) > 0).all() and (times == np.rint(times)).all():
        numbers = times.astype(np.int64)
    views = named.get(VIEW) or [""] * len(place)
    return [
        View(
            name or source.name,
            place[index],
            numbers,
            None if sure is None else sure[index, ..., 0].astype(np.float32),
            people=tuple(people) if len(set(people)) == len(people) else None,
            keypoint_names=tuple(named["keypoint"]),
            times=times if seconds and np.isfinite(times).all() else None,
            fps=fps if 0 < fps < np.inf else None,
        )
        for index, name in enumerate(views)
    ]


def _laid_out(file: Any, variable: str, what: str) -> tuple[Array, dict[str, str]]:
    """Return an array with all of `AXES`, unpacked, and what the file calls those that it has.

    Raises
    ------
    FormatError
        If its axes have no names, or are of more kinds.
    """
    values = hdf5.values(file[variable], what)
    called = _axes(file, variable)
    axes = [_AXIS_OF.get(name, VIEW) for name in called]
    if len(called) != values.ndim or len(set(axes)) < len(axes):
        raise FormatError(
            f"{variable} {values.shape} has the axes {', '.join(called) or 'without names'}; "
            f"give {', '.join(AXES[1:])}, and one of the cameras at most",
            place=what,
        )
    order = [axes.index(axis) for axis in AXES if axis in axes]
    absent = tuple(place for place, axis in enumerate(AXES) if axis not in axes)
    unpacked = _unpacked(values, file[variable].attrs)
    return np.expand_dims(unpacked.transpose(order), absent), dict(zip(axes, called, strict=True))


def _axes(file: Any, variable: str) -> list[str]:
    """Return the names of an array's axes; none if the file does not have them."""
    scales = [name for name in file if hdf5.text(file[name].attrs.get("CLASS")) == SCALE]
    given = file[variable].attrs.get("_Netcdf4Coordinates")
    if given is not None:
        number = {int(file[name].attrs.get("_Netcdf4Dimid", -1)): name for name in scales}
        return [number.get(each, "") for each in np.ravel(given).tolist()]
    usual = sorted(scales, key=lambda name: USUAL.index(_AXIS_OF.get(name, VIEW)))
    for absent in ((), NAMES["space"], NAMES["space"] + NAMES["keypoint"]):
        there = [name for name in usual if name not in absent]
        if file[variable].shape == tuple(len(file[name]) for name in there):
            return there
    return []


def _unpacked(values: Array, attributes: Any) -> Array:
    """Return what packed numbers (CF conventions) stand for, NaN where there is none."""
    given = {
        name: float(np.ravel(attributes[name])[0])
        for name in ("_FillValue", "missing_value", "scale_factor", "add_offset")
        if name in attributes
    }
    none = [given[name] for name in ("_FillValue", "missing_value") if name in given]
    scale, offset = given.get("scale_factor", 1.0), given.get("add_offset", 0.0)
    unpacked: Array = np.where(np.isin(values, none), np.nan, values * scale + offset)
    return unpacked
