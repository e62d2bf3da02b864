"""The JSON form of the report on a fit."""

from datetime import datetime
from typing import Any, Literal

import orjson
from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

from models.findings.finding import Finding
from models.findings.verdict import Verdict, verdict_of
from models.settings.config import FitConfig
from service.wire.cameras import ModelCameras
from service.wire.findings import Findings
from service.wire.schemas import QualityReason, Vector2
from service.wire.skeletons import Edge
from store.records import FitRecord

UnitSource = TypeAliasType("UnitSource", Literal["known_length", "known_distance", "calibration"])
USELESS = ("known_distance_not_used", "cameras_not_found")  # with which a distance gives no unit


EXAMPLE: dict[str, Any] = {
    "fit_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
    "name": "macaque",
    "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
    "model_id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
    "version": "0.1.0",
    "finished_at": "2026-03-01T09:33:00Z",
    "verdict": {
        "level": "good",
        "code": None,
        "reliable": "Nothing was noticed that limits what may be relied on.",
        "remedy": "",
        "expected": "Points are expected within 1.9 % of the subject's size of where they are (root"
        " mean square).",
    },
    "unit": "known_length",
    "size": 0.58,
    "expected_error": 0.011,
    "of_keypoints": [0.009, 0.013],
    "of_frames": [0.01, None, 0.012],
    "quality": [0.97, 0.0, 0.41],
    "reasons": [None, "no_evidence", "views_disagree"],
    "noise_px": [[1.4, 2.1], [1.2, 2.6]],
    "scale_sd": 0.004,
    "worst_frames": [2],
    "of_views": [
        {"views": [0, 1], "expected_error": 0.011},
        {"views": [0], "expected_error": 0.19},
        {"views": [1], "expected_error": 0.21},
    ],
    "cameras": [
        {"azimuth_deg": 0.0, "elevation_deg": 12.0},
        {"azimuth_deg": 71.0, "elevation_deg": 9.0},
    ],
    "places": [
        {"direction": {"azimuth_deg": 270.0, "elevation_deg": 0.0}, "expected_error": 0.007}
    ],
    "best_place": {
        "direction": {"azimuth_deg": 270.0, "elevation_deg": 0.0},
        "expected_error": 0.007,
    },
    "drawn": [
        {
            "frame": 2,
            "views": [
                {"detected": [[512.0, 200.5], None], "answered": [[514.1, 203.2], [530.4, 261.0]]},
                {"detected": [[301.0, 190.0], [322.5, 251.0]], "answered": [None, None]},
            ],
        }
    ],
    "keypoint_names": ["head", "tail"],
    "edges": [[0, 1]],
    "view_names": ["left", "right"],
    "found_cameras": None,
    "views_late": None,
    "views_late_sd": None,
    "findings": [],
}


class CameraDirection(BaseModel):
    """A direction from the subject."""

    azimuth_deg: float = Field(
        description="About the mean up axis of the cameras, 0 towards the first, growing to its "
        "left as the subject sees it."
    )
    elevation_deg: float


class CameraPlace(BaseModel):
    """A place for one more camera, as far away as the others."""

    direction: CameraDirection
    expected_error: float = Field(description="With it.")


class ViewsWorth(BaseModel):
    """What some of the views are worth."""

    views: list[int]
    expected_error: float | None = Field(description="With these alone; null where none is known.")


class DrawnView(BaseModel):
    """Keypoints of a view, pixels."""

    detected: list[Vector2 | None] = Field(description="In step with the first view.")
    answered: list[Vector2 | None] = Field(description="Where the camera sees the answer.")


class DrawnFrame(BaseModel):
    """A frame in all views."""

    frame: int
    views: list[DrawnView]


class FitReport(BaseModel):
    """What a fit may be relied on for. Errors and `size` are in the unit of its structures."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE})

    fit_id: str
    name: str
    dataset_id: str
    model_id: str | None
    version: str | None = Field(description="Of Fewview that made the fit.")
    finished_at: datetime | None
    verdict: Verdict
    unit: UnitSource | None = Field(
        description="What gives lengths their unit; null if nothing does, and only shares of "
        "`size` mean anything."
    )
    size: float | None = Field(description="The subject's height, about.")
    expected_error: float | None = Field(
        description="Root mean square over points; null where it is not known, as in weak "
        "perspective."
    )
    of_keypoints: list[float | None] = Field(description="Expected error of each keypoint.")
    of_frames: list[float | None] = Field(description="Expected error of each frame.")
    quality: list[float | None] = Field(description="Of each frame, 0 to 1.")
    reasons: list[QualityReason | None] = Field(description="Why it is below 0.5.")
    noise_px: list[list[float | None]] | None = Field(
        description="Views x keypoints: standard deviation of a detection's coordinate, pixels."
    )
    scale_sd: float | None = Field(
        None,
        description="Share by which all lengths may be off together, as standard deviation: of the "
        "median over frames by which the known length gives their unit. Null without one, and for "
        "fits of older versions.",
    )
    worst_frames: list[int] = Field(description="The least reliable first.")
    of_views: list[ViewsWorth] = Field(description="Choices of views, the best first.")
    cameras: list[CameraDirection] = Field(
        description="Where the views' cameras are; none unless all are of one static rig."
    )
    places: list[CameraPlace] = Field(description="For one more camera; none where they move.")
    best_place: CameraPlace | None
    drawn: list[DrawnFrame] = Field(description="The worst frames, or as many as is sensible.")
    keypoint_names: list[str] | None
    edges: list[Edge] | None
    view_names: list[str] | None
    found_cameras: ModelCameras | None = Field(description="Null if the model was deleted.")
    views_late: list[float] | None = Field(
        description="By how many seconds each view is late, by the median; null where all are in "
        "step, or nothing is known of when."
    )
    views_late_sd: list[float | None] | None = Field(
        description="Their standard deviations; null for views that are in step."
    )
    findings: Findings


def report_on(
    fit: FitRecord,
    stored: bytes,
    *,
    skeleton: dict[str, Any],
    view_names: list[str] | None,
    cameras: ModelCameras | None,
    views_late: list[float] | None,
) -> FitReport:
    """Return the report on a fit, of what it stored and what is known of it besides."""
    found = [Finding.model_validate(each) for each in fit.findings or []]
    return FitReport.model_validate(
        orjson.loads(stored)
        | {
            "fit_id": fit.id,
            "name": fit.name,
            "dataset_id": fit.dataset_id,
            "model_id": fit.model_id,
            "version": fit.version,
            "finished_at": fit.finished_at,
            "verdict": verdict_of(found, fit.report_words),
            "unit": _unit_of(FitConfig.model_validate(fit.config), found),
            "keypoint_names": skeleton.get("keypoint_names"),
            "edges": skeleton.get("edges"),
            "view_names": view_names,
            "found_cameras": cameras,
            "views_late": views_late,
            "views_late_sd": _late_sds(views_late, found),
            "findings": found,
        }
    )


def _late_sds(views_late: list[float] | None, findings: list[Finding]) -> list[float | None] | None:
    """Return how many seconds the delay of each view may be off; None for views in step.

    Findings count in frames, and have one of their numbers in seconds, too.
    """
    if views_late is None:
        return None
    found: list[float | None] = [None] * len(views_late)
    for finding in findings:
        numbers = finding.evidence
        frames, seconds = numbers.get("offset_frames"), numbers.get("offset_seconds")
        if finding.code == "views_out_of_step" and frames and seconds and "sd_frames" in numbers:
            found[finding.views[0]] = numbers["sd_frames"] * seconds / frames
    return found


def _unit_of(config: FitConfig, findings: list[Finding]) -> UnitSource | None:
    codes = {finding.code for finding in findings}
    if config.known_length is not None:
        return "known_length"
    if config.known_distance is not None and not codes & set(USELESS):
        return "known_distance"
    posed = [camera for camera in config.calibration or () if camera and camera.translation]
    return "calibration" if len(posed) > 1 else None
