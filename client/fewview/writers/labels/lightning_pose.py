"""Lightning Pose: a CSV file for each view, whose rows are named by the paths of images.

In all views the rows are those of the same moments, as training with several views needs them.
"""

from pathlib import Path

from fewview.writers.labels.deeplabcut import LEVELS
from fewview.writers.labels.form import Labels
from fewview.writers.labels.tables import write_table


def write(folder: Path, labels: Labels) -> list[Path]:
    """Write the labels of each view that has some."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = [(labels.scorer, name, axis) for name in labels.keypoint_names for axis in "xy"]
    files = []
    for view, place in zip(labels.views, labels.folders, strict=True):
        if len(view.frames):
            rows = [("/".join(labels.image(place, number)),) for number in view.frames.tolist()]
            files.append(folder / f"CollectedData_{place}.csv")
            values = view.keypoints.reshape(len(rows), -1)
            write_table(files[-1], LEVELS, columns, rows, values)
    return files
