"""What a user may tell of the cameras and the subject, and need not. Imports no torch."""

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from typing_extensions import TypeAliasType

# A file each in `models.optics.lenses`; and the same lenses, as lifts and models call them.
LensName = TypeAliasType("LensName", Literal["pinhole", "fisheye"])
LiftedLensName = TypeAliasType("LiftedLensName", Literal["perspective", "fisheye"])
Alike = bool | Literal["auto"]  # whether lenses are alike; "auto": as the keypoints say
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
    """What is known of a lens, in OpenCV's terms; pixels with the origin that the keypoints have.

    What is left out or null is found from the keypoints.
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
        default=None, description="Principal point, pixels. Null: it is found."
    )
    cy: Coordinate | None = None
    distortion: tuple[Annotated[float, Field(ge=-100, le=100)], ...] | None = Field(
        default=None,
        max_length=8,
        description="OpenCV's order: k1, k2[, p1, p2[, k3[, k4, k5, k6]]]; fisheye: k1 to k4."
        " Empty: there is none. Null: it is found.",
    )
    focal_sd: float = Field(
        default=0,
        ge=0,
        le=1,
        description="How unsure the focal length is, as a share of it. 0: as sure as a"
        " calibration.",
    )

    @model_validator(mode="after")
    def _a_centre_has_two_numbers(self) -> Self:
        if (self.cx is None) != (self.cy is None):
            raise ValueError(
                "cx and cy belong together: give both, or neither to have the principal point found"
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
        """Principal point (x, y), pixels; None where it was not told."""
        return None if self.cx is None or self.cy is None else (self.cx, self.cy)


def _check_rotation(told: Any) -> Any:
    """Say what is wrong with a rotation in words that name the fix; None passes."""
    if told is None:
        return None
    try:
        rotation = np.array(told, np.float64)
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
        return told
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
    return told


class Camera(BaseModel):
    """What is known of one view's camera."""

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
        description="R of x_cam = R x_world + t (OpenCV axes), of a camera at rest: 3x3, or"
        " Rodrigues' vector in radians, as OpenCV's `rvec`.",
    )
    translation: Vector3 | None = Field(
        default=None, description="t of x_cam = R x_world + t, in the unit results shall have."
    )

    @model_validator(mode="after")
    def _rotation_and_translation_make_a_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            raise ValueError("rotation and translation belong together: give both or neither")
        return self


def _keypoint(told: Any) -> Any:
    """Say what tells a keypoint, in one sentence where pydantic would have one for each type."""
    by_index = isinstance(told, int) and not isinstance(told, bool) and told >= 0
    by_name = isinstance(told, str) and 0 < len(told) <= LONGEST_NAME
    if not (by_index or by_name):
        raise ValueError(f"expected the index of a keypoint, from 0, or its name, got {told!r:.50}")
    return told


Keypoint = Annotated[
    Annotated[int, Field(ge=0)] | Annotated[str, Field(min_length=1, max_length=LONGEST_NAME)],
    BeforeValidator(_keypoint),
]


def as_index(keypoint: Keypoint) -> int:
    """Return the index of a keypoint; raise ValueError for a name, whose place a dataset knows."""
    if isinstance(keypoint, str):
        raise ValueError(
            f"keypoints are told by their indices, from 0, where no dataset gives them names, got"
            f" the name {keypoint!r}"
        )
    return keypoint


class KnownLength(BaseModel):
    """A distance in the subject that was measured, such as a bone or a stick."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    keypoints: tuple[Keypoint, Keypoint] = Field(
        description="Its two ends: indices, or names of the dataset's skeleton. Kept as indices."
    )
    length: float = Field(gt=0, le=1e6, description="In the unit that results shall have.")

    @property
    def ends(self) -> tuple[int, int]:
        """Indices of its two ends."""
        a, b = self.keypoints
        return as_index(a), as_index(b)
