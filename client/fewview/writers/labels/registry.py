"""The one list of the formats that labels are written in."""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from fewview.errors import FormatError
from fewview.writers.labels.form import Labels


@dataclass(frozen=True)
class LabelFormat:
    """A format: its name, the module and the function that write it, and what it is."""

    name: str
    module: str
    function: str
    about: str


LABEL_FORMATS = (
    LabelFormat(
        "dlc",
        "deeplabcut",
        "write_collected",
        "DeepLabCut's labels: CollectedData_SCORER, as CSV and H5, for each view",
    ),
    LabelFormat(
        "dlc-machine",
        "deeplabcut",
        "write_machine",
        "DeepLabCut's machine labels, to be refined: the weight is the likelihood",
    ),
    LabelFormat("coco", "coco", "write", "COCO keypoints: labels.json of all views, with weights"),
    LabelFormat(
        "lightning-pose", "lightning_pose", "write", "Lightning Pose: a CSV file for each view"
    ),
)


def write_labels(folder: Path, labels: Labels, format: str) -> list[Path]:
    """Write labels into a folder; return the paths of the files.

    Raises
    ------
    FormatError
        If there is no such format.
    """
    for known in LABEL_FORMATS:
        if known.name == format:
            module = import_module(f"fewview.writers.labels.{known.module}")
            written: list[Path] = getattr(module, known.function)(folder, labels)
            return written
    listed = ", ".join(known.name for known in LABEL_FORMATS)
    raise FormatError(f"no format {format!r} of labels; there are: {listed}")
