"""Bodies of requests to lift or to compare.

They stand apart from what lifts and compares, which takes long to import: processes that only read
bodies do without it.
"""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

from models.settings.calibration import Camera as ToldCamera
from models.settings.config import Index, Refine
from models.settings.keypoints import MAX_VIEWS
from models.settings.rooms import FrameOfReference, Up
from models.settings.uncertainty import Uncertainty
from service.wire.rooms import FRAME_OF_REFERENCE, UP
from service.wire.schemas import (
    CONFIDENCE,
    KEYPOINTS,
    POINTS3D,
    REFINE,
    TIMES,
    UNCERTAINTY,
    VIEWS,
    Name,
)
from store.labels import Labels, Text

TriangulationCameras = TypeAliasType("TriangulationCameras", Literal["found", "calibration"])


class LiftRequest(BaseModel):
    """Frames to lift."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "frames": [
                    [
                        [[512.0, 200.5], [530.0, 260.0], None, [498.0, 402.0]],
                        [[301.0, 190.0], [322.5, 251.0], [350.0, 330.0], [310.0, 399.0]],
                    ]
                ],
                "times": [12.48],
                "refine": "auto",
                "views": [0, 2],
            }
        },
    )

    model: Text = Field(max_length=200, description="The model's identifier, or an alias.")
    frames: KEYPOINTS
    confidence: CONFIDENCE = None
    times: TIMES = None
    refine: Refine | None = Field(None, description=REFINE)
    views: list[Index] | None = Field(None, max_length=MAX_VIEWS, description=VIEWS)
    frame: FrameOfReference | None = Field(None, description=FRAME_OF_REFERENCE)
    up: Up | None = Field(None, description=UP)
    uncertainty: Uncertainty | None = Field(None, description=f"{UNCERTAINTY} The default is `sd`.")


class LiftCreate(Labels):
    """A dataset to lift."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "model_id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "name": "macaque, the whole day",
                "refine": "auto",
            }
        },
    )

    model_id: Text = Field(max_length=200, description="The model's identifier, or an alias.")
    dataset_id: Text = Field(max_length=200, description="It has the keypoints of the model.")
    name: Name = "lift"
    refine: Refine | None = Field(None, description=REFINE)
    views: list[Index] | None = Field(None, max_length=MAX_VIEWS, description=VIEWS)
    frame: FrameOfReference = Field("canonical", description=FRAME_OF_REFERENCE)
    up: Up | None = Field(None, description=UP)
    uncertainty: Uncertainty = Field("sd", description=UNCERTAINTY)


class EvaluationCreate(BaseModel):
    """What to measure, and against what."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"fit_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c"}},
    )

    fit_id: Text | None = Field(
        None, max_length=200, description="A fit whose reconstruction is measured."
    )
    points: POINTS3D = None
    dataset_id: Text | None = Field(
        None,
        max_length=200,
        description="A dataset with a ground truth; without it that of the fit.",
    )
    truth: POINTS3D = None
    frame: FrameOfReference = Field(
        "canonical",
        description=f"Of the fit's structures. {FRAME_OF_REFERENCE} `mpjpe` is of use there alone.",
    )
    reach: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="Largest threshold of the PCK curve, in the unit of the truth; without it a "
        "third of the usual radius of a structure.",
    )
    mirrored_too: bool = Field(False, description="Forgive a mirror image of all frames.")
    calibration: list[ToldCamera | None] | None = Field(
        None,
        max_length=MAX_VIEWS,
        description="True cameras of the fit's views, as in a fit's configuration: complete "
        "lenses, and poses of static cameras.",
    )
    triangulate: TriangulationCameras | None = Field(
        None,
        description="Measure the keypoints of the dataset, triangulated, too: with the cameras "
        "that the fit `found`, or with the `calibration`.",
    )
