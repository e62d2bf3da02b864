"""A fitted prior: lifts 2D keypoints to structure and cameras, and travels as bytes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from models.cameras import project, solve_cameras
from models.config import FitConfig, Refine
from models.denoising import ViewModel
from models.discovery import Answers, Discovery
from models.keypoints import MAX_KEYPOINTS, MIN_KEYPOINTS, Observations, as_observations
from models.optics import COEFFICIENTS
from models.perspective import (
    array_shapes,
    from_arrays,
    refine_frames,
    report,
    to_arrays,
)
from models.prior import HierarchicalPrior, parameter_shapes
from models.refinement import mirrored, misfit, settle
from models.weights import Arrays, Shapes, WeightsError, pack, read_about, unpack

Status = Literal["ok", "too_few_keypoints"]
CAMERA_MODELS = ("weak_perspective", "perspective", "fisheye")
REASONS: dict[Status, str] = {
    "ok": "",
    "too_few_keypoints": (
        f"no view shows {MIN_KEYPOINTS} keypoints or more that do not all lie at one place"
    ),
}
DENOISER = "denoiser."  # before those of the model of noisy views
CAMERAS = "cameras."  # before the names of what was found of the cameras, in a file
WORSE = 1.25  # times the network's reprojection error: no refinement that leads there is kept
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
    # (N, K): pixels, mean over the observed keypoints, as they were denoised if they were.
    reprojection_errors: NDArray[np.float32]
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
        found: Discovery | None = None,
        denoiser: ViewModel | None = None,
    ) -> None:
        self.config = config
        self._denoiser = denoiser
        self.cameras = None if found is None else report(found)
        self._found = found
        self.curve = curve
        self.foreshortening = foreshortening
        self._arrays = arrays
        self._network = HierarchicalPrior(arrays["first"].shape[0], config.dictionary_sizes)
        self._network.load_state_dict(arrays)
        self._network.requires_grad_(requires_grad=False)

    @property
    def noise(self) -> float:
        """Standard deviation of a keypoint's coordinate in pixels; NaN if no cameras were found."""
        return math.nan if self._found is None else self._found.noise

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

        Parameters
        ----------
        refine
            `off`: the network and weak perspective. `full`: perspective refinement with the lenses,
            the rig and the shapes that the fit found. `auto`: the same, save for frames whose
            keypoints it explains worse than the network. Default: what the fit was told. A fit
            that found no cameras refines nothing.
        views
            Which of the fit's views these are. Default: all of them in their order if K is their
            number, otherwise cameras that the fit does not know.

        Raises
        ------
        ValueError
            When the arrays are malformed (see `as_observations`), P differs from the fit's, or
            `views` does not name K different views of the fit.
        """
        seen = as_observations(keypoints, confidence)
        frames, count, points_count, _ = seen.keypoints.shape
        if points_count != self.keypoints_per_frame:
            raise ValueError(
                f"this prior was fitted to {self.keypoints_per_frame} keypoints per view,"
                f" got {points_count}; give them in the order of the fit, NaN for what was not"
                " observed"
            )
        fitted = self._views(views, count)
        if self._denoiser is not None and fitted is not None:
            seen = self._denoiser.denoise(seen, fitted)
        mode = self.config.refine if refine is None else refine
        size = max(
            1, ACTIVATIONS // (6 * count * max(self.config.dictionary_sizes[0], points_count))
        )
        parts = []
        for start in range(0, max(frames, 1), size):
            part = _slice(seen, slice(start, start + size))
            lift = self._feed_forward(part)
            if mode != "off" and self._found is not None and len(lift.points3d):
                lift = _refined(lift, part, self._found, fitted, always=mode == "full")
            parts.append(lift)
        return join(parts)

    def _views(self, views: Sequence[int] | None, count: int) -> Sequence[int] | None:
        known = 0 if self._found is None else len(self._found.errors)
        known = known if self._denoiser is None else len(self._denoiser.mean)
        if views is None:
            return range(count) if count == known else None
        if (
            len(views) != count
            or len(set(views)) != count
            or (known and not all(0 <= view < known for view in views))
        ):
            raise ValueError(
                f"views must name {count} different views of the {known or 'unknown'} of the fit,"
                f" got {list(views)}"
            )
        return views if known else None

    @torch.inference_mode()
    def _feed_forward(self, seen: Observations) -> Lift:
        keypoints, weights = torch.from_numpy(seen.keypoints), torch.from_numpy(seen.weights)
        sizes, centres = torch.from_numpy(seen.sizes), torch.from_numpy(seen.centres)
        points, _, guesses = self._network(keypoints, weights)
        odd = torch.ones(len(points), dtype=torch.bool)
        if self._found is not None:
            plain = (points, guesses) if self.foreshortening >= 0 else mirrored(points, guesses)
            odd = misfit(plain[0], keypoints, weights, plain[1]) > self._found.trusted
        if odd.any():
            settled = settle(
                points[odd], keypoints[odd], weights[odd], guesses[odd], self.foreshortening
            )
        if self._found is not None:
            points, guesses = plain
        if odd.any():
            points[odd], guesses[odd] = settled
        cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
        distances = (project(points[:, None], cameras) - keypoints).norm(dim=-1)
        observed = (weights > 0).to(distances.dtype)
        mean = (distances * observed).sum(-1) / observed.sum(-1).clamp_min(1)
        answered: NDArray[np.bool_] = np.any(seen.usable, axis=1)
        shifts = cameras.translations * sizes[..., None] + centres
        unknown = torch.full_like(shifts, torch.nan)
        lift = Lift(
            points3d=points.numpy(),
            rotations=cameras.rotations.numpy(),
            scales=(cameras.scales * sizes).numpy(),
            translations=torch.cat((shifts, unknown[..., :1]), -1).numpy(),
            focals=unknown.numpy(),
            principal_points=unknown.numpy().copy(),
            distortions=np.full((*seen.sizes.shape, COEFFICIENTS), np.nan, np.float32),
            camera_models=np.where(seen.usable, 0, -1).astype(np.int8),
            reprojection_errors=(mean * sizes).numpy(),
            keypoints_used=(seen.weights > 0).sum(-1, dtype=np.int32),
            status=tuple("ok" if some else "too_few_keypoints" for some in answered),
        )
        lift.points3d[~answered] = np.nan
        for answer in (lift.rotations, lift.scales, lift.translations, lift.reprojection_errors):
            answer[~seen.usable] = np.nan
        return lift

    def to_bytes(self) -> bytes:
        """Return the prior as safetensors bytes, its configuration in the header."""
        curve = torch.tensor(self.curve, dtype=torch.float64).reshape(-1, 3)
        about = {
            "config": self.config.model_dump_json(),
            "keypoints": str(self.keypoints_per_frame),
        }
        cameras: Arrays = {}
        if self._found is not None:
            cameras, about["cameras"] = to_arrays(self._found)
        denoiser: Arrays = {}
        if self._denoiser is not None:
            about["denoiser"] = str(len(self._denoiser.mean))
            denoiser = {
                name: torch.from_numpy(np.array(value, np.float64, ndmin=1, order="C"))
                for name, value in self._denoiser._asdict().items()
            }
        return pack(
            {
                **self._arrays,
                **{f"{CAMERAS}{name}": value for name, value in cameras.items()},
                **{f"{DENOISER}{name}": value for name, value in denoiser.items()},
                "curve": curve,
                "foreshortening": torch.tensor([self.foreshortening], dtype=torch.float64),
            },
            kind="prior",
            about=about,
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
        shapes: Shapes = {**parameter_shapes(keypoints, config.dictionary_sizes)}
        cameras = array_shapes(keypoints, None) if "cameras" in about else {}
        for name, shape in cameras.items():
            shapes[f"{CAMERAS}{name}"] = shape
        if "denoiser" in about:
            shapes[f"{DENOISER}mean"] = (None, keypoints, 2)
            shapes[f"{DENOISER}basis"] = (None, keypoints, 2, None)
            shapes[f"{DENOISER}noise"] = (1,)
        arrays = unpack(data, shapes={**shapes, "curve": (None, 3), "foreshortening": (1,)})
        denoiser = None
        if "denoiser" in about:
            mean, basis, noise = (arrays.pop(f"{DENOISER}{n}") for n in ViewModel._fields)
            denoiser = ViewModel(mean.numpy(), basis.numpy(), noise.item())
            if len(mean) != len(basis) or not denoiser.noise > 0:
                raise WeightsError("the file contradicts itself about the noise")
        found = None
        if cameras:
            parts = {name: arrays.pop(f"{CAMERAS}{name}") for name in cameras}
            found = from_arrays(parts, about["cameras"])
        curve = tuple(
            CurvePoint(int(s), loss, error) for s, loss, error in arrays.pop("curve").tolist()
        )
        return cls(config, arrays, curve, arrays.pop("foreshortening").item(), found, denoiser)


def join(lifts: Sequence[Lift]) -> Lift:
    """Join lifts of the same views and keypoints, frame after frame."""
    joined: dict[str, Any] = {}
    for field in fields(Lift):
        parts = [getattr(lift, field.name) for lift in lifts]
        joined[field.name] = (
            tuple(chain.from_iterable(parts)) if field.name == "status" else np.concatenate(parts)
        )
    return Lift(**joined)


def weak_perspective(lift: Lift, frames: NDArray[np.int64] | slice = slice(None)) -> Answers:
    """Structures, rotations, scales and translations (x, y) of some frames in float64.

    Harmless numbers stand where there is no answer.
    """
    none = ~torch.from_numpy(np.isfinite(lift.scales[frames]))

    def number(array: NDArray[np.float32], without: float) -> Tensor:
        return torch.nan_to_num(torch.from_numpy(array[frames]).double(), nan=without)

    rotations = number(lift.rotations, 0)
    rotations[none] = torch.eye(3, dtype=torch.float64)
    return (
        number(lift.points3d, 0),
        rotations,
        number(lift.scales, 1),
        number(lift.translations[..., :2], 0),
    )


@torch.inference_mode()
def _refined(
    lift: Lift,
    seen: Observations,
    found: Discovery,
    views: Sequence[int] | None,
    *,
    always: bool,
) -> Lift:
    """Refine with perspective what the keypoints allow; other frames stay as they are."""
    frames = np.flatnonzero(seen.usable.any(1))
    usable = torch.from_numpy(seen.usable[frames])
    pixels = seen.keypoints * seen.sizes[..., None, None] + seen.centres[..., None, :]
    answer = refine_frames(
        found,
        torch.from_numpy(np.nan_to_num(pixels[frames])).double(),
        torch.from_numpy(seen.weights[frames]).double(),
        weak_perspective(lift, frames),
        views,
    )
    fine = answer.fine.numpy()
    if not always:
        with np.errstate(invalid="ignore"):
            ours = np.where(usable, answer.errors.numpy(), 0).sum(1)
            theirs = np.where(usable, lift.reprojection_errors[frames], 0).sum(1)
            fine &= ours <= WORSE * theirs
    chosen = frames[fine]
    pairs = np.zeros_like(seen.usable)  # views that get a perspective camera
    pairs[chosen] = seen.usable[chosen]
    mine = usable.numpy() & fine[:, None]
    lift.points3d[chosen] = answer.points.numpy()[fine]
    depths = answer.translations[..., 2].numpy()
    lens = answer.optics
    focals, distortion = lens.focals.numpy(), lens.distortion.numpy()
    _, view = np.nonzero(pairs)
    lift.rotations[pairs] = answer.rotations.numpy()[mine]
    lift.translations[pairs] = answer.translations.numpy()[mine]
    lift.scales[pairs] = focals.mean(1)[view] / depths[mine]
    lift.focals[pairs] = focals[view]
    lift.principal_points[pairs] = lens.centres.numpy()[view]
    lift.distortions[pairs] = distortion[view]
    lift.camera_models[pairs] = 1 + lens.fisheye.numpy()[view]
    lift.reprojection_errors[pairs] = answer.errors.numpy()[mine]
    return lift


def _slice(seen: Observations, part: slice) -> Observations:
    return Observations(*(getattr(seen, field.name)[part] for field in fields(Observations)))
