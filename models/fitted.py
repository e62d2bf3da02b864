"""A fitted prior: lifts 2D keypoints to structure and cameras, and travels as bytes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from models.cameras import project, solve_cameras
from models.config import FitConfig, Refine
from models.found import FoundCameras
from models.keypoints import MAX_KEYPOINTS, MIN_KEYPOINTS, Observations, as_observations
from models.prior import HierarchicalPrior, parameter_shapes
from models.refinement import settle
from models.weights import Arrays, WeightsError, pack, read_about, unpack

Status = Literal["ok", "too_few_keypoints"]
CAMERA_MODELS = ("weak_perspective", "perspective", "fisheye")
REASONS: dict[Status, str] = {
    "ok": "",
    "too_few_keypoints": (
        f"no view shows {MIN_KEYPOINTS} keypoints or more that do not all lie at one place"
    ),
}
ACTIVATIONS = 4_000_000  # numbers in the widest layer of a slice of frames: 16 MB


class CurvePoint(NamedTuple):
    """One row of a training curve."""

    step: int
    loss: float  # running mean
    reprojection_error: float  # pixels, running mean


@dataclass(frozen=True)
class Lift:
    """Structures and cameras of N frames of K views; NaN where there is no answer.

    A frame without a usable view has no structure; a view that is not usable has no camera.
    """

    points3d: NDArray[np.float32]  # (N, P, 3) canonical, centred
    rotations: NDArray[np.float32]  # (N, K, 3, 3) canonical to camera, det +1
    scales: NDArray[np.float32]  # (N, K) pixels per unit, at the structure's centre
    # (N, K, 3): of perspective, x_cam = R X + t in units of the structure; of weak perspective,
    # (x, y) in pixels and NaN.
    translations: NDArray[np.float32]
    focals: NDArray[np.float32]  # (N, K, 2) pixels along x and y; NaN for weak perspective
    principal_points: NDArray[np.float32]  # (N, K, 2) pixels; NaN for weak perspective
    distortions: NDArray[np.float32]  # (N, K, 8) OpenCV's order; NaN for weak perspective
    camera_models: NDArray[np.int8]  # (N, K) index into CAMERA_MODELS, -1 without a camera
    reprojection_errors: NDArray[np.float32]  # (N, K) pixels, mean over the observed keypoints
    keypoints_used: NDArray[np.int32]  # (N, K)
    status: tuple[Status, ...]  # N

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why each frame has its status, in words; empty where it is ok."""
        return tuple(REASONS[status] for status in self.status)


class FittedPrior:
    """The outcome of a fit. Immutable, and safe to use from several threads at once."""

    def __init__(
        self,
        config: FitConfig,
        arrays: Arrays,
        curve: tuple[CurvePoint, ...],
        foreshortening: float,
        cameras: FoundCameras | None = None,
    ) -> None:
        self.config = config
        self.cameras = cameras
        self.curve = curve
        self.foreshortening = foreshortening
        self._arrays = arrays
        self._network = HierarchicalPrior(arrays["first"].shape[0], config.dictionary_sizes)
        self._network.load_state_dict(arrays)
        self._network.requires_grad_(requires_grad=False)

    @property
    def keypoints_per_frame(self) -> int:
        """The number of keypoints P that every frame must have."""
        return self._network.keypoints

    def lift(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        refine: Refine | None = None,
        views: Sequence[int] | None = None,
    ) -> Lift:
        """Lift frames (N, K, P, 2) in pixels, with any number of views K and any gaps.

        Every frame is lifted on its own: neither its neighbours nor the order of the frames
        changes its answer. Structures have the handedness that the fit settled on.

        Raises
        ------
        ValueError
            When the arrays are malformed (see `as_observations`) or P differs from the fit's.
        """
        seen = as_observations(keypoints, confidence)
        frames, views_n, count, _ = seen.keypoints.shape
        if count != self.keypoints_per_frame:
            raise ValueError(
                f"this prior was fitted to {self.keypoints_per_frame} keypoints per view,"
                f" got {count}; give them in the order of the fit, NaN for what was not observed"
            )
        widest = 6 * views_n * max(self.config.dictionary_sizes[0], count)
        slices = range(0, frames, max(1, ACTIVATIONS // widest)) or [0]
        size = max(1, ACTIVATIONS // widest)
        parts = [self._lift(seen, slice(start, start + size)) for start in slices]
        points, rotations, scales, shifts, errors = (
            np.concatenate(part) for part in zip(*parts, strict=True)
        )
        translations = np.concatenate((shifts, np.full_like(shifts[..., :1], np.nan)), -1)
        usable = seen.usable
        answered: NDArray[np.bool_] = np.any(usable, axis=1)
        points[~answered] = np.nan
        for answer in (rotations, scales, translations, errors):
            answer[~usable] = np.nan
        return Lift(
            points3d=points,
            rotations=rotations,
            scales=scales,
            translations=translations,
            focals=np.full((frames, views_n, 2), np.nan, np.float32),
            principal_points=np.full((frames, views_n, 2), np.nan, np.float32),
            distortions=np.full((frames, views_n, 8), np.nan, np.float32),
            camera_models=np.where(usable, 0, -1).astype(np.int8),
            reprojection_errors=errors,
            keypoints_used=(seen.weights > 0).sum(-1, dtype=np.int32),
            status=tuple("ok" if any_view else "too_few_keypoints" for any_view in answered),
        )

    @torch.inference_mode()
    def _lift(self, seen: Observations, part: slice) -> tuple[NDArray[np.float32], ...]:
        keypoints = torch.from_numpy(seen.keypoints[part])
        weights = torch.from_numpy(seen.weights[part])
        sizes, centres = torch.from_numpy(seen.sizes[part]), torch.from_numpy(seen.centres[part])
        found = self._network(keypoints, weights)
        points, guesses = settle(
            found.points, keypoints, weights, found.guesses, self.foreshortening
        )
        cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
        distances = (project(points[:, None], cameras) - keypoints).norm(dim=-1)
        observed = (weights > 0).to(distances.dtype)
        mean = (distances * observed).sum(-1) / observed.sum(-1).clamp_min(1)
        answers = (
            points,
            cameras.rotations,
            cameras.scales * sizes,
            cameras.translations * sizes[..., None] + centres,
            mean * sizes,
        )
        return tuple(answer.numpy() for answer in answers)

    def to_bytes(self) -> bytes:
        """Return the prior as safetensors bytes, its configuration in the header."""
        curve = torch.tensor(self.curve, dtype=torch.float64).reshape(-1, 3)
        return pack(
            {
                **self._arrays,
                "curve": curve,
                "foreshortening": torch.tensor([self.foreshortening], dtype=torch.float64),
            },
            kind="prior",
            about={
                "config": self.config.model_dump_json(),
                "keypoints": str(self.keypoints_per_frame),
            },
        )

    @classmethod
    def from_bytes(cls, data: bytes) -> "FittedPrior":
        """Read what `to_bytes` wrote.

        Raises
        ------
        WeightsError
            When the bytes are damaged, foreign, or not what their header promises. Nothing larger
            than `data` is allocated before that is known.
        """
        about = read_about(data, kind="prior")
        try:
            config = FitConfig.model_validate_json(about["config"])
            keypoints = int(about["keypoints"])
        except (KeyError, ValueError) as error:
            raise WeightsError("the header holds no valid configuration") from error
        if not MIN_KEYPOINTS <= keypoints <= MAX_KEYPOINTS:
            raise WeightsError(f"the header says {keypoints} keypoints per frame")
        shapes = parameter_shapes(keypoints, config.dictionary_sizes)
        arrays = unpack(data, shapes={**shapes, "curve": (None, 3), "foreshortening": (1,)})
        curve = tuple(
            CurvePoint(int(s), loss, error) for s, loss, error in arrays.pop("curve").tolist()
        )
        return cls(config, arrays, curve, arrays.pop("foreshortening").item())
