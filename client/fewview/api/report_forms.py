"""The report on a fit, as frozen dataclasses."""

from dataclasses import dataclass, field
from typing import Any

from fewview.api.forms import Finding, Verdict


@dataclass(frozen=True)
class CameraDirection:
    """A direction from the subject, degrees: azimuth 0 is the first camera's, then to its left."""

    azimuth_deg: float
    elevation_deg: float


@dataclass(frozen=True)
class CameraPlace:
    """A place for one more camera, and the error to expect with it."""

    direction: CameraDirection
    expected_error: float


@dataclass(frozen=True)
class ViewsWorth:
    """The error to expect with some of the views alone; None where none is known."""

    views: tuple[int, ...]
    expected_error: float | None


@dataclass(frozen=True)
class FitReport:
    """What a fit may be relied on for. Errors are root mean squares; None is not known.

    Attributes
    ----------
    unit
        What gives ``size`` and errors their unit: ``known_length``, ``known_distance`` or
        ``calibration``. None if nothing does, and only shares of ``size`` mean anything.
    size
        The subject's height, about.
    of_keypoints, of_frames
        (P,) and (N,) expected errors.
    quality, reasons
        (N,) in [0, 1], and why it is below 0.5.
    noise_px
        (K, P) standard deviations of a detection's coordinate, pixels.
    worst_frames
        The least reliable first.
    of_views
        Choices of views, the best first.
    cameras
        (K,) where they are; none unless all are of one static rig.
    places, best_place
        For one more camera.
    """

    fit_id: str
    name: str
    verdict: Verdict
    unit: str | None
    size: float | None
    expected_error: float | None
    of_keypoints: tuple[float | None, ...]
    of_frames: tuple[float | None, ...]
    quality: tuple[float | None, ...]
    reasons: tuple[str | None, ...]
    noise_px: tuple[tuple[float | None, ...], ...] | None
    worst_frames: tuple[int, ...]
    of_views: tuple[ViewsWorth, ...]
    cameras: tuple[CameraDirection, ...]
    places: tuple[CameraPlace, ...]
    best_place: CameraPlace | None
    keypoint_names: tuple[str, ...] | None
    view_names: tuple[str, ...] | None
    findings: tuple[Finding, ...]
    raw: dict[str, Any] = field(repr=False, compare=False)
