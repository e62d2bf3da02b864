"""Fitting a prior to keypoints alone: minimise the reprojection error, resumably."""

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from models.cameras import project
from models.config import FitConfig
from models.distillation import Teachers, find_teachers, structure_loss, virtual_views
from models.fitted import CurvePoint, FittedPrior
from models.keypoints import Observations, as_observations
from models.prior import HierarchicalPrior, Reconstruction
from models.refinement import estimate_foreshortening
from models.weights import Arrays, Shapes, WeightsError, pack, read_about, unpack

CURVE_ROWS = 200
HANDEDNESS_FRAMES = 1000  # plenty to decide the handedness of a fit
REFRESHES = (0.5, 0.75)  # shares of the steps after which the network gets (new) teachers
VIRTUAL = 0.5  # share of a batch that virtual views take from then on
STRUCTURE = 3.0  # weight of the distance to the teachers next to the reprojection error
RECENT = 0.05  # weight of the newest batch in the running means


@dataclass(frozen=True)
class Progress:
    """Where a fit stands after one optimiser step."""

    step: int
    steps: int
    loss: float  # running mean over recent batches
    reprojection_error: float  # pixels, running mean over recent batches
    seconds_left: float


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
        checkpoint: bytes | None = None,
    ) -> None:
        """Prepare a fit of `keypoints` (N, K, P, 2) pixels, from a `checkpoint` if given.

        Raises
        ------
        ValueError
            When no frame has a usable view, or the arrays are malformed (see `as_observations`).
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
        self.config = config
        self.step = 0
        self.seconds = 0.0
        self._teachers: Teachers | None = None
        self._teacher_weights: Arrays = {}
        self._fingerprint = _fingerprint(observations)
        self._keypoints = torch.from_numpy(observations.keypoints[frames])
        self._weights = torch.from_numpy(observations.weights[frames])
        self._sizes = torch.from_numpy(observations.sizes[frames])
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
            loss, error = self._advance()
            self._loss = _running(self._loss, loss, first=self.step == 0)
            self._error = _running(self._error, error, first=self.step == 0)
            self.step += 1
            every = math.ceil(self.config.steps / CURVE_ROWS)
            if self.step % every == 0 or self.step == self.config.steps:
                self._curve.append(CurvePoint(self.step, self._loss, self._error))
            self.seconds += time.perf_counter() - started
            left = self.seconds / self.step * (self.config.steps - self.step)
            yield Progress(self.step, self.config.steps, self._loss, self._error, left)

    def result(self) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        every = slice(None, None, math.ceil(len(self._keypoints) / HANDEDNESS_FRAMES))
        keypoints, weights = self._keypoints[every], self._weights[every]
        with torch.inference_mode():
            seen = self._network(keypoints, weights)
            foreshortening = estimate_foreshortening(seen.points, keypoints, weights, seen.guesses)
        return FittedPrior(
            config=self.config,
            arrays={name: value.detach().clone() for name, value in self._parameters.items()},
            curve=tuple(self._curve),
            foreshortening=foreshortening,
        )

    def checkpoint(self) -> bytes:
        """Return everything needed to go on, as safetensors bytes."""
        arrays: Arrays = {}
        for name, parameter in self._parameters.items():
            arrays[f"weights.{name}"] = parameter.detach()
            # As long as there are no teachers, their network is zero.
            arrays[f"teacher.{name}"] = self._teacher_weights.get(name, torch.zeros_like(parameter))
            # Before the first step Adam has no moments: they are zero.
            moments = self._optimiser.state.get(parameter, {})
            for moment in ("exp_avg", "exp_avg_sq"):
                arrays[f"{moment}.{name}"] = moments.get(moment, torch.zeros_like(parameter))
        arrays["curve"] = torch.tensor(self._curve, dtype=torch.float64).reshape(-1, 3)
        arrays["state"] = torch.tensor(
            [self.step, self.seconds, self._loss, self._error], dtype=torch.float64
        )
        return pack(
            arrays,
            kind="checkpoint",
            about={"config": self.config.model_dump_json(), "data": self._fingerprint},
        )

    def _restore(self, data: bytes) -> None:
        shapes: Shapes = {"state": (4,), "curve": (None, 3)}
        for name, parameter in self._parameters.items():
            for group in ("weights", "teacher", "exp_avg", "exp_avg_sq"):
                shapes[f"{group}.{name}"] = tuple(parameter.shape)
        about = read_about(data, kind="checkpoint")
        if about.get("config") != self.config.model_dump_json():
            raise WeightsError("the checkpoint was made for another configuration; start anew")
        if about.get("data") != self._fingerprint:
            raise WeightsError("the checkpoint was made for other keypoints; start anew")
        arrays = unpack(data, shapes=shapes)
        step, self.seconds, self._loss, self._error = arrays["state"].tolist()
        self.step = int(step)
        self._curve = [
            CurvePoint(int(s), loss, error) for s, loss, error in arrays["curve"].tolist()
        ]
        refreshed = [step for step in self._refreshes() if step < self.step]
        with torch.no_grad():
            if refreshed:
                for name, parameter in self._parameters.items():
                    parameter.copy_(arrays[f"teacher.{name}"])
                self._teach(max(refreshed))
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
        if self.step in self._refreshes():
            self._teach(self.step)
        frames = torch.from_numpy(self._batch())
        if self._teachers is not None:
            frames = frames[: len(frames) - int(VIRTUAL * len(frames))]
        keypoints, weights = self._keypoints[frames], self._weights[frames]
        rate = (
            self.config.learning_rate / 2 * (1 + math.cos(math.pi * self.step / self.config.steps))
        )
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        if self._teachers is None:
            loss, distances = _loss(self._network(keypoints, weights), keypoints, weights)
            total = loss
        else:
            loss, distances, total = self._distil(self._teachers, frames)
        self._optimiser.zero_grad()
        torch.autograd.backward(total)
        self._optimiser.step()
        seen = weights > 0
        pixels = (distances.detach() * self._sizes[frames][..., None])[seen]
        return loss.item(), pixels.mean().item()

    def _distil(self, teachers: Teachers, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reprojection loss, its distances in `frames`, and the sum with the structure loss."""
        rng = np.random.default_rng([self.config.seed, self.step, 1])
        count = min(self.config.batch_size, len(self._keypoints)) - len(frames)
        structures, virtual, shown = virtual_views(teachers, self._weights, count, rng)
        keypoints = torch.cat((self._keypoints[frames], virtual))
        weights = torch.cat((self._weights[frames], shown))
        seen = self._network(keypoints, weights)
        loss, distances = _loss(seen, keypoints, weights)
        places = teachers.places[frames]
        taught = places >= 0
        total = loss
        if count or taught.any():
            points = torch.cat((seen.points[: len(frames)][taught], seen.points[len(frames) :]))
            truth = torch.cat((teachers.points[places[taught]], structures))
            total = loss + STRUCTURE * structure_loss(points, truth)
        return loss, distances[: len(frames)], total

    def _refreshes(self) -> list[int]:
        if not self.config.distillation:
            return []
        return [int(share * self.config.steps) for share in REFRESHES]

    def _teach(self, step: int) -> None:
        """Let the network as it stands, before `step`, settle its teachers.

        Checkpoints hold the network of that moment, which is less than its teachers.
        """
        self._teacher_weights = {
            name: value.detach().clone() for name, value in self._parameters.items()
        }
        self._teachers = find_teachers(
            self._network,
            self._keypoints,
            self._weights,
            most=self.config.steps // 3,  # a fit of few steps spends little on teachers
            seed=[self.config.seed, step, 2],
        )

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
    on_progress: Callable[[Progress], None] | None = None,
) -> FittedPrior:
    """Fit a prior to `keypoints` (N, K, P, 2) pixels; see `Trainer` for pauses and errors."""
    trainer = Trainer(keypoints, config or FitConfig(), confidence=confidence)
    for progress in trainer.run():
        if on_progress is not None:
            on_progress(progress)
    return trainer.result()


def _loss(seen: Reconstruction, keypoints: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Paper eq. "final_loss", and the distances (N, K, P) it is made of.

    The Frobenius norm of each view's reprojection error, as a weighted root mean square so that
    views with gaps count the same; the mean over the views that are there.
    """
    squared = (project(seen.points[:, None], seen.cameras) - keypoints).square().sum(-1)
    total = weights.sum(-1)  # (N, K)
    # The small constant keeps the root's gradient finite where a view is met exactly.
    norms = ((weights * squared).sum(-1) / total.clamp_min(1e-6) + 1e-8).sqrt()
    there = (total > 0).to(norms.dtype)
    return (norms * there).sum() / there.sum(), squared.detach().sqrt()


def _running(mean: float, value: float, *, first: bool) -> float:
    return value if first else mean + RECENT * (value - mean)


def _fingerprint(observations: Observations) -> str:
    digest = hashlib.sha256()
    for array in (observations.keypoints, observations.weights):
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
