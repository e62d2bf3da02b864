"""Synthetic captures: an articulated figure before moving cameras, with all the truth known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.numerics.rotations import rotations_from_vectors

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Name, parent, offset from the parent in metres before any rotation (x left, y up, z forward of
# the figure), and the standard deviation of the joint angle at the parent, in radians.
BONES: tuple[tuple[str, int, tuple[float, float, float], float], ...] = (
    ("pelvis", -1, (0.0, 0.0, 0.0), 0.0),
    ("left_hip", 0, (0.10, -0.04, 0.0), 0.05),
    ("left_knee", 1, (0.02, -0.42, 0.02), 0.5),
    ("left_ankle", 2, (0.0, -0.41, -0.05), 0.4),
    ("right_hip", 0, (-0.10, -0.04, 0.0), 0.05),
    ("right_knee", 4, (-0.02, -0.42, 0.02), 0.5),
    ("right_ankle", 5, (0.0, -0.41, -0.05), 0.4),
    ("spine", 0, (0.0, 0.24, 0.02), 0.15),
    ("neck", 7, (0.0, 0.27, 0.0), 0.15),
    ("head", 8, (0.0, 0.18, 0.06), 0.25),
    ("left_shoulder", 8, (0.17, -0.04, 0.0), 0.1),
    ("left_elbow", 10, (0.10, -0.26, 0.02), 0.7),
    ("left_wrist", 11, (0.02, -0.22, 0.11), 0.6),
    ("right_shoulder", 8, (-0.17, -0.04, 0.0), 0.1),
    ("right_elbow", 13, (-0.10, -0.26, 0.02), 0.7),
    ("right_wrist", 14, (-0.02, -0.22, 0.11), 0.6),
)
KEYPOINT_NAMES = tuple(name for name, *_ in BONES)
EDGES = tuple((parent, child) for child, (_, parent, *_) in enumerate(BONES) if parent >= 0)
IMAGE_SIZE = (1280, 1024)
FOCAL_LENGTH = 1100.0  # pixels


@dataclass(frozen=True)
class SyntheticCapture:
    """N frames of K views of P keypoints, and what they were made from."""

    keypoints: Float32  # (N, K, P, 2) pixels, NaN where not observed
    confidence: Float32  # (N, K, P) in [0, 1], 0 where not observed
    points3d: Float32  # (N, P, 3) metres, world axes x left, y up, z forward: right-handed
    projections: Float64  # (N, K, 3, 4) pixels ~ projection @ (X, 1)
    rotations: Float64  # (N, K, 3, 3) world to camera
    translations: Float64  # (N, K, 3) metres: x_cam = R X + t
    intrinsics: Float64  # (3, 3)
    keypoint_names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    image_sizes: tuple[tuple[int, int], ...]  # K times (width, height)


def synthetic_capture(
    *,
    frames: int = 200,
    views: int = 4,
    noise: float = 0.0,
    hidden_keypoints: float = 0.0,
    hidden_views: float = 0.0,
    outliers: float = 0.0,
    distance: float = 4.0,
    seed: int = 0,
) -> SyntheticCapture:
    """Make a capture of a figure in random poses; every camera moves freely between frames.

    Parameters
    ----------
    frames, views
        1 to 100,000 and 1 to 64.
    noise
        Standard deviation of the detector's error in pixels, 0 to 100. Confidence falls with the
        error that a keypoint really got, as a good detector's does.
    hidden_keypoints, hidden_views
        Probabilities that a keypoint of a view, and a whole view of a frame, is not observed.
    outliers
        Probability that a keypoint lies anywhere in the image, with low confidence.
    distance
        Mean distance of the cameras in metres, 2.5 to 1,000; far away, perspective vanishes (and
        the figure is magnified to keep its size in pixels).

    Raises
    ------
    ValueError
        When an argument is out of its range.
    """
    _within("frames", frames, 1, 100_000)
    _within("views", views, 1, 64)
    _within("noise", noise, 0, 100)
    _within("distance", distance, 2.5, 1_000)
    for name, share in (
        ("hidden_keypoints", hidden_keypoints),
        ("hidden_views", hidden_views),
        ("outliers", outliers),
    ):
        _within(name, share, 0, 1)
    rng = np.random.default_rng(seed)

    points = _poses(rng, frames)  # (N, P, 3)
    rotations, translations = _cameras(rng, frames, views, distance)
    focal = FOCAL_LENGTH * distance / 4
    width, height = IMAGE_SIZE
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    projections = intrinsics @ np.concatenate((rotations, translations[..., None]), -1)
    homogeneous = np.concatenate((points, np.ones((*points.shape[:2], 1))), -1)
    image = homogeneous[:, None] @ projections.mT  # (N, K, P, 3)
    exact = image[..., :2] / image[..., 2:]

    error = noise * rng.standard_normal(exact.shape)
    keypoints = exact + error
    ratio = np.linalg.norm(error, axis=-1) / max(noise, 1e-9)
    confidence = np.clip(1 / (1 + 0.3 * ratio) + 0.05 * rng.standard_normal(ratio.shape), 0.05, 1)
    if noise == 0:
        confidence = np.ones_like(confidence)
    astray = rng.random(confidence.shape) < outliers
    keypoints[astray] = rng.uniform(0, IMAGE_SIZE, (int(astray.sum()), 2))
    confidence[astray] = rng.uniform(0.05, 0.4, int(astray.sum()))
    hidden = rng.random(confidence.shape) < hidden_keypoints
    hidden |= (rng.random((frames, views)) < hidden_views)[..., None]
    keypoints[hidden] = np.nan
    confidence[hidden] = 0
    return SyntheticCapture(
        keypoints=keypoints.astype(np.float32),
        confidence=confidence.astype(np.float32),
        points3d=points.astype(np.float32),
        projections=projections,
        rotations=rotations,
        translations=translations,
        intrinsics=intrinsics,
        keypoint_names=KEYPOINT_NAMES,
        edges=EDGES,
        image_sizes=(IMAGE_SIZE,) * views,
    )


def _poses(rng: np.random.Generator, frames: int) -> Float64:
    """Joint positions (N, P, 3): forward kinematics along the skeleton, heading at random."""
    # Four moods of the whole figure and a little of each joint's own: poses of real actors have
    # few degrees of freedom, and a prior can only find what recurs.
    moods = rng.standard_normal((4, len(BONES), 3))
    mixture = rng.standard_normal((frames, 4)) / 2
    spread = np.array([bone[3] for bone in BONES])[:, None]
    vectors = np.einsum("nm,mpc->npc", mixture, moods)
    vectors = spread * (vectors + 0.3 * rng.standard_normal(vectors.shape))
    local = rotations_from_vectors(vectors)  # (N, P, 3, 3)

    heading = np.zeros((frames, 3))
    heading[:, 1] = rng.uniform(-np.pi, np.pi, frames)
    turned = np.empty_like(local)
    points = np.zeros((frames, len(BONES), 3))
    turned[:, 0] = rotations_from_vectors(heading)
    for joint, (_, parent, offset, _) in enumerate(BONES[1:], start=1):
        turned[:, joint] = turned[:, parent] @ local[:, joint]
        points[:, joint] = points[:, parent] + turned[:, joint] @ np.array(offset)
    return points


def _cameras(
    rng: np.random.Generator, frames: int, views: int, distance: float
) -> tuple[Float64, Float64]:
    """Rotations (N, K, 3, 3) and translations (N, K, 3) of cameras that look at the figure."""
    shape = (frames, views)
    azimuth = rng.uniform(-np.pi, np.pi, shape)
    elevation = rng.uniform(-0.2, 0.6, shape)
    away = distance * rng.uniform(0.9, 1.1, shape)
    forward = -np.stack(
        (
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
            np.cos(elevation) * np.cos(azimuth),
        ),
        -1,
    )
    right = np.cross(forward, np.array([0.0, 1.0, 0.0]))
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    rotations = np.stack((right, np.cross(forward, right), forward), -2)
    roll = np.zeros((*shape, 3))
    roll[..., 2] = 0.1 * rng.standard_normal(shape)
    rotations = rotations_from_vectors(roll) @ rotations
    aim = 0.1 * rng.standard_normal((*shape, 3))
    translations = np.stack((aim[..., 0], aim[..., 1], away), -1)
    return rotations, translations


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {value:g}")
