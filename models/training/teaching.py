"""The parts of a fit besides the network's weights: cameras, the network's errors, teachers."""

import logging
import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from torch import Tensor

from models.bundle.initial_poses import WeakPerspectiveScene
from models.bundle.known_structures import KnownStructures
from models.bundle.problem import Scene, Views, views_apart
from models.calibrating.handedness import NothingFoundError, same_handedness
from models.calibrating.image_sizes import ImageSizes
from models.calibrating.result import SelfCalibration
from models.calibrating.self_calibration import (
    CalibrationTask,
    calibrate_by_geometry,
    most_frames,
    self_calibrate,
    task_of,
)
from models.lifting.curve import CurveRow
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames, join, weak_perspective
from models.lifting.skeleton_lengths import SkeletonLengths, learn_skeleton_lengths
from models.lifting.usual_structure import learn_usual_structure
from models.network.answers import Usual
from models.network.priors.prior import Prior
from models.numerics.steps import Steps, finished
from models.posterior.posterior import Posterior
from models.settings.config import FitConfig
from models.training.batches import Data, noisy_frames
from models.training.causes_of_fit import with_causes
from models.training.fit_posterior import posterior_of
from models.training.known_structures import believe_where_better, known_structures
from models.training.network_errors import learn_errors_of_network
from models.training.state import TeachingState
from models.training.teachers import (
    Teachers,
    draw_frames,
    find_teachers,
    foreshortening_of,
    perspective_teachers,
)
from models.training.usual import learn_usual

logger = logging.getLogger(__name__)

LIFTED_FRAMES = 256  # between two chances to stop
HANDEDNESS_FRAMES = 1000  # plenty to decide the handedness of a fit
LENGTH_FRAMES = 2000  # plenty to learn the lengths of a skeleton
HIDDEN = 0.01  # if more keypoints are seen by fewer than two views, structures are learnt again
ROUNDS = 3  # of that


class Teaching:
    """The cameras and the teachers of a fit, made from the network as it is at the time."""

    def __init__(
        self,
        network: Prior,
        data: Data,
        unseen: Data,
        config: FitConfig,
        image_sizes: ImageSizes | None,
        removed_noise: tuple[float, float] | None,
        detected: Data,
        edges: NDArray[np.int64],
    ) -> None:
        self.state = TeachingState("not_sought" if config.refine == "off" else "sought")
        self.teachers: Teachers | None = None
        self.self_calibration: SelfCalibration | None = None
        self.structure = np.empty((0, 3), np.float32)  # of a result; see `FittedCapture`
        self._network = network
        self._data = data
        self._unseen = unseen  # frames that are held out from training
        self._config = config
        self._image_sizes = image_sizes
        self._removed_noise = removed_noise  # and the noise left, pixels
        self._detected = detected  # the data before noise was removed, weighted by this noise
        self._edges = edges  # (E, 2) of the skeleton
        self._foreshortening: float | None = None  # of the network as it is, once it is known
        self._task: CalibrationTask | None = None  # of a search for cameras, with their geometry

    def settle_by_geometry(self) -> Iterator[None]:
        """Find static cameras from keypoints alone, if possible, and make teachers with them.

        Yields now and then. If it is stopped there, no cameras are found.
        """
        frames = self._frames_of_several_views(0).sort().values
        if not len(frames):
            return
        found = yield from self._found_by(self._settled())
        if found is None:
            return
        calibration, scene = found
        self.self_calibration = calibration
        self.state.cameras, self.state.found_at_step = "found", 0
        if not self._config.distillation:
            return
        points, rotations, translations, _ = map(
            torch.from_numpy, views_apart(scene, calibration.rig)
        )
        there = (self._data.weights[frames] > 0).any(-1)
        self._teach(calibration, frames, there, (points, rotations, translations))

    def make_teachers(self, step: int, *, most: int) -> Iterator[None]:
        """Make new teachers, after estimating the cameras if they are sought.

        Yields now and then. If it is stopped there, everything made until then is kept. A fit that
        is resumed at the same step continues with the cameras it had found. Without cameras, at
        most `most` teachers are settled.
        """
        config, data, state = self._config, self._data, self.state
        if state.cameras == "not_sought":
            if config.distillation:
                seed = [config.seed, step, 2]
                self.teachers = find_teachers(
                    self._network, data.keypoints, data.weights, most=most, seed=seed
                )
            return
        frames = self._frames_of_several_views(step)
        if not len(frames):
            return
        if self.self_calibration is None:
            yield from self._find_cameras()
            if self.self_calibration is None:
                return
            state.cameras, state.found_at_step = "found", step
        elif state.found_at_step != step:
            self.self_calibration = self._with_network_errors(self.self_calibration, step)
        if config.distillation:
            yield from self._make_perspective_teachers(self.self_calibration, frames, step)

    def network_changed(self) -> None:
        """Forget what was found out about the network; called whenever it has learnt."""
        self._foreshortening = None

    def stop_searching(self) -> None:
        """Continue without cameras if they are not found by now."""
        if self.self_calibration is None:
            self.state.cameras = "not_sought"

    def result(self, step: int, curve: list[CurveRow]) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        found = self.self_calibration
        if found is None:
            return self.as_prior(None, curve)
        found = self._with_network_errors(found, step)
        frames = self._frames_of_several_views(step)
        structures, lift = finished(
            self._learn_structures(found, frames, seed=[self._config.seed, step, 5])
        )
        if lift is not None:
            self.structure = learn_usual_structure(lift, found.shapes.mean)
        prior = self.as_prior(found, curve, structures=structures)
        skeleton = self._learn_lengths(prior, found)
        return prior if skeleton is None else self.as_prior(found, curve, skeleton, structures)

    def usual(self) -> Usual:
        """Return the usual range of the frames of the fit, with the present network."""
        return learn_usual(self.as_prior(None), self._data, self._unseen)

    def posterior(self, shares_left: tuple[float, float]) -> Posterior | None:
        """Learn how far answers may be off; None without perspective cameras."""
        found, frames = self.self_calibration, self._frames_of_several_views(0).sort().values
        if found is None or not len(frames):
            return None
        seen = self._data, self._detected, frames
        return posterior_of(found, self.as_prior(found), *seen, shares_left)

    def as_prior(
        self,
        self_calibration: SelfCalibration | None,
        curve: list[CurveRow] | None = None,
        skeleton: SkeletonLengths | None = None,
        structures: KnownStructures | None = None,
    ) -> FittedPrior:
        """Return a prior with the present network and what is given."""
        foreshortening = self._foreshortening_of_network()
        if self_calibration is not None:
            foreshortening = abs(foreshortening) * (-1 if self.state.mirrored else 1)
        return FittedPrior(
            config=self._config,
            arrays={n: value.detach().clone() for n, value in self._network.named_parameters()},
            curve=tuple(curve or ()),
            foreshortening=foreshortening,
            self_calibration=self_calibration,
            skeleton=skeleton,
            structures=structures,
        )

    def _foreshortening_of_network(self) -> float:
        if self._foreshortening is None:
            every, data = slice(None, None, self._every(HANDEDNESS_FRAMES)), self._data
            some = data.keypoints[every], data.weights[every]
            self._foreshortening = foreshortening_of(self._network, *some)
        return self._foreshortening

    def _every(self, most: int) -> int:
        """Return a part of the frames, at most so many."""
        return math.ceil(len(self._data.keypoints) / most)

    def _settled(self) -> Steps[tuple[SelfCalibration, Scene] | None]:
        """Find static cameras by geometry; if it does not decide, keep it for the search."""
        task = yield from self._task_of_all()
        found = yield from calibrate_by_geometry(task)
        if found is None:
            self._task = task.of(self._searched())
        return found

    def _task_of_all(self) -> Steps[CalibrationTask]:
        """Return the task of finding the cameras in all frames with two views or more."""
        frames, removed = self._frames_of_several_views(0).sort().values, self._removed_noise
        task = task_of(
            self._data.pixels(frames).double().numpy(),
            self._data.weights[frames].double().numpy(),
            self._config,
            self._image_sizes,
            detected=self._detected.pixels(frames).double().numpy(),
            noisy=removed and noisy_frames(self._data, self._detected, removed[0]),
            edges=self._edges,
        )
        return (yield from with_causes(task))

    def _searched(self) -> NDArray[np.int64]:
        """Return places among those frames, sorted, of the ones that a search uses."""
        frames = self._frames_of_several_views(0)
        used = frames[: most_frames(*self._data.keypoints.shape[1:3])]
        return torch.searchsorted(frames.sort().values, used).numpy()

    def _search(self, answers: WeakPerspectiveScene) -> Steps[tuple[SelfCalibration, Scene] | None]:
        task, self._task = self._task, None
        if task is None:  # the fit was resumed, or had no time for geometry
            task = (yield from self._task_of_all()).of(self._searched())
        return (yield from self_calibrate(task, answers))

    def _find_cameras(self) -> Iterator[None]:
        """Estimate the cameras, if this is possible."""
        frames = self._frames_of_several_views(0)[: len(self._searched())]
        prior = self.as_prior(None)
        lift = prior.lift(self._data.pixels(frames), confidence=self._data.weights[frames])
        answers = weak_perspective(lift)
        result = yield from self._found_by(self._search(answers))
        if result is None:
            return
        found, scene = result
        self.self_calibration = found
        scene_is_mirrored = not same_handedness(scene.points, answers.points)
        self.state.mirrored = (prior.foreshortening < 0) != scene_is_mirrored

    def _found_by(
        self, steps: Steps[tuple[SelfCalibration, Scene] | None]
    ) -> Steps[tuple[SelfCalibration, Scene] | None]:
        """Return the result of a search, with the noise that was removed before it."""
        try:
            result = yield from steps
        except (LinAlgError, NothingFoundError):
            logger.warning("The keypoints do not determine the cameras", exc_info=True)
            return None
        if result is None or self._removed_noise is None:
            return result
        (found, scene), (noise, left) = result, self._removed_noise
        reason = f"{found.reason}; {noise:.3g} px of noise were removed"
        return replace(found, reason=reason, noise=max(found.noise, left)), scene

    def _learn_lengths(
        self, prior: FittedPrior, found: SelfCalibration | None
    ) -> SkeletonLengths | None:
        """Learn which edges of the skeleton keep their lengths, if white noise was removed.

        Other errors of detectors are not white and look like edges of constant length.
        """
        if found is None or self._removed_noise is None or not found.static.all():
            return None
        if not self._config.bone_lengths or not len(self._edges):
            return None
        frames = torch.arange(0, len(self._detected.weights), self._every(LENGTH_FRAMES))
        pixels, weights = self._data.pixels(frames), self._data.weights[frames]
        detected = self._detected.pixels(frames), self._detected.weights[frames].double()
        return learn_skeleton_lengths(
            self._edges,
            prior.lift(pixels, confidence=weights, refine="full"),
            Views(*(part.numpy() for part in detected)),
            found.rig,
            unit=found.unit,
            noise=self._removed_noise[0],
        )

    def _with_network_errors(self, self_calibration: SelfCalibration, step: int) -> SelfCalibration:
        """Measure the present errors of the network, and the time that this takes."""
        started = time.perf_counter()
        seed = [self._config.seed, step, 3]
        measured = learn_errors_of_network(
            self_calibration, self._data, self._unseen, self.as_prior, seed=seed
        )
        self.state.result_seconds = time.perf_counter() - started
        return measured

    def _frames_of_several_views(self, step: int) -> Tensor:
        """Draw frames (T,) with two views or more, all of them if they are not too many."""
        weights, width = self._data.weights, self._network.width()
        seed = [self._config.seed, step, 2]
        return draw_frames(weights, most=len(weights), width=width, seed=seed)

    def _learn_structures(
        self, found: SelfCalibration, frames: Tensor, *, seed: list[int]
    ) -> Steps[tuple[KnownStructures | None, LiftedFrames | None]]:
        """Lift frames (T,), and again with their known structures if many keypoints are hidden.

        Yields now and then, to be stopped there. Returns the known structures, and the last lift.
        """
        if not len(frames):
            return None, None
        weights = self._data.weights[frames]
        hidden = float(((weights > 0).sum(1) < 2).double().mean())
        structures = lift = None

        def make_prior(known: KnownStructures | None) -> FittedPrior:
            return self.as_prior(found, structures=known)

        for _ in range(ROUNDS if hidden > HIDDEN else 1):
            lift = yield from self._lifted(make_prior(structures), frames)
            learnt = known_structures(lift, weights.numpy(), found.shapes.mean)
            if learnt is None:
                break
            if structures is None:
                learnt = believe_where_better(learnt, self._unseen, make_prior, seed=seed)
            else:
                learnt = learnt._replace(believed=structures.believed)
            if not learnt.believed.any():
                break
            structures = learnt
        return structures, lift

    def _lifted(self, prior: FittedPrior, frames: Tensor) -> Steps[LiftedFrames]:
        """Return the refined lift of frames (T,); yields now and then, to be stopped there."""
        lifts = []
        for some in torch.split(frames, LIFTED_FRAMES):
            yield
            pixels, weights = self._data.pixels(some), self._data.weights[some]
            lifts.append(prior.lift(pixels, confidence=weights, refine="full"))
        return join(lifts)

    def _make_perspective_teachers(
        self, self_calibration: SelfCalibration, frames: Tensor, step: int
    ) -> Iterator[None]:
        """Make teachers of frames (T,), as far as they can be refined."""
        started = time.perf_counter()
        _, lift = yield from self._learn_structures(
            self_calibration, frames, seed=[self._config.seed, step, 5]
        )
        if self.state.result_seconds is not None:  # they are learnt at the end, too
            self.state.result_seconds += time.perf_counter() - started
        if lift is None:
            return
        observed = torch.from_numpy(lift.camera_models > 0)  # (T, K)
        refined = observed.any(1)
        if not refined.any():
            return
        rotations = torch.from_numpy(lift.rotations)
        rotations = torch.where(observed[..., None, None], rotations, torch.eye(3))
        translations = torch.from_numpy(lift.translations)
        translations = torch.where(observed[..., None], translations, 1.0)
        seen = torch.from_numpy(lift.points3d)[refined], rotations[refined], translations[refined]
        self._teach(self_calibration, frames[refined], observed[refined], seen)

    def _teach(
        self,
        found: SelfCalibration,
        frames: Tensor,
        observed: Tensor,
        seen: tuple[Tensor, Tensor, Tensor],
    ) -> None:
        """Make teachers of structures and poses `seen` in frames (T,); `observed` is (T, K)."""
        noise = found.noise / float(self._data.sizes[frames][observed].mean())
        count, mirrored = len(self._data.keypoints), self.state.mirrored
        self.teachers = perspective_teachers(
            *seen, observed, frames, count, noise=noise, reflected=mirrored
        )
