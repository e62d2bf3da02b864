"""The feed-forward network as an ONNX file: keypoints in pixels in, structures and cameras out.

It computes the same as a lift with `refine: off`, in tensor operations for any number of frames and
views. It uses the torch twins that also train on a GPU (`models.network.reprojection_tensors`), and
has its own tensor version of the settling in `models.network.settling_kernels`. Geometry is in
float64, the network in float32, as in the compiled functions.

It does not include perspective refinement, the removal of noise, or the pixels where keypoints
were frozen in the fit.
"""

import io
import sys
import warnings
from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.lifting.fitted_prior import FittedPrior
from models.network.priors.prior import Prior
from models.network.priors.registry import make_prior
from models.network.reprojection_tensors import (
    WeakPerspective,
    fill_tensors,
    nearest_rotations,
    normalise,
    project,
    solve_cameras,
)
from models.network.settling import MIRROR, ROUNDS
from models.network.settling_kernels import DECISIVE, STIFFNESS
from models.numerics.tensor_systems import solve_symmetric
from models.settings.keypoints import MIN_CONFIDENCE, MIN_KEYPOINTS, MIN_SIZE

OPSET = 18
INPUTS = ("keypoints", "confidence")
OUTPUTS = ("points3d", "rotations", "scales", "translations")
LEAST = 1e-6  # of weights and scales: less would divide by zero


def onnx_file(prior: FittedPrior) -> bytes:
    """Return the network of a prior as an ONNX model.

    The tracer has global state and holds Python's lock for seconds. So a process that has other
    work runs this module in another process, with the weights on standard input and the file on
    standard output.

    Inputs
        `keypoints` (N, K, P, 2) float32, pixels, NaN where not observed; `confidence` (N, K, P)
        float32 in [0, 1], 0 where not observed.

    Outputs, float32, NaN where there is no answer
        `points3d` (N, P, 3) canonical; `rotations` (N, K, 3, 3), `scales` (N, K) in pixels per unit
        and `translations` (N, K, 2) in pixels: `pixel = scale (R X)_xy + translation`.

    Raises ValueError for a prior that removes noise before its network.
    """
    if prior.denoises:
        raise ValueError(
            "this model removes noise from its keypoints before the network, which the ONNX file"
            " does not include; fit with `denoising: false`"
        )
    network = _Lifting(prior).eval()
    keypoints = torch.zeros(2, 3, prior.keypoints_per_frame, 2)
    axes = {0: "frames", 1: "views"}
    file = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracer, which this is written for
        torch.onnx.export(
            network,
            (keypoints, torch.ones(keypoints.shape[:3])),
            file,  # type: ignore[arg-type]  # any file will do
            input_names=INPUTS,
            output_names=OUTPUTS,
            opset_version=OPSET,
            dynamic_axes=dict.fromkeys((*INPUTS, *OUTPUTS), axes),
            dynamo=False,
        )
    return file.getvalue()


class _Seen(NamedTuple):
    """`models.capture.observations.Observations`, as tensors in float64."""

    keypoints: Tensor  # (N, K, P, 2)
    weights: Tensor  # (N, K, P)
    centres: Tensor  # (N, K, 2)
    sizes: Tensor  # (N, K)
    usable: Tensor  # (N, K)


class _Lifting(nn.Module):
    def __init__(self, prior: FittedPrior) -> None:
        super().__init__()
        known = prior.capture.known
        self.network: Prior = make_prior(prior.config, int(known.sum()))
        self.network.load_state_dict(prior.weights)
        self.foreshortening, self.settling = prior.foreshortening, prior.settling
        self.register_buffer("known", torch.from_numpy(known.nonzero()[0]))
        self.unknown: Tensor
        self.register_buffer("unknown", torch.from_numpy(~known)[None, :, None])

    def forward(self, keypoints: Tensor, confidence: Tensor) -> tuple[Tensor, ...]:
        known: Tensor = self.known  # type: ignore[assignment]
        seen = _observed(keypoints[:, :, known].double(), confidence[:, :, known].double())
        points, guesses = self._read(seen, seen.keypoints)
        filled = self._filled(seen, points, guesses)
        again, guesses_again = self._read(seen, filled)
        shown = seen.weights.sum(-1)  # (N, K)
        hides = ((shown > 0) & (shown < seen.weights.shape[-1])).any(-1)  # (N,)
        points = torch.where(hides[:, None, None], again, points)
        guesses = torch.where(hides[:, None, None, None], guesses_again, guesses)
        points, guesses = self._settled(seen, points, guesses)
        cameras = solve_cameras(points[:, None], seen.keypoints, seen.weights, guesses)
        return self._answers(seen, points, cameras)

    def _read(self, seen: _Seen, views: Tensor) -> tuple[Tensor, Tensor]:
        """Structures (N, P, 3) and guesses (N, K, 3, 3) of normalised views (N, K, P, 2)."""
        codes, matrices = self.network.encode(views.float().flatten(0, 1))
        guesses = nearest_rotations(matrices.double()).reshape(*views.shape[:2], 3, 3)
        votes = seen.weights.sum(-1)
        votes = votes / votes.sum(-1, keepdim=True).clamp_min(LEAST)  # (N, K)
        codes = codes.reshape(*views.shape[:2], -1)  # (N, K, B)
        code = (votes.float()[..., None] * codes).sum(1)
        return normalise(self.network.decode(code).double()), guesses

    def _filled(self, seen: _Seen, points: Tensor, guesses: Tensor) -> Tensor:
        cameras = solve_cameras(points[:, None], seen.keypoints, seen.weights, guesses)
        filled = fill_tensors(project(points[:, None], cameras), seen.keypoints, seen.weights)
        return torch.where(seen.weights.sum(-1)[..., None, None] > 0, filled, 0.0)

    def _settled(self, seen: _Seen, points: Tensor, guesses: Tensor) -> tuple[Tensor, Tensor]:
        """Settle the frames that the policy selects, as `settle_frame` does."""
        k = self.foreshortening
        if k == 0:
            return points, guesses
        one, error = _alternate(points, seen, guesses, k)
        other, error_of_other = _alternate(points, seen, guesses, -k)
        several = (seen.weights.sum(-1) > 0).sum(-1) > 1
        swap = several & (error_of_other < DECISIVE * error)
        settled = normalise(torch.where(swap[:, None, None], other, one))
        mirrored = ~swap if k < 0 else swap
        if not self.settling.every_frame:
            which = _misfits(points, seen, guesses) > self.settling.misfit_limit
            settled = torch.where(which[:, None, None], settled, points)
            mirrored = mirrored | ~which if k < 0 else mirrored & which
        mirror = torch.tensor(MIRROR, dtype=points.dtype)
        through = mirror[:, None] * guesses * mirror
        return (
            torch.where(mirrored[:, None, None], settled * mirror, settled),
            torch.where(mirrored[:, None, None, None], through, guesses),
        )

    def _answers(self, seen: _Seen, points: Tensor, cameras: WeakPerspective) -> tuple[Tensor, ...]:
        there = seen.usable.any(-1)[:, None, None]
        known: Tensor = self.known  # type: ignore[assignment]
        whole = points.new_zeros(points.shape[0], self.unknown.shape[1], 3)
        whole = whole.index_copy(1, known, points)
        whole = torch.where(there & ~self.unknown, whole, torch.nan)
        usable = seen.usable
        shift = cameras.translations * seen.sizes[..., None] + seen.centres
        return (
            whole.float(),
            torch.where(usable[..., None, None], cameras.rotations, torch.nan).float(),
            torch.where(usable, cameras.scales * seen.sizes, torch.nan).float(),
            torch.where(usable[..., None], shift, torch.nan).float(),
        )


def _observed(pixels: Tensor, confidence: Tensor) -> _Seen:
    """Normalise views as `models.capture.observations.as_observations` does."""
    there = ~torch.isnan(pixels).any(-1) & (confidence >= MIN_CONFIDENCE)  # NaN is not
    weights = torch.where(there, confidence, 0.0)
    pixels = torch.where(there[..., None], pixels, 0.0)
    whole = weights.sum(-1, keepdim=True).clamp_min(MIN_CONFIDENCE)  # (N, K, 1)
    centres = (weights[..., None] * pixels).sum(-2) / whole
    apart = torch.where(there[..., None], pixels - centres[..., None, :], 0.0)
    squared = (weights * apart.square().sum(-1)).sum(-1, keepdim=True) / whole
    sizes = squared.sqrt().clamp_min(MIN_SIZE)  # (N, K, 1)
    usable = (there.sum(-1) >= MIN_KEYPOINTS) & (sizes[..., 0] > MIN_SIZE)
    return _Seen(
        torch.where(usable[..., None, None], apart / sizes[..., None], 0.0),
        torch.where(usable[..., None], weights, 0.0),
        centres,
        torch.where(usable, sizes[..., 0], 1.0),
        usable,
    )


def _alternate(
    points: Tensor, seen: _Seen, guesses: Tensor, foreshortening: float
) -> tuple[Tensor, Tensor]:
    """Solve for cameras and structures in turn; return the structures and their errors (N,)."""
    target = seen.keypoints
    eye = torch.eye(3, dtype=points.dtype)
    for _ in range(ROUNDS):
        target, projected, axes = _straightened(points, target, seen, guesses, foreshortening)
        weighted = seen.weights[..., None] * (target - projected)  # (N, K, P, 2)
        pull = torch.einsum("nkpi,nkij->npj", weighted, axes)
        normal = torch.einsum("nkp,nkia,nkib->npab", seen.weights, axes, axes)
        points = points + solve_symmetric(normal + STIFFNESS * eye, pull[..., None])[..., 0]
    target, projected, _ = _straightened(points, target, seen, guesses, foreshortening)
    errors = (seen.weights[..., None] * (target - projected).square()).sum((1, 2, 3)).sqrt()
    return points, errors


def _straightened(
    points: Tensor, target: Tensor, seen: _Seen, guesses: Tensor, foreshortening: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return targets and projections under weak perspective, (N, K, P, 2) each, and the axes.

    Targets are the keypoints with the foreshortening taken out. Axes (N, K, 2, 3) are the scale
    times the first two rows of a view's rotation.
    """
    weights = seen.weights[..., None]
    cameras = solve_cameras(points[:, None], target, seen.weights, guesses)
    projected = project(points[:, None], cameras)
    share = weights / weights.sum(-2, keepdim=True).clamp_min(LEAST)
    depth = points[:, None] @ cameras.rotations[..., 2, :, None]  # (N, K, P, 1)
    depth = depth - (share * depth).sum(-2, keepdim=True)
    slopes = -depth * (projected - (share * target).sum(-2, keepdim=True))
    slopes = slopes - (share * slopes).sum(-2, keepdim=True)
    axes = cameras.scales[..., None, None] * cameras.rotations[..., :2, :]
    return seen.keypoints - foreshortening * slopes, projected, axes


def _misfits(points: Tensor, seen: _Seen, guesses: Tensor) -> Tensor:
    """Reprojection errors of frames (N,) in units of the structure, mean over what was observed."""
    cameras = solve_cameras(points[:, None], seen.keypoints, seen.weights, guesses)
    apart = (project(points[:, None], cameras) - seen.keypoints).square().sum(-1).sqrt()
    observed = (seen.weights > 0).to(points.dtype)
    scaled = (observed * apart).sum(-1) / cameras.scales.clamp_min(LEAST)
    return scaled.sum(-1) / observed.sum((1, 2)).clamp_min(1)


if __name__ == "__main__":
    sys.stdout.buffer.write(onnx_file(FittedPrior.from_bytes(sys.stdin.buffer.read())))
