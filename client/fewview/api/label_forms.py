"""Images that are worth labelling, as frozen dataclasses."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class LabelReason:
    """Why an image is worth labelling; no keypoints mean all of them."""

    code: str
    keypoints: tuple[int, ...]
    evidence: dict[str, float]


@dataclass(frozen=True)
class ImageWorthLabelling:
    """A frame of a view that a human should look at.

    Attributes
    ----------
    frame
        Of the view's own film, counted from 0; it shows the frame ``moment`` of the reconstruction.
    score
        How many keypoints the detector probably got wrong or missed there, and one more for a pose
        unlike all others.
    """

    view: int
    view_name: str
    frame: int
    moment: int | None
    score: float
    reasons: tuple[LabelReason, ...]


@dataclass(frozen=True)
class FitLabels:
    """The images of a fit that would teach a detector most, best first.

    Attributes
    ----------
    candidates
        How many are worth labelling, with all that are like those listed.
    noise_px
        Standard deviation of detections about the fit in each view, pixels.
    """

    fit_id: str
    dataset_id: str
    images: tuple[ImageWorthLabelling, ...]
    candidates: int
    noise_px: tuple[float | None, ...]
    raw: dict[str, Any] = field(repr=False, compare=False)
