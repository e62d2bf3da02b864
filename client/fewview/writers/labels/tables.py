"""Tables under rows of scorers, body parts and coordinates, as DeepLabCut has them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fewview.plain import TableWriter
from fewview.writers.numbers import texts


def write_table(
    file: Path,
    levels: Sequence[str],
    columns: Sequence[tuple[str, ...]],
    rows: Sequence[tuple[str, ...]],
    values: NDArray[np.float64],
) -> None:
    """Write values (N, C), empty for NaN.

    Parameters
    ----------
    levels, columns
        The names of the rows above the table, and the label of each column in them.
    rows
        What names each row, in one cell or several.
    """
    blank = [""] * (len(rows[0]) - 1) if rows else []
    with file.open("w", newline="", encoding="utf-8") as stream:
        lines = TableWriter(stream)
        for level, labels in zip(levels, zip(*columns, strict=True), strict=True):
            lines.writerow([level, *blank, *labels])
        for row, numbers in zip(rows, values, strict=True):
            lines.writerow([*row, *texts(numbers)])
