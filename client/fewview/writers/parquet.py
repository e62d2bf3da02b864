"""Parquet: the tidy table (frame, time, keypoint, x, y, z, sd), null where a number is unknown.

Unit and edges stand in the metadata of the schema, as JSON under `fewview`.
"""

import json
from pathlib import Path

import numpy as np

from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.numbers import columns_of


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a table.

    Raises
    ------
    FormatError
        If pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: PLC0415  # an extra
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise FormatError(
            "Parquet needs pyarrow, which is not installed: pip install 'fewview[parquet]'"
        ) from error
    frames, count = animation.points.shape[:2]
    columns = {"frame": pyarrow.array(np.repeat(np.array(animation.frames, np.int64), count))}
    if animation.times is not None or animation.fps is not None:
        columns["time"] = pyarrow.array(np.repeat(animation.seconds, count))
    places = pyarrow.array(np.tile(np.arange(count, dtype=np.int32), frames))
    columns["keypoint"] = pyarrow.DictionaryArray.from_arrays(places, list(animation.names))
    for name, values in columns_of(animation).items():
        columns[name] = pyarrow.array(values.ravel(), mask=np.isnan(values).ravel())
    metadata = json.dumps({"unit": animation.unit, "fps": animation.fps, "edges": animation.edges})
    table = pyarrow.table(columns).replace_schema_metadata({"fewview": metadata})
    parquet.write_table(table, path)
