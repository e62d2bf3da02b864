"""What a user may tell of the cameras and the subject, and need not. Imports no torch."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

LensName = Literal["pinhole", "fisheye"]  # a file each in `models.optics.lenses`
LiftedLensName = Literal["perspective", "fisheye"]  # the same lenses, as lifts and models call them
NUMBERS_OF_COEFFICIENTS: dict[LensName, tuple[int, ...]] = {
    "pinhole": (0, 1, 2, 4, 5, 8),
    "fisheye": (0, 4),
}
ORTHONORMAL = 1e-3  # largest deviation of R R^T from 1 that rounding explains

_STRICT = ConfigDict(frozen=True, extra="forbid")
Vector3 = tuple[float, float, float]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Intrinsics(BaseModel):
    """A lens in OpenCV's terms; pixels with the origin that the keypoints have."""

    model_config = _STRICT

    model: LensName = Field(
        default="pinhole", description="OpenCV's pinhole or fisheye distortion."
    )
    fx: float = Field(gt=1, le=1e6, description="Focal length along x, pixels.")
    fy: float = Field(gt=1, le=1e6, description="Focal length along y, pixels.")
    cx: Coordinate = Field(description="Principal point, pixels.")
    cy: Coordinate
    distortion: tuple[Annotated[float, Field(ge=-100, le=100)], ...] = Field(
        default=(),
        max_length=8,
        description="OpenCV's order: k1, k2[, p1, p2[, k3[, k4, k5, k6]]]; fisheye: k1 to k4.",
    )
    focal_sd: float = Field(
        default=0,
        ge=0,
        le=1,
        description="How unsure the focal length is, as a share of it. 0: it is kept as it is.",
    )

    @model_validator(mode="after")
    def _known_number_of_coefficients(self) -> Self:
        counts = NUMBERS_OF_COEFFICIENTS[self.model]
        if len(self.distortion) not in counts:
            raise ValueError(
                f"distortion of a {self.model} lens must have one of {list(counts)} coefficients"
                f" in OpenCV's order, got {len(self.distortion)}"
            )
        return self


class Camera(BaseModel):
    """What is known of one view's camera."""

    model_config = _STRICT

    intrinsics: Intrinsics | None = None
    rotation: tuple[Vector3, Vector3, Vector3] | None = Field(
        default=None, description="R of x_cam = R x_world + t (OpenCV axes), of a camera at rest."
    )
    translation: Vector3 | None = Field(
        default=None, description="t of x_cam = R x_world + t, in the unit results shall have."
    )

    @model_validator(mode="after")
    def _rotation_and_translation_make_a_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            raise ValueError("rotation and translation belong together: give both or neither")
        if self.rotation is not None:
            rotation = np.array(self.rotation)
            off = np.abs(rotation @ rotation.T - np.eye(3)).max()
            if not (off < ORTHONORMAL and np.linalg.det(rotation) > 0):
                raise ValueError(
                    "rotation must be orthonormal with determinant +1; a mirrored or scaled matrix"
                    " is none"
                )
        return self


class KnownLength(BaseModel):
    """A distance in the subject that was measured, such as a bone or a stick."""

    model_config = _STRICT

    keypoints: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = Field(
        description="Indices of its two ends."
    )
    length: float = Field(gt=0, le=1e6, description="In the unit that results shall have.")
