"""Fitting a prior to keypoints alone: minimise the reprojection error, resumably."""

import hashlib
import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.linalg import LinAlgError  # type: ignore[attr-defined]

from models.cameras import project
from models.config import FitConfig
from models.denoising import ViewModel, learn_views
from models.discovery import (
    Discovery,
    ImageSizes,
    NothingFoundError,
    discover,
    most_frames,
    same_hand,
)
from models.distillation import (
    Teachers,
    draw_teachers,
    drop_views,
    find_teachers,
    perspective_teachers,
    structure_loss,
    virtual_views,
)
from models.fitted import CurvePoint, FittedPrior, Lift, join, weak_perspective
from models.keypoints import Observations, as_observations
from models.perspective import array_shapes, from_arrays, to_arrays
from models.prior import HierarchicalPrior, Reconstruction
from models.refinement import estimate_foreshortening
from models.shape import align, learn_doubts, no_doubts
from models.weights import Arrays, Shapes, WeightsError, pack, read_about, unpack

logger = logging.getLogger(__name__)

CURVE_ROWS = 200
SLICE = 256  # frames between two chances to stop
HANDEDNESS_FRAMES = 1000  # plenty to decide the handedness of a fit
REFRESHES = (0.5, 0.75)  # shares of the steps after which settled teachers are (re)made
# Shares of the steps after which the cameras are found, and teachers with them, and after which the
# teachers are made anew, with the network in place of the shape model.
DISCOVERY = (1 / 3, 1 / 2, 2 / 3, 5 / 6)
DOUBT_FRAMES = 600  # plenty to learn what the network's errors are like
TRUSTED = 0.95  # share of these frames that are like the others
MOST_MISFIT = 1e9
LEAST_DOUBTED = 5  # of these frames
MOST_DOUBTED = 8  # views; with more it errs as with so many
VIRTUAL = (0.1, 0.5)  # shares of a batch that virtual views take, if all frames are taught or none
STRUCTURE = 3.0  # weight of the distance to the teachers next to the reprojection error
TAUGHT = 0.02  # weight of the (weak-perspective) reprojection error where teachers know perspective
RECENT = 0.05  # weight of the newest batch in the running means


@dataclass(frozen=True)
class Progress:
    """Where a fit stands after one optimiser step."""

    step: int
    steps: int
    loss: float  # running mean over recent batches
    reprojection_error: float  # pixels, running mean over recent batches
    seconds_left: float
    stage: Literal["training", "refining"] = "training"


class Trainer:
    """One fit, advanced step by step, that can be saved at any step and resumed bit for bit.

    Everything random is a function of the seed and the step, so a resumed fit ends in the very
    weights of an uninterrupted one (same data, same number of threads).
    """

    def __init__(
        self,
        keypoints: ArrayLike,
        config: FitConfig,
        *,
        confidence: ArrayLike | None = None,
        image_sizes: ImageSizes | None = None,
        checkpoint: bytes | None = None,
    ) -> None:
        """Prepare a fit of `keypoints` (N, K, P, 2) pixels, from a `checkpoint` if given.

        `image_sizes` are (width, height) in pixels, one per view, None where unknown.

        Raises
        ------
        ValueError
            When no frame has a usable view, the arrays are malformed (see `as_observations`), or
            `image_sizes` or the configuration's calibration do not have one entry per view.
        WeightsError
            When the checkpoint is damaged, or was made for other data or another configuration.
        """
        observations = as_observations(keypoints, confidence)
        frames = np.flatnonzero(observations.usable.any(1))
        if not frames.size:
            raise ValueError(
                "no frame has a usable view: a view needs at least 4 observed keypoints"
                " that do not all lie at one place"
            )
        views = observations.keypoints.shape[1]
        for name, given in (("image_sizes", image_sizes), ("calibration", config.calibration)):
            if given is not None and len(given) != views:
                raise ValueError(f"{name} must have one entry per view ({views}), got {len(given)}")
        self.config = config
        self.step = 0
        self.seconds = 0.0
        self._image_sizes = image_sizes
        self._taught = -1  # the step at which there were last teachers
        self._teachers: Teachers | None = None
        self._found: Discovery | None = None
        self._mirrored = False  # whether the network's structures are mirror images
        self._fingerprint = _fingerprint(observations, image_sizes)
        self._denoiser = learn_views(observations) if config.denoising else None
        if self._denoiser is not None:
            observations = self._denoiser.denoise(observations, range(views))
        self._keypoints = torch.from_numpy(observations.keypoints[frames])
        self._weights = torch.from_numpy(observations.weights[frames])
        self._sizes = torch.from_numpy(observations.sizes[frames])
        self._centres = torch.from_numpy(observations.centres[frames])
        self._loss = self._error = 0.0
        self._epoch = (-1, np.empty(0, np.int64))
        self._curve: list[CurvePoint] = []
        self._network = HierarchicalPrior(observations.keypoints.shape[2], config.dictionary_sizes)
        self._network.initialise(config.seed)
        self._parameters = dict(self._network.named_parameters())
        self._optimiser = torch.optim.Adam(
            self._parameters.values(), lr=config.learning_rate, fused=True
        )
        if checkpoint is not None:
            self._restore(checkpoint)

    def run(self) -> Iterator[Progress]:
        """Take the remaining steps, yielding after each; stop iterating to pause."""
        while self.step < self.config.steps:
            started = time.perf_counter()
            if self.step in self._refreshes() and self._taught != self.step:
                for _ in self._teach():
                    yield self._progress("refining")
                self._taught = self.step
            loss, error = self._advance()
            self._loss = _running(self._loss, loss, first=self.step == 0)
            self._error = _running(self._error, error, first=self.step == 0)
            self.step += 1
            every = math.ceil(self.config.steps / CURVE_ROWS)
            if self.step % every == 0 or self.step == self.config.steps:
                self._curve.append(CurvePoint(self.step, self._loss, self._error))
            self.seconds += time.perf_counter() - started
            yield self._progress("training")

    def _progress(self, stage: Literal["training", "refining"]) -> Progress:
        left = self.seconds / max(self.step, 1) * (self.config.steps - self.step)
        return Progress(self.step, self.config.steps, self._loss, self._error, left, stage)

    def result(self) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        found = None if self._found is None else self._doubted(self._found)
        return self._as_prior(found, self._denoiser)

    def _as_prior(self, found: Discovery | None, denoiser: ViewModel | None = None) -> FittedPrior:
        every = slice(None, None, math.ceil(len(self._keypoints) / HANDEDNESS_FRAMES))
        keypoints, weights = self._keypoints[every], self._weights[every]
        with torch.inference_mode():
            seen = self._network(keypoints, weights)
            foreshortening = estimate_foreshortening(seen.points, keypoints, weights, seen.guesses)
        if found is not None:
            foreshortening = abs(foreshortening) * (-1 if self._mirrored else 1)
        return FittedPrior(
            config=self.config,
            arrays={name: value.detach().clone() for name, value in self._parameters.items()},
            curve=tuple(self._curve),
            foreshortening=foreshortening,
            found=found,
            denoiser=denoiser,
        )

    def checkpoint(self) -> bytes:
        """Return everything needed to go on, as safetensors bytes."""
        arrays: Arrays = {}
        for name, parameter in self._parameters.items():
            arrays[f"weights.{name}"] = parameter.detach()
            # Before the first step Adam has no moments: they are zero.
            moments = self._optimiser.state.get(parameter, {})
            for moment in ("exp_avg", "exp_avg_sq"):
                arrays[f"{moment}.{name}"] = moments.get(moment, torch.zeros_like(parameter))
        arrays["curve"] = torch.tensor(self._curve, dtype=torch.float64).reshape(-1, 3)
        arrays["state"] = torch.tensor(
            [self.step, self.seconds, self._loss, self._error, self._taught, self._mirrored],
            dtype=torch.float64,
        )
        about = {"config": self.config.model_dump_json(), "data": self._fingerprint}
        if self._teachers is not None:
            teachers = self._teachers._asdict()
            for name in ("foreshortening", "noise"):
                teachers[name] = torch.tensor([teachers[name]], dtype=torch.float64)
            teachers["places"] = teachers["places"].double()
            arrays |= {f"teachers.{name}": value for name, value in teachers.items()}
            about["teachers"] = str(len(teachers["points"]))
        if self._found is not None:
            cameras, about["cameras"] = to_arrays(self._found)
            arrays |= {f"cameras.{name}": value for name, value in cameras.items()}
        return pack(arrays, kind="checkpoint", about=about)

    def _restore(self, data: bytes) -> None:
        shapes: Shapes = {"state": (6,), "curve": (None, 3)}
        for name, parameter in self._parameters.items():
            for group in ("weights", "exp_avg", "exp_avg_sq"):
                shapes[f"{group}.{name}"] = tuple(parameter.shape)
        about = read_about(data, kind="checkpoint")
        if about.get("config") != self.config.model_dump_json():
            raise WeightsError("the checkpoint was made for another configuration; start anew")
        if about.get("data") != self._fingerprint:
            raise WeightsError("the checkpoint was made for other keypoints; start anew")
        frames, views, count, _ = self._keypoints.shape
        if "teachers" in about:
            shapes |= {
                "teachers.points": (None, count, 3),
                "teachers.rotations": (None, views, 3, 3),
                "teachers.seen": (None, views),
                "teachers.ups": (None, 3),
                "teachers.places": (frames,),
                "teachers.foreshortening": (1,),
                "teachers.noise": (1,),
            }
        if "cameras" in about:
            for name, shape in array_shapes(count, views).items():
                shapes[f"cameras.{name}"] = shape
        arrays = unpack(data, shapes=shapes)
        step, self.seconds, self._loss, self._error, taught, mirrored = arrays["state"].tolist()
        self.step, self._taught, self._mirrored = int(step), int(taught), mirrored > 0
        self._curve = [
            CurvePoint(int(s), loss, error) for s, loss, error in arrays["curve"].tolist()
        ]
        if "teachers" in about:
            parts = _under("teachers.", arrays)
            self._teachers = Teachers(
                points=parts["points"],
                rotations=parts["rotations"],
                seen=parts["seen"],
                ups=parts["ups"],
                places=parts["places"].long(),
                foreshortening=parts["foreshortening"].item(),
                noise=parts["noise"].item(),
            )
        if "cameras" in about:
            self._found = from_arrays(_under("cameras.", arrays), about["cameras"])
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                parameter.copy_(arrays[f"weights.{name}"])
                if self.step:
                    self._optimiser.state[parameter] = {
                        "step": torch.tensor(float(self.step)),
                        "exp_avg": arrays[f"exp_avg.{name}"],
                        "exp_avg_sq": arrays[f"exp_avg_sq.{name}"],
                    }

    def _advance(self) -> tuple[float, float]:
        """Take one optimiser step; the loss and the reprojection error in pixels."""
        frames = torch.from_numpy(self._batch())
        if self._teachers is not None:
            taught = float((self._teachers.places >= 0).double().mean())
            virtual = VIRTUAL[1] + (VIRTUAL[0] - VIRTUAL[1]) * taught if self._found else VIRTUAL[1]
            frames = frames[: len(frames) - int(virtual * len(frames))]
        for group in self._optimiser.param_groups:
            group["lr"] = self._rate()
        keypoints, weights = self._keypoints[frames], self._weights[frames]
        if self._teachers is None:
            norms, distances = _distances(self._network(keypoints, weights), keypoints, weights)
            total = loss = norms.nanmean()
        else:
            loss, distances, total = self._distil(self._teachers, frames)
        self._optimiser.zero_grad()
        torch.autograd.backward(total)
        self._optimiser.step()
        pixels = (distances.detach() * self._sizes[frames][..., None])[weights > 0]
        return loss.item(), pixels.mean().item()

    def _rate(self) -> float:
        """Return the learning rate: half a cosine, two if the cameras are found on the way."""
        start, end, rate = 0, self.config.steps, self.config.learning_rate
        if self._found is not None:
            start = self._refreshes()[0]
        return rate / 2 * (1 + math.cos(math.pi * (self.step - start) / (end - start)))

    def _distil(self, teachers: Teachers, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reprojection loss, its distances in `frames`, and the sum with the structure loss."""
        rng = np.random.default_rng([self.config.seed, self.step, 1])
        count = min(self.config.batch_size, len(self._keypoints)) - len(frames)
        structures, virtual, shown = virtual_views(teachers, self._weights, count, rng)
        own = self._weights[frames]
        places = teachers.places[frames]
        taught = places >= 0
        if self._found is not None:
            own = torch.where(taught[:, None, None], drop_views(own, rng), own)
        keypoints = torch.cat((self._keypoints[frames], virtual))
        weights = torch.cat((own, shown))
        seen = self._network(keypoints, weights)
        norms, distances = _distances(seen, keypoints, weights)
        loss = norms.nanmean()
        total = loss
        if count or taught.any():
            points = torch.cat((seen.points[: len(frames)][taught], seen.points[len(frames) :]))
            truth = torch.cat((teachers.points[places[taught]], structures))
            if self._found is not None:
                known = torch.cat((taught, torch.ones(count, dtype=torch.bool)))
                total = (norms * torch.where(known, TAUGHT, 1.0)[:, None]).nanmean()
            total = total + STRUCTURE * structure_loss(points, truth)
        # The views that were taken away are measured all the same, so that the curve goes on.
        return loss, distances[: len(frames)], total

    def _refreshes(self) -> list[int]:
        if not self.config.distillation and self.config.refine == "off":
            return []
        shares = REFRESHES if self.config.refine == "off" else DISCOVERY
        return [int(share * self.config.steps) for share in shares]

    def _teach(self) -> Iterator[None]:
        """Let teachers be settled, and find the cameras first if need be; yields now and then."""
        seed = [self.config.seed, self.step, 2]
        if self.config.refine == "off":
            # A fit of few steps spends little on teachers.
            most = self.config.steps // 3
            self._teachers = find_teachers(
                self._network, self._keypoints, self._weights, most=most, seed=seed
            )
            return
        widest = self._network.widest(self._weights)
        drawn, places = draw_teachers(
            self._weights, most=len(self._weights), widest=widest, seed=seed
        )
        if not len(drawn):
            return
        if self._found is None:
            yield from self._discover(drawn)
            if self._found is None:
                return
        else:
            self._found = self._doubted(self._found)
        if self.config.distillation:
            yield from self._refine_teachers(drawn, places)

    def _discover(self, frames: Tensor) -> Iterator[None]:
        """Find the cameras from frames with two views or more."""
        frames = frames[: most_frames(*self._keypoints.shape[1:3])]
        pixels, weights = self._pixels(frames), self._weights[frames]
        prior = self._as_prior(None)
        answers = weak_perspective(prior.lift(pixels, confidence=weights))
        try:
            self._found, scene = yield from discover(
                pixels, weights.double(), answers, self.config, self._image_sizes
            )
        except (LinAlgError, NothingFoundError):
            logger.warning("The keypoints do not say what the cameras are", exc_info=True)
            return
        if self._denoiser is not None:
            reason = f"{self._found.reason}; {self._denoiser.noise:.3g} px of noise were removed"
            noise = max(self._found.noise, self._denoiser.left)
            self._found = replace(self._found, reason=reason, noise=noise)
        turned = not same_hand(scene.points, answers[0])
        self._mirrored = (prior.foreshortening < 0) != turned

    def _refine_teachers(self, frames: Tensor, places: Tensor) -> Iterator[None]:
        """Make teachers of `frames`, whose places among all frames are `places`."""
        prior = self._as_prior(self._found)
        parts = []
        for some in torch.split(frames, SLICE):
            yield
            parts.append(
                prior.lift(self._pixels(some), confidence=self._weights[some], refine="full")
            )
        lift = join(parts)
        there = torch.from_numpy(lift.camera_models > 0)
        fine = there.any(1)
        if not fine.any():
            return
        places[frames] = torch.where(fine, fine.cumsum(0) - 1, -1)
        sizes = self._sizes[frames][fine][there[fine]]
        rotations, translations = (
            torch.from_numpy(lift.rotations),
            torch.from_numpy(lift.translations),
        )
        self._teachers = perspective_teachers(
            torch.from_numpy(lift.points3d)[fine],
            torch.where(there[..., None, None], rotations, torch.eye(3))[fine],
            torch.where(there[..., None], translations, 1.0)[fine],
            there[fine],
            places,
            noise=prior.noise / float(sizes.mean()),
            reflected=self._mirrored,
        )

    def _doubted(self, found: Discovery) -> Discovery:
        """Learn how far the network is off with one view, two, and so on, settled or as it is.

        The measure is what refinement with the shape model alone makes of all views: one that
        trusts the network would find it ever more trustworthy.
        """
        there = (self._weights > 0).any(-1)
        several = (there.sum(1) > 1).nonzero()[:, 0]
        frames = several[:: math.ceil(max(len(several), 1) / DOUBT_FRAMES)]
        pixels, weights, there = self._pixels(frames), self._weights[frames], there[frames]
        found = replace(found, doubts=no_doubts(pixels.shape[2]), trusted=0.0)
        lift = self._as_prior(found).lift(pixels, confidence=weights, refine="full")
        truth = torch.from_numpy(lift.points3d).double()
        known = truth.isfinite().all(-1).all(-1)
        rng = np.random.default_rng([self.config.seed, self.step, 3])
        order = (torch.from_numpy(rng.random(there.shape)) - there.double()).argsort(1).argsort(1)
        candidates = [found]
        for trusted in (0.0, MOST_MISFIT):
            prior = self._as_prior(replace(found, trusted=trusted))
            errors, misfits = [], []
            for count in range(1, min(pixels.shape[1], MOST_DOUBTED) + 1):
                which = known & (there.sum(1) >= count)
                if which.sum() < LEAST_DOUBTED:
                    break
                shown = (weights * (order < count)[..., None])[which]
                answer = prior.lift(pixels[which], confidence=shown, refine="off")
                points = torch.from_numpy(answer.points3d).double()
                aligned, _ = align(points, found.shapes.mean)
                errors.append(align(truth[which], aligned)[0] - aligned)
                misfits.append(_misfits(answer))
            if errors:
                doubts = learn_doubts(errors, found.shapes.mean)
                limit = np.quantile(np.concatenate(misfits), TRUSTED) if trusted else 0.0
                candidates.append(replace(found, doubts=doubts, trusted=float(limit)))
        return min(candidates[1:] or candidates, key=lambda c: float(c.doubts.scales.sum()))

    def _pixels(self, frames: Tensor) -> Tensor:
        """Keypoints (T, K, P, 2) of some frames in pixels."""
        sizes, centres = self._sizes[frames].double(), self._centres[frames].double()
        return self._keypoints[frames] * sizes[..., None, None] + centres[..., None, :]

    def _batch(self) -> NDArray[np.int64]:
        """Frames of this step: epoch after epoch, each in an order of its own."""
        count, size = len(self._keypoints), min(self.config.batch_size, len(self._keypoints))
        places = np.arange(self.step * size, (self.step + 1) * size)
        epochs = places // count
        picked = np.empty(size, np.int64)
        for epoch in np.unique(epochs):
            if epoch != self._epoch[0]:
                order = np.random.default_rng([self.config.seed, epoch]).permutation(count)
                self._epoch = (int(epoch), order)
            here = epochs == epoch
            picked[here] = self._epoch[1][places[here] % count]
        return picked


def fit(
    keypoints: ArrayLike,
    config: FitConfig | None = None,
    *,
    confidence: ArrayLike | None = None,
    image_sizes: ImageSizes | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> FittedPrior:
    """Fit a prior to `keypoints` (N, K, P, 2) pixels; see `Trainer` for pauses and errors."""
    trainer = Trainer(
        keypoints, config or FitConfig(), confidence=confidence, image_sizes=image_sizes
    )
    for progress in trainer.run():
        if on_progress is not None:
            on_progress(progress)
    return trainer.result()


def _distances(seen: Reconstruction, keypoints: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Terms (N, K) of the paper's eq. "final_loss", and the distances (N, K, P) they are made of.

    The Frobenius norm of each view's reprojection error, as a weighted root mean square so that
    views with gaps count the same; NaN for views that are not there.
    """
    squared = (project(seen.points[:, None], seen.cameras) - keypoints).square().sum(-1)
    total = weights.sum(-1)  # (N, K)
    # The small constant keeps the root's gradient finite where a view is met exactly.
    norms = ((weights * squared).sum(-1) / total.clamp_min(1e-6) + 1e-8).sqrt()
    return torch.where(total > 0, norms, torch.nan), squared.detach().sqrt()


def _misfits(lift: Lift) -> NDArray[np.float64]:
    """Reprojection error (N,) in units of the structure, as `models.refinement.misfit`."""
    used = lift.keypoints_used
    total = np.nansum(used * lift.reprojection_errors / lift.scales, axis=1)
    return np.asarray(total / used.sum(1), np.float64)


def _running(mean: float, value: float, *, first: bool) -> float:
    return value if first else mean + RECENT * (value - mean)


def _under(prefix: str, arrays: Arrays) -> Arrays:
    """Return the arrays whose names begin with `prefix`, without it."""
    return {n.removeprefix(prefix): value for n, value in arrays.items() if n.startswith(prefix)}


def _fingerprint(observations: Observations, image_sizes: ImageSizes | None) -> str:
    digest = hashlib.sha256(repr(image_sizes and [s and tuple(s) for s in image_sizes]).encode())
    for array in (observations.keypoints, observations.weights):
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
