"""movement's netCDF: `position` (time, space, keypoint, individual), `confidence`, and `sd`.

NetCDF 4 is HDF5 with scales of its dimensions, so it is written without a library of netCDF.

Source: movement's documentation, "The movement datasets"; the NetCDF-4 file format.
"""

from pathlib import Path
from typing import Any

import numpy as np

from fewview.animation import Animation
from fewview.writers.confidences import confidences_of

POINTS = ("time", "keypoint", "individual")


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a dataset of poses of one individual."""
    import h5py  # noqa: PLC0415 (heavy)

    text = h5py.string_dtype()
    timed = animation.times is not None or animation.fps is not None
    coordinates: dict[str, Any] = {
        "time": animation.seconds if timed else np.array(animation.frames, np.int64),
        "space": np.array(list("xyz"), text),
        "keypoint": np.array(animation.names, text),
        "individual": np.array(["subject"], text),
    }
    arrays = {
        "position": (np.swapaxes(animation.points, 1, 2)[..., None], tuple(coordinates)),
        "confidence": (confidences_of(animation)[..., None], POINTS),
    }
    if animation.points_sd is not None:
        arrays["sd"] = animation.points_sd[..., None], POINTS
    with h5py.File(path, "w") as file:
        file.attrs["ds_type"], file.attrs["source_software"] = "poses", "Fewview"
        file.attrs["time_unit"] = "seconds" if timed else "frames"
        if timed and animation.even:
            file.attrs["fps"] = animation.rate
        if animation.unit is not None:
            file.attrs["space_unit"] = animation.unit
        for name, values in coordinates.items():
            scale = file.create_dataset(name, data=values, track_times=False)
            scale.make_scale(name)
        for name, (values, axes) in arrays.items():
            made = file.create_dataset(name, data=values, track_times=False)
            for place, axis in enumerate(axes):
                made.dims[place].attach_scale(file[axis])
