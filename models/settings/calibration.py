"""What a user may give of the cameras and the subject. Imports no torch."""

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from typing_extensions import TypeAliasType

from models.settings.unions import refused_with

# A file each in `models.optics.lenses`; and the same lenses, as lifts and models call them.
LensName = TypeAliasType("LensName", Literal["pinhole", "fisheye"])
LiftedLensName = TypeAliasType("LiftedLensName", Literal["perspective", "fisheye"])
# Whether lenses are alike; "auto": estimated from the keypoints.
Alike = Annotated[bool | Literal["auto"], refused_with('expected true, false or "auto"')]
NUMBERS_OF_COEFFICIENTS: dict[LensName, tuple[int, ...]] = {
    "pinhole": (0, 1, 2, 4, 5, 8),
    "fisheye": (0, 4),
}
ORTHONORMAL = 1e-3  # largest deviation of R R^T from 1 that rounding explains
LONGEST_NAME = 100  # characters, of a keypoint
LARGEST_ANGLE = 2 * math.pi * (1 + 1e-6)  # radians: a turn; longer vectors are no rotation vectors

Number = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = tuple[Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Intrinsics(BaseModel):
    """A given lens, in OpenCV's terms; pixels with the origin of the keypoints.

    Numbers that are left out or null are estimated from the keypoints.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"fx": 1104.5},
                {"fx": 1104.5, "fy": 1102.1},
                {
                    "fx": 1104.5,
                    "fy": 1102.1,
                    "cx": 640.2,
                    "cy": 511.7,
                    "distortion": [-0.11, 0.02, 0.0, 0.0],
                },
            ]
        },
    )

    model: LensName = Field(
        default="pinhole", description="OpenCV's pinhole or fisheye distortion."
    )
    fx: float = Field(gt=1, le=1e6, description="Focal length along x, pixels.")
    fy: float | None = Field(
        default=None, gt=1, le=1e6, description="Focal length along y, pixels. Null: as along x."
    )
    cx: Coordinate | None = Field(
        default=None, description="Principal point, pixels. Null: it is estimated."
    )
    cy: Coordinate | None = None
    distortion: tuple[Annotated[float, Field(ge=-100, le=100)], ...] | None = Field(
        default=None,
        max_length=8,
        description="OpenCV's order: k1, k2[, p1, p2[, k3[, k4, k5, k6]]]; fisheye: k1 to k4."
        " Empty: there is none. Null: it is estimated.",
    )
    focal_sd: float = Field(
        default=0,
        ge=0,
        le=1,
        description="Standard deviation of the focal length, as a share of it. 0: that of a"
        " calibration.",
    )

    @model_validator(mode="after")
    def _a_centre_has_two_numbers(self) -> Self:
        if (self.cx is None) != (self.cy is None):
            raise ValueError(
                "cx and cy belong together: give both, or neither to have it estimated"
            )
        return self

    @model_validator(mode="after")
    def _known_number_of_coefficients(self) -> Self:
        counts = NUMBERS_OF_COEFFICIENTS[self.model]
        if self.distortion is not None and len(self.distortion) not in counts:
            raise ValueError(
                f"distortion of a {self.model} lens must have one of {list(counts)} coefficients"
                f" in OpenCV's order, got {len(self.distortion)}; fill up with zeros"
            )
        return self

    @property
    def focals(self) -> tuple[float, float]:
        """Focal lengths along x and y, pixels."""
        return self.fx, self.fx if self.fy is None else self.fy

    @property
    def centre(self) -> tuple[float, float] | None:
        """Principal point (x, y), pixels; None where it was not given."""
        return None if self.cx is None or self.cy is None else (self.cx, self.cy)


def _check_rotation(given: Any) -> Any:
    """Return a rotation, or raise ValueError with what is wrong and how to mend it; None passes."""
    if given is None:
        return None
    try:
        rotation = np.array(given, np.float64)
    except (TypeError, ValueError):
        rotation = np.zeros(0)
    if rotation.shape not in ((3,), (3, 3)) or not np.isfinite(rotation).all():
        raise ValueError(
            "rotation must be a 3x3 matrix (3 rows of 3 numbers) or Rodrigues' vector (3 numbers,"
            " radians)"
        )
    if rotation.shape == (3,):
        angle = float(np.linalg.norm(rotation))
        if angle > LARGEST_ANGLE:
            raise ValueError(
                f"rotation as Rodrigues' vector must be in radians: its length is the angle, got"
                f" {angle:.4g}, which is more than a whole turn; if these are degrees, multiply by"
                " pi / 180; if these are Euler angles, convert them to a matrix"
            )
        return given
    determinant = float(np.linalg.det(rotation))
    gram = rotation @ rotation.T
    scale = float(np.sqrt(gram.trace() / 3))
    if not scale > 0 or np.abs(gram / scale**2 - np.eye(3)).max() > ORTHONORMAL:
        raise ValueError(
            "rotation must be orthonormal (its rows of length 1 and perpendicular to each other):"
            " the upper left 3x3 of [R | t], not of a projection matrix K [R | t]"
        )
    if determinant < 0:
        raise ValueError(
            "rotation must have determinant +1, got a mirrored matrix; the axes are OpenCV's (x"
            " right, y down, z forward): turn y and z around together, not one of them alone"
        )
    if abs(scale - 1) > ORTHONORMAL:
        raise ValueError(f"rotation must be orthonormal, got one times {scale:.4g}; divide by it")
    return given


class Camera(BaseModel):
    """A given camera of one view."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"intrinsics": {"fx": 1104.5}},
                {
                    "intrinsics": {"fx": 1104.5, "fy": 1102.1, "cx": 640.2, "cy": 511.7},
                    "rotation": [0.02, -1.57, 0.01],
                    "translation": [0.1, 0.4, 4.2],
                },
            ]
        },
    )

    intrinsics: Intrinsics | None = None
    rotation: Annotated[Matrix3 | Vector3 | None, BeforeValidator(_check_rotation)] = Field(
        default=None,
        description="R of x_cam = R x_world + t (OpenCV axes), of a static camera: 3x3, or"
        " Rodrigues' vector in radians, as OpenCV's `rvec`.",
    )
    translation: Vector3 | None = Field(
        default=None, description="t of x_cam = R x_world + t, in the unit that results get."
    )

    @model_validator(mode="after")
    def _rotation_and_translation_make_a_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            raise ValueError("rotation and translation belong together: give both or neither")
        return self


def _keypoint(given: Any) -> Any:
    """Check the index or name of a keypoint; pydantic would have a message for each type."""
    by_index = isinstance(given, int) and not isinstance(given, bool) and given >= 0
    by_name = isinstance(given, str) and 0 < len(given) <= LONGEST_NAME
    if not (by_index or by_name):
        raise ValueError(
            f"expected the index of a keypoint, from 0, or its name, got {given!r:.50}"
        )
    return given


Keypoint = Annotated[
    Annotated[int, Field(ge=0)] | Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)],
    BeforeValidator(_keypoint),
]


def as_index(keypoint: Keypoint) -> int:
    """Return the index of a keypoint; raise ValueError for a name, which needs a dataset."""
    if isinstance(keypoint, str):
        raise ValueError(
            f"keypoints are given by their indices, from 0, unless a dataset names them, got the"
            f" name {keypoint!r}"
        )
    return keypoint


class KnownLength(BaseModel):
    """A distance in the subject that was measured, such as a bone or a stick."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    keypoints: tuple[Keypoint, Keypoint] = Field(
        description="Its two ends: indices, or names of the dataset's skeleton. Kept as indices."
    )
    length: float = Field(gt=0, le=1e6, description="In the unit that results get.")

    @property
    def ends(self) -> tuple[int, int]:
        """Indices of its two ends."""
        a, b = self.keypoints
        return as_index(a), as_index(b)


class KnownDistance(BaseModel):
    """A distance between two cameras that was measured, from lens to lens."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    views: tuple[Annotated[int, Field(ge=0, le=63)], Annotated[int, Field(ge=0, le=63)]] = Field(
        description="Of the two cameras, from 0."
    )
    length: float = Field(gt=0, le=1e6, description="In the unit that results get.")
