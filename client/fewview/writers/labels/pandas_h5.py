"""A table as `DataFrame.to_hdf` of pandas writes it (`format="fixed"`), without pandas.

Rows and columns have labels of several levels. Attributes are those that pandas and PyTables read.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

KEY = "df_with_missing"  # where DeepLabCut looks


def write_frame(
    file: Path,
    levels: Sequence[str],
    columns: Sequence[tuple[str, ...]],
    rows: Sequence[tuple[str, ...]] | NDArray[np.int64],
    values: NDArray[np.float64],
) -> None:
    """Write values (N, C); parameters are those of :func:`.tables.write_table`.

    `rows` may also be N numbers.
    """
    import h5py  # noqa: PLC0415 (heavy)

    with h5py.File(file, "w") as whole:
        _describe(whole, "GROUP", "1.0", PYTABLES_FORMAT_VERSION="2.1")
        group = whole.create_group(KEY)
        _describe(
            group,
            "GROUP",
            "1.0",
            pandas_type="frame",
            pandas_version="0.15.2",
            encoding="UTF-8",
            errors="strict",
            ndim=2,
            nblocks=1,
        )
        _write_axis(group, "axis0", columns, levels)
        if isinstance(rows, np.ndarray):
            _write_attributes(group, {"axis1_variety": "regular"})
            _write_array(group, "axis1", rows, kind="integer", name="N.")
        else:
            _write_axis(group, "axis1", rows, [None] * len(rows[0]))
        _write_axis(group, "block0_items", columns, levels)
        _write_array(group, "block0_values", values, transposed=1)


def _write_axis(
    group: Any, name: str, labels: Sequence[tuple[str, ...]], levels: Sequence[str | None]
) -> None:
    """Write the labels of rows or columns: for each level its words, and the place of each."""
    _write_attributes(group, {f"{name}_variety": "multi", f"{name}_nlevels": len(levels)})
    for index, (level, own) in enumerate(zip(levels, zip(*labels, strict=True), strict=True)):
        words = {word: place for place, word in enumerate(dict.fromkeys(own))}
        encoded = np.array([word.encode() for word in words])
        named = {} if level is None else {"name": level}
        _write_array(group, f"{name}_level{index}", encoded, kind="string", **named)
        codes = np.array([words[word] for word in own], np.int64)
        _write_array(group, f"{name}_label{index}", codes)


def _write_array(group: Any, name: str, values: NDArray[Any], /, **attributes: str | int) -> None:
    array = group.create_dataset(name, data=values, track_times=False)
    _describe(array, "ARRAY", "2.4", FLAVOR="numpy", **attributes)


def _describe(node: Any, kind: str, version: str, /, **attributes: str | int) -> None:
    _write_attributes(node, {"CLASS": kind, "TITLE": "", "VERSION": version, **attributes})


def _write_attributes(node: Any, attributes: dict[str, str | int]) -> None:
    """Write attributes, texts as PyTables does: UTF-8 of fixed length."""
    import h5py  # noqa: PLC0415 (heavy)

    for name, value in attributes.items():
        if isinstance(value, str):
            kind = h5py.string_dtype("utf-8", max(len(value.encode()), 1))
            node.attrs.create(name, value.encode(), dtype=kind)
        else:
            node.attrs.create(name, value)
