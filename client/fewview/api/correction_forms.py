"""Corrections of keypoints, as frozen dataclasses."""

from dataclasses import dataclass

from fewview.corrections import Correction


@dataclass(frozen=True)
class CorrectionsState:
    """Which corrections there are: how many, and a checksum, None without any."""

    count: int
    checksum: str | None


NOT_CORRECTED = CorrectionsState(0, None)


@dataclass(frozen=True)
class DatasetCorrections(CorrectionsState):
    """All corrections of a dataset, by frame, view and keypoint, which are indices."""

    items: tuple[Correction, ...]
