"""DeepLabCut: a table for each view, as CSV and H5, in the folder of the view's images.

`CollectedData_SCORER` are labels; `machinelabels` are those of a network, with likelihoods, which
DeepLabCut's GUI shows for refining.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fewview.writers.labels.form import FOLDER, Labels, ViewLabels
from fewview.writers.labels.pandas_h5 import write_frame
from fewview.writers.labels.tables import write_table

LEVELS = ("scorer", "bodyparts", "coords")
ITERATION = 0  # of a project that was trained once


def write_collected(folder: Path, labels: Labels) -> list[Path]:
    """Write labels as DeepLabCut's projects have them."""
    name = f"CollectedData_{labels.scorer}"
    return _write(folder, labels, f"{name}.csv", f"{name}.h5", likelihood=False)


def write_machine(folder: Path, labels: Labels) -> list[Path]:
    """Write labels as of a network: the weight is the likelihood."""
    return _write(
        folder, labels, "machinelabels.csv", f"machinelabels-iter{ITERATION}.h5", likelihood=True
    )


def _write(folder: Path, labels: Labels, table: str, frame: str, *, likelihood: bool) -> list[Path]:
    coordinates = ("x", "y", "likelihood")[: 3 if likelihood else 2]
    columns = [(labels.scorer, name, c) for name in labels.keypoint_names for c in coordinates]
    files = []
    for view, place in zip(labels.views, labels.folders, strict=True):
        if not len(view.frames):
            continue
        target = folder / FOLDER / place
        target.mkdir(parents=True, exist_ok=True)
        rows = [labels.image(place, number) for number in view.frames.tolist()]
        values = _values(view, likelihood=likelihood)
        files += [target / table, target / frame]
        write_table(target / table, LEVELS, columns, rows, values)
        write_frame(target / frame, LEVELS, columns, rows, values)
    return files


def _values(view: ViewLabels, *, likelihood: bool) -> NDArray[np.float64]:
    """Return the numbers (M, C) of a view's table."""
    parts = [view.keypoints, view.weights[..., None]] if likelihood else [view.keypoints]
    return np.concatenate(parts, axis=-1).reshape(len(view.frames), -1)
