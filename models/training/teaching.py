"""What a fit learns beside the network's weights: cameras, how far off it is, teachers."""

import logging
import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.linalg import LinAlgError  # type: ignore[attr-defined]

from models.bundle.shape_model import align, learn_doubts, no_doubts
from models.calibrating.self_calibration import Answers as WeakPerspectiveAnswers
from models.calibrating.self_calibration import (
    Discovery,
    ImageSizes,
    NothingFoundError,
    discover,
    most_frames,
    same_hand,
)
from models.capture.denoising import ViewModel
from models.lifting.curve import CurvePoint
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import Lift, join
from models.network.priors.prior import Prior
from models.network.settling import (
    SETTLE_ALL,
    SETTLE_NONE,
    estimate_foreshortening,
    settle_beyond,
)
from models.settings.config import FitConfig
from models.training.batches import Data
from models.training.teachers import Teachers, draw_teachers, find_teachers, perspective_teachers

logger = logging.getLogger(__name__)

SLICE = 256  # frames between two chances to stop
HANDEDNESS_FRAMES = 1000  # plenty to decide the handedness of a fit
DOUBT_FRAMES = 600  # plenty to learn what the network's errors are like
USUAL_SHARE = 0.95  # of these frames: so many have a misfit that is usual for the network
LEAST_DOUBTED = 5  # of these frames
MOST_DOUBTED = 8  # views; with more it errs as with so many


class Teaching:
    """The cameras and the teachers of a fit, made from the network as it is at the time."""

    def __init__(
        self,
        network: Prior,
        data: Data,
        config: FitConfig,
        image_sizes: ImageSizes | None,
        denoiser: ViewModel | None,
    ) -> None:
        self.teachers: Teachers | None = None
        self.found: Discovery | None = None
        self.found_at = -1  # step; what is interrupted there goes on with what was found
        self.mirrored = False  # whether the network's structures are mirror images
        self.given_up = config.refine == "off"  # cameras are not looked for
        self.doubting = 0.0  # seconds that it took to learn the network's doubts, last time
        self._network = network
        self._data = data
        self._config = config
        self._image_sizes = image_sizes
        self._denoiser = denoiser

    def refresh(self, step: int, *, most: int) -> Iterator[None]:
        """Make teachers anew, and find the cameras first if need be; yields now and then.

        `most` teachers are settled at most, if no cameras are to be found.
        """
        config, data = self._config, self._data
        seed = [config.seed, step, 2]
        if self.given_up:
            if config.distillation:
                self.teachers = find_teachers(
                    self._network, data.keypoints, data.weights, most=most, seed=seed
                )
            return
        widest = data.weights.shape[1] * self._network.width()
        drawn, places = draw_teachers(
            data.weights, most=len(data.weights), widest=widest, seed=seed
        )
        if not len(drawn):
            return
        if self.found is None:
            yield from self._discover(drawn)
            if self.found is None:
                return
            self.found_at = step
        elif self.found_at != step:
            self.found = self._doubted(self.found, step)
        if config.distillation:
            yield from self._refine_teachers(drawn, places)

    def result(self, step: int, curve: list[CurvePoint]) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        found = None if self.found is None else self._doubted(self.found, step)
        return self._as_prior(found, self._denoiser, curve)

    def _as_prior(
        self,
        found: Discovery | None,
        denoiser: ViewModel | None = None,
        curve: list[CurvePoint] | None = None,
    ) -> FittedPrior:
        every = slice(None, None, math.ceil(len(self._data.keypoints) / HANDEDNESS_FRAMES))
        keypoints, weights = self._data.keypoints[every], self._data.weights[every]
        with torch.inference_mode():
            seen = self._network(keypoints, weights)
            foreshortening = estimate_foreshortening(seen.points, keypoints, weights, seen.guesses)
        if found is not None:
            foreshortening = abs(foreshortening) * (-1 if self.mirrored else 1)
        return FittedPrior(
            config=self._config,
            arrays={n: value.detach().clone() for n, value in self._network.named_parameters()},
            curve=tuple(curve or ()),
            foreshortening=foreshortening,
            found=found,
            denoiser=denoiser,
        )

    def _discover(self, frames: Tensor) -> Iterator[None]:
        """Find the cameras from frames with two views or more."""
        frames = frames[: most_frames(*self._data.keypoints.shape[1:3])]
        pixels, weights = self._data.pixels(frames), self._data.weights[frames]
        prior = self._as_prior(None)
        answers = weak_perspective_answers(prior.lift(pixels, confidence=weights))
        try:
            self.found, scene = yield from discover(
                pixels, weights.double(), answers, self._config, self._image_sizes
            )
        except (LinAlgError, NothingFoundError):
            logger.warning("The keypoints do not say what the cameras are", exc_info=True)
            return
        if self._denoiser is not None:
            reason = f"{self.found.reason}; {self._denoiser.noise:.3g} px of noise were removed"
            noise = max(self.found.noise, self._denoiser.left)
            self.found = replace(self.found, reason=reason, noise=noise)
        turned = not same_hand(scene.points, answers[0])
        self.mirrored = (prior.foreshortening < 0) != turned

    def _refine_teachers(self, frames: Tensor, places: Tensor) -> Iterator[None]:
        """Make teachers of `frames`, whose places among all frames are `places`."""
        prior = self._as_prior(self.found)
        parts = []
        for some in torch.split(frames, SLICE):
            yield
            parts.append(
                prior.lift(
                    self._data.pixels(some), confidence=self._data.weights[some], refine="full"
                )
            )
        lift = join(parts)
        there = torch.from_numpy(lift.camera_models > 0)
        fine = there.any(1)
        if not fine.any():
            return
        places[frames] = torch.where(fine, fine.cumsum(0) - 1, -1)
        sizes = self._data.sizes[frames][fine][there[fine]]
        rotations, translations = (
            torch.from_numpy(lift.rotations),
            torch.from_numpy(lift.translations),
        )
        self.teachers = perspective_teachers(
            torch.from_numpy(lift.points3d)[fine],
            torch.where(there[..., None, None], rotations, torch.eye(3))[fine],
            torch.where(there[..., None], translations, 1.0)[fine],
            there[fine],
            places,
            noise=prior.noise / float(sizes.mean()),
            reflected=self.mirrored,
        )

    def _doubted(self, found: Discovery, step: int) -> Discovery:
        """Learn how far the network is off with one view, two, and so on, settled or as it is.

        The measure is what refinement with the shape model alone makes of all views: one that
        trusts the network would find it ever more trustworthy.
        """
        started, data = time.perf_counter(), self._data
        there = (data.weights > 0).any(-1)
        several = (there.sum(1) > 1).nonzero()[:, 0]
        frames = several[:: math.ceil(max(len(several), 1) / DOUBT_FRAMES)]
        pixels, weights, there = data.pixels(frames), data.weights[frames], there[frames]
        found = replace(found, doubts=no_doubts(pixels.shape[2]), settling=SETTLE_ALL)
        lift = self._as_prior(found).lift(pixels, confidence=weights, refine="full")
        truth = torch.from_numpy(lift.points3d).double()
        known = truth.isfinite().all(-1).all(-1)
        rng = np.random.default_rng([self._config.seed, step, 3])
        order = (torch.from_numpy(rng.random(there.shape)) - there.double()).argsort(1).argsort(1)
        candidates = [found]
        for policy in (SETTLE_ALL, SETTLE_NONE):
            prior = self._as_prior(replace(found, settling=policy))
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
                # A lift settles every frame, or those whose misfit is unusual.
                limit = float(np.quantile(np.concatenate(misfits), USUAL_SHARE))
                chosen = policy if policy.every_frame else settle_beyond(limit)
                candidates.append(replace(found, doubts=doubts, settling=chosen))
        self.doubting = time.perf_counter() - started
        return min(candidates[1:] or candidates, key=lambda c: float(c.doubts.scales.sum()))


def _misfits(lift: Lift) -> NDArray[np.float64]:
    """Reprojection error (N,) in units of the structure, as the compiled network has it."""
    used = lift.keypoints_used
    total = np.nansum(used * lift.reprojection_errors / lift.scales, axis=1)
    return np.asarray(total / used.sum(1), np.float64)


def weak_perspective_answers(lift: Lift) -> WeakPerspectiveAnswers:
    """Structures, rotations, scales and translations (x, y) of a lift in float64.

    Harmless numbers stand where there is no answer.
    """
    none = ~torch.from_numpy(np.isfinite(lift.scales))

    def number(array: NDArray[np.float32], without: float) -> Tensor:
        return torch.nan_to_num(torch.from_numpy(array).double(), nan=without)

    rotations = number(lift.rotations, 0)
    rotations[none] = torch.eye(3, dtype=torch.float64)
    return (
        number(lift.points3d, 0),
        rotations,
        number(lift.scales, 1),
        number(lift.translations[..., :2], 0),
    )
