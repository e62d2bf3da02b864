"""Tables that pandas wrote into HDF5, both layouts, without pandas and without PyTables."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers import hdf5, pickles
from fewview.readers.sources import Source
from fewview.readers.views import bounded

Table = tuple[list[tuple[str, ...]], list[str], NDArray[np.float64], list[Any]]


def read_table(source: Source) -> Table:
    """Return the first table that pandas wrote into a file.

    Returns
    -------
    tuple
        The labels of the C columns, the names of the levels of these, values (N, C), and what
        names the rows.

    Raises
    ------
    FormatError
        If there is none, or it cannot be read.
    """
    name = next((name for name, of_pandas in source.hdf5.items() if of_pandas), None)
    if name is None:
        raise FormatError("holds no table of pandas", place=source)
    try:
        with hdf5.opened(source.path) as file:
            group = file[name]
            if "table" in group:
                return _appendable(group["table"], group, str(source))
            return _fixed(group, str(source))
    except (OSError, KeyError, IndexError, ValueError, RuntimeError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(
            f"a table of pandas that cannot be read ({error})", place=source
        ) from error


def _fixed(group: Any, what: str) -> Table:
    """Read the layout ``format="fixed"``: blocks of columns, their labels as levels and codes."""
    columns, levels = _axis(group, "axis0", what)
    rows, _ = _axis(group, "axis1", what)
    bounded((len(rows), len(columns)), what)
    place = {label: index for index, label in enumerate(columns)}
    values = np.full((len(rows), len(columns)), np.nan)
    for block in range(int(group.attrs.get("nblocks", 0))):
        items, _ = _axis(group, f"block{block}_items", what)
        data = group[f"block{block}_values"]
        if data.dtype.kind in "fiub" and "shape" not in data.attrs:
            numbers = hdf5.values(data, what)
            if not data.attrs.get("transposed", 0):
                numbers = numbers.T
            values[:, [place[item] for item in items]] = numbers
    return columns, levels, values, [row if len(row) > 1 else row[0] for row in rows]


def _axis(group: Any, name: str, what: str) -> tuple[list[tuple[Any, ...]], list[str]]:
    """Return the labels of an axis, a tuple each, and the names of its levels."""
    if f"{name}_level0" not in group:
        return [(value,) for value in _values(group[name], what)], [_level_name(group[name])]
    columns, names = [], []
    count = int(group.attrs[f"{name}_nlevels"])
    for level in range(count):
        values = _values(group[f"{name}_level{level}"], what)
        codes = hdf5.values(group[f"{name}_label{level}"], what)
        columns.append(["" if code < 0 else values[code] for code in codes])
        names.append(_level_name(group[f"{name}_level{level}"]))
    return list(zip(*columns, strict=True)), names


def _level_name(dataset: Any) -> str:
    name = dataset.attrs.get("name", b"")
    text = name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name)
    return "" if text == "N." else text


def _values(dataset: Any, what: str) -> list[Any]:
    """Return an array's values; a pickle of PyTables is read without running it."""
    if str(dataset.attrs.get("CLASS", b""), "ascii", "replace") == "VLARRAY":
        return list(pickles.load(bytes(dataset[0]), what).tolist())
    values = hdf5.values(dataset, what).tolist()
    return [
        value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in values
    ]


def _appendable(table: Any, group: Any, what: str) -> Table:
    """Read the layout ``format="table"``: one compound, labels as a pickle in an attribute."""
    bounded((len(table), sum(math.prod(table.dtype[n].shape) for n in table.dtype.names)), what)
    rows = hdf5.values(table, what)
    columns: list[Any] = []
    parts = []
    for name in table.dtype.names:
        if f"{name}_kind" in table.attrs and name.startswith("values_block_"):
            columns += pickles.load(bytes(table.attrs[f"{name}_kind"]), what)
            parts.append(rows[name].reshape(len(rows), -1).astype(np.float64))
    labels = [
        tuple(map(str, label)) if isinstance(label, tuple) else (str(label),) for label in columns
    ]
    levels: list[str] = []
    info = pickles.load(bytes(group.attrs["info"]), what) if "info" in group.attrs else {}
    for entry in info.values() if isinstance(info, dict) else ():
        if isinstance(entry, dict) and isinstance(entry.get("names"), list):
            levels = [str(name) for name in entry["names"]]
    order = _order(group, labels, what)
    values = np.concatenate(parts, axis=1) if parts else np.empty((len(rows), 0))
    index = rows["index"].tolist() if "index" in table.dtype.names else list(range(len(rows)))
    return [labels[i] for i in order], levels, values[:, order], index


def _order(group: Any, labels: list[tuple[str, ...]], what: str) -> list[int]:
    """Return the order of the columns as they were: blocks of several types part them."""
    axes = pickles.load(bytes(group.attrs["non_index_axes"]), what)
    place = {label: index for index, label in enumerate(labels)}
    asked = [tuple(map(str, x)) if isinstance(x, tuple) else (str(x),) for x in axes[0][1]]
    return [place[label] for label in asked if label in place]
