"""One camera: its lens, its place, and where it shows a point."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]

FISHEYE_COEFFICIENTS = 4
PINHOLE_COEFFICIENTS = (5, 8)  # as many as OpenCV takes: k1, k2, p1, p2, k3; k4, k5, k6

STRAIGHTENING_ROUNDS = 100
STRAIGHT = 1e-7  # error of a direction that is found


@dataclass(frozen=True)
class Camera:
    """A perspective camera in OpenCV's terms: x right, y down, z forward.

    `x_cam = R X + t` transforms from the room to the camera, `pixel = K bend(x_cam / z)` to the
    image, whose top-left pixel has its centre at (0, 0).

    Attributes
    ----------
    name
        As in the file, or the view's.
    matrix
        (3, 3) K, pixels.
    distortion
        OpenCV's coefficients, unitless: k1, k2, p1, p2, k3 and, if any is not 0, k4 to k6; of a
        fisheye k1 to k4. Fewer may be given.
    rotation
        (3, 3) R, a rotation; None where the pose is unknown, as of a camera that moves.
    translation
        (3,) t, in the unit of the room; None where the pose is unknown.
    size
        (width, height) of the image in pixels, None if unknown.
    fisheye
        Whether the lens is OpenCV's fisheye (Kannala and Brandt).

    Raises
    ------
    ValueError
        If shapes are wrong, or more coefficients are given than the lens has.
    """

    name: str
    matrix: Float64
    distortion: Float64 = field(default_factory=lambda: np.empty(0))
    rotation: Float64 | None = None
    translation: Float64 | None = None
    size: tuple[int, int] | None = None
    fisheye: bool = False

    def __post_init__(self) -> None:
        """Take any sequences for arrays, and check them."""
        if (self.rotation is None) != (self.translation is None):
            raise ValueError(f"camera {self.name!r}: rotation and translation go together")
        shapes = {"matrix": (3, 3), "distortion": (-1,), "rotation": (3, 3), "translation": (3,)}
        for part, shape in shapes.items():
            given = getattr(self, part)
            if given is None:
                continue
            array = np.array(given, dtype=np.float64)
            if shape == (-1,) or array.shape in {(3, 1), (1, 3)}:
                array = array.ravel()
            if shape not in {(-1,), array.shape}:
                raise ValueError(
                    f"camera {self.name!r}: {part} must be {shape}, it is {array.shape}"
                )
            object.__setattr__(self, part, array)
        given = len(np.trim_zeros(self.distortion, "b"))
        counts = (FISHEYE_COEFFICIENTS,) if self.fisheye else PINHOLE_COEFFICIENTS
        if given > counts[-1]:
            raise ValueError(
                f"camera {self.name!r}: {counts[-1]} distortion coefficients at most, "
                f"{given} were given"
            )
        held = np.zeros(next(count for count in counts if count >= given))
        held[:given] = self.distortion[:given]
        object.__setattr__(self, "distortion", held)

    def __eq__(self, other: object) -> bool:
        """Whether two cameras are the same, number for number."""
        if not isinstance(other, Camera):
            return NotImplemented
        plain = (self.name, self.size, self.fisheye) == (other.name, other.size, other.fisheye)
        fields = ("matrix", "distortion", "rotation", "translation")
        return plain and all(_same(getattr(self, f), getattr(other, f)) for f in fields)

    __hash__ = None  # type: ignore[assignment]  # it holds arrays

    @property
    def vector(self) -> Float64 | None:
        """The rotation as a Rodrigues vector (3,): axis times angle in radians."""
        return None if self.rotation is None else rotation_vector(self.rotation)

    def project(self, points: ArrayLike) -> Float64:
        """Return the pixels (..., 2) of points (..., 3) in the room; NaN behind the camera.

        Source: the OpenCV documentation, modules calib3d and fisheye.
        """
        room = np.asarray(points, dtype=np.float64)
        if self.rotation is not None and self.translation is not None:
            room = room @ self.rotation.T + self.translation
        depth = np.where(room[..., 2] > 0, room[..., 2], np.nan)
        bent = self._bend(room[..., :2] / depth[..., None])
        pixels: Float64 = bent @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        return pixels

    def straighten(self, pixels: ArrayLike) -> Float64:
        """Return the directions (..., 2) at depth 1, in the camera's axes, that pixels show.

        Source: `cv2.undistortPoints`, whose fixed point it finds by the same iteration. NaN where
        that does not settle, as beyond the edge of what the lens can show.
        """
        shown = np.asarray(pixels, dtype=np.float64) - self.matrix[:2, 2]
        bent = shown @ np.linalg.inv(self.matrix[:2, :2]).T
        directions = bent.copy()
        for _ in range(STRAIGHTENING_ROUNDS):
            directions = directions + (bent - self._bend(directions))
        off = np.linalg.norm(self._bend(directions) - bent, axis=-1, keepdims=True)
        return np.where(off < STRAIGHT, directions, np.nan)

    def _bend(self, directions: Float64) -> Float64:
        """Return the directions (..., 2) at depth 1 as the lens bends them."""
        if self.fisheye:
            return self._bend_fisheye(directions)
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, 0.0, 0.0, 0.0)[:8]
        x, y = directions[..., 0], directions[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        bent: Float64 = np.stack(
            (
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ),
            axis=-1,
        )
        return bent

    def _bend_fisheye(self, directions: Float64) -> Float64:
        k1, k2, k3, k4 = self.distortion
        r = np.linalg.norm(directions, axis=-1, keepdims=True)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        stretched: Float64 = directions * np.where(r > 0, bent / np.where(r > 0, r, 1), 1)
        return stretched


def rotation_matrix(vector: ArrayLike) -> Float64:
    """Return the rotation (3, 3) of a Rodrigues vector (3,): axis times angle in radians."""
    axis = np.asarray(vector, dtype=np.float64).ravel()
    angle = float(np.linalg.norm(axis))
    if angle == 0:
        return np.eye(3)
    x, y, z = axis / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: Float64 = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def rotation_vector(rotation: ArrayLike) -> Float64:
    """Return the Rodrigues vector (3,) of a rotation (3, 3); its angle is pi at most."""
    w, *rest = quaternion(rotation)
    axis = np.array(rest)
    length = float(np.linalg.norm(axis))
    return 2 * axis if length == 0 else axis / length * (2 * np.arctan2(length, w))


def quaternion(rotation: ArrayLike) -> Float64:
    """Return the unit quaternion (4,) w, x, y, z of a rotation (3, 3), w >= 0.

    It is the eigenvector of Bar-Itzhack's matrix (2000), which is exact for every angle.
    """
    r = np.asarray(rotation, dtype=np.float64)
    skew = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    matrix = np.empty((4, 4))
    matrix[0, 0] = np.trace(r)
    matrix[0, 1:] = matrix[1:, 0] = skew
    matrix[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    found = np.linalg.eigh(matrix)[1][:, -1]
    return np.asarray(-found if found[0] < 0 else found, dtype=np.float64)


def from_model(
    found: dict[str, Any],
    names: Sequence[str] | None = None,
    sizes: Sequence[tuple[int, int] | None] | None = None,
) -> list[Camera]:
    """Return the answer of `GET /models/{id}/cameras` as K cameras; moving ones have no pose.

    Raises
    ------
    ValueError
        If a view has no perspective camera.
    """
    cameras = []
    for place, view in enumerate(found["views"]):
        name = names[place] if names else f"view{view['index']}"
        if view["focal"] is None or view["camera"] == "weak_perspective":
            raise ValueError(f"{name} is weak perspective: no calibration can describe it")
        (fx, fy), (cx, cy) = view["focal"], view["principal_point"]
        cameras.append(
            Camera(
                name,
                np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                np.array(view["distortion"]),
                view["rotation"],
                view["translation"],
                sizes[place] if sizes else None,
                view["camera"] == "fisheye",
            )
        )
    return cameras


def _same(first: Float64 | None, second: Float64 | None) -> bool:
    if first is None or second is None:
        return first is second
    return bool(np.array_equal(first, second))
