"""Fitting a prior to keypoints alone: minimise the reprojection error, resumably."""

import math
from collections.abc import Callable, Iterator

import torch
from numpy.typing import ArrayLike

from models.calibrating.image_sizes import ImageSizes
from models.findings.advice import attempt
from models.findings.finding import Finding
from models.lifting.curve import CurveRow
from models.lifting.fitted_prior import FittedPrior
from models.network.answers import nothing_unusual
from models.network.priors.registry import make_prior
from models.settings.config import FitConfig
from models.settings.keypoints import check_confidence, check_edges, check_keypoints
from models.settings.times import check_times
from models.training import checkpoints
from models.training.batches import Batches, Data
from models.training.budget import (
    CALIBRATION_LIMIT,
    PLAN_EVERY,
    WARM_UP_STEPS,
    can_afford_refresh,
    plan_within_budget,
    seconds_left,
)
from models.training.causes_of_fit import observe_mended
from models.training.checkpoints import Checkpoint
from models.training.fit_posterior import with_posterior
from models.training.holdout import Holdout, split
from models.training.keypoints_of_fit import (
    among_known,
    check_entries_per_view,
    edges_among_known,
    usable_frames,
)
from models.training.learner import Learner, begin_with
from models.training.progress import Progress, Stage, StoppedBy
from models.training.schedule import Schedule
from models.training.state import BestError, TrainerState
from models.training.synchronising import put_in_step
from models.training.teaching import Teaching

CURVE_ROWS = 200
NEWEST_WEIGHT = 0.05  # of the newest batch in the running means
# Early stopping: in PATIENCE of the steps, the error of held-out frames must fall by TOLERANCE.
PATIENCE, TOLERANCE = 0.1, 0.01
HOLDOUT_CHECKS = 100  # measurements of the held-out error in a fit
LAST_SHARE = 0.1  # of the steps, which a fit that stopped improving still takes
TEACHER_SHARE = 3  # steps for each weak-perspective teacher at least, as each takes time


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
        times: ArrayLike | None = None,
        image_sizes: ImageSizes | None = None,
        edges: ArrayLike | None = None,
        start: FittedPrior | None = None,
        checkpoint: bytes | None = None,
        device: str = "cpu",
    ) -> None:
        """Prepare a fit of `keypoints` (N, K, P, 2) pixels, from a `checkpoint` if given.

        `times` (N,) or (N, K) in seconds are the times of frames, or of their views. With them,
        views are put in step (`models.training.synchronising`), and noise is removed by smoothing
        in time. `image_sizes` are (width, height) in pixels, one per view, None where unknown.
        `edges` (E, 2) are the keypoints that a skeleton joins. Lifts hold their lengths where these
        are constant but for noise. `start` is a prior whose weights the fit starts from;
        `models.settings.config.warm` makes a suitable configuration. Training steps are taken on
        the `device`, everything else on the CPU.

        Raises
        ------
        ValueError
            When no frame has a usable view, the arrays are malformed (see `as_observations`), an
            edge does not name two keypoints, `image_sizes` or the configuration's calibration do
            not have one entry per view, or `start` has other keypoints, another prior, or other
            sizes of it, or the configuration names a keypoint that has no place.
        WeightsError
            When the checkpoint is damaged, was written by another version, or was made for other
            data or another configuration.
        """
        pixels = check_keypoints(keypoints)
        if confidence is not None:
            confidence = check_confidence(confidence, expected=pixels.shape[:3])
        pairs = check_edges(edges, pixels.shape[2])
        check_entries_per_view(pixels.shape[1], config, image_sizes)
        known = None if start is None else start.capture.known
        if checkpoint is not None:
            known = checkpoints.known_keypoints(checkpoint, pixels.shape[2])
        if times is not None:
            times = check_times(times, frames=len(pixels), views=pixels.shape[1])
        read = put_in_step(pixels, confidence, times, config.synchronise)
        seen, image_sizes = observe_mended(read, image_sizes, known, config)
        observations, self._capture = seen.observations, seen.capture
        self._seen, self._removal, self._times = seen, seen.noise_removal, read.times
        frames = usable_frames(observations)
        self.config = config
        self._fingerprint = checkpoints.fingerprint(seen.detected, read.times, image_sizes, pairs)
        self._holdout: Holdout | None = None
        divided = config.early_stopping or config.refine != "off"
        frames, self._held_out = split(frames, config.seed) if divided else (frames, frames[:0])
        unseen = Data.of(observations, self._held_out)
        if config.early_stopping and len(self._held_out):
            self._holdout = Holdout(unseen, config.seed)
        self._data = Data.of(observations, frames)
        self._batches = Batches(self._data, size=config.batch_of(len(frames)), seed=config.seed)
        self._network = make_prior(config, observations.keypoints.shape[2])
        self._network.initialise(config.seed)
        if start is not None:
            begin_with(self._network, config, start)
        self._learner = Learner(self._network, torch.device(device))
        among = among_known(config, self._capture.known)
        detected = seen.noise_removal.weighed(seen.detected)
        self._teaching = Teaching(
            self._network,
            self._data,
            unseen,
            among,
            image_sizes,
            seen.noise_removal.removed,
            self._data if seen.as_detected else Data.of(detected, frames),
            edges_among_known(pairs, self._capture.known),
        )
        self._state = TrainerState(Schedule.of(config), self._teaching.state)
        self._curve: list[CurveRow] = []
        if checkpoint is not None:
            self._restore(checkpoint)

    @property
    def step(self) -> int:
        """How many optimiser steps were taken."""
        return self._state.step

    @property
    def seconds(self) -> float:
        """The time that training has taken, over all attempts."""
        return self._state.clock.seconds

    @property
    def stopped_by(self) -> StoppedBy | None:
        """The reason why the fit ended; None if it can go on."""
        state = self._state
        if state.step < state.schedule.steps:
            return None
        whole = state.step >= state.schedule.full_steps
        return "early" if state.ends_early else "steps" if whole else "budget"

    def run(self) -> Iterator[Progress]:
        """Take the remaining steps, yielding after each; stop iterating to pause."""
        state = self._state
        state.clock.start()
        if not state.step and state.teaching.cameras == "sought":
            yield from self._settle_by_geometry()
        while state.step < state.schedule.steps:
            yield from self._make_due_teachers()
            if self.stopped_by is not None:
                break
            loss, error = self._take_step()
            newest = NEWEST_WEIGHT if state.step else None
            state.loss = _running_mean(state.loss, loss, newest)
            state.reprojection_error = _running_mean(state.reprojection_error, error, newest)
            state.step += 1
            self._plan_what_is_left()
            state.clock.count_step(state.step)
            curve_every = math.ceil(state.schedule.steps / CURVE_ROWS)
            if state.step % curve_every == 0 or self.stopped_by is not None:
                self._add_to_curve()
            yield self._progress("training")
            state.clock.start()

    def result(self) -> FittedPrior:
        """Return the prior as it stands, with handedness decided on the data of the fit."""
        self._update_network()
        prior = self._teaching.result(self.step, self._curve)
        usual = attempt(self._teaching.usual, nothing_unusual())
        capture = self._capture._replace(usual=usual, structure=self._teaching.structure, mends=())
        if self.config.refine != "off" and prior.cameras is None:
            missing = Finding.of("cameras_not_found")
            capture = capture._replace(findings=(*capture.findings, missing))
        learnt = prior.of_capture(self.config, capture, self._seen.outliers, self._removal)
        posterior = attempt(self._teaching.posterior, None, self._removal.shares_left)
        seen = self._seen.detected, self._times, self._held_out
        return with_posterior(learnt, posterior, *seen).mending(self._capture.mends)

    @property
    def has_first_answer(self) -> bool:
        """Whether geometry found the cameras, so that frames can be lifted before training."""
        return self._teaching.state.found_at_step == 0

    def first_answer(self) -> FittedPrior:
        """Return a prior with the cameras of geometry, whose network need not be taught yet.

        It is there if `has_first_answer`. Lifts refine its guesses with all cameras; what is
        usual, and known structures for hidden keypoints, it has not learnt.
        """
        self._state.clock.start()
        prior = self._teaching.as_prior(self._teaching.self_calibration)
        prior = prior.of_capture(self.config, self._capture, self._seen.outliers, self._removal)
        posterior = attempt(self._teaching.posterior, None, self._removal.shares_left)
        self._state.clock.count()
        return prior if posterior is None else prior.with_posterior(posterior)

    def checkpoint(self) -> bytes:
        """Return everything needed to continue, as safetensors bytes."""
        saved = Checkpoint(
            weights=self._learner.weights,
            moments=self._learner.moments,
            state=self._state,
            curve=self._curve,
            teachers=self._teaching.teachers,
            self_calibration=self._teaching.self_calibration,
        )
        known = self._capture.known
        return checkpoints.write(saved, config=self.config, data=self._fingerprint, known=known)

    def _restore(self, checkpoint: bytes) -> None:
        frames, views, keypoints = self._data.weights.shape
        saved = checkpoints.read(
            checkpoint,
            config=self.config,
            data=self._fingerprint,
            weights=len(self._learner.weights),
            shape=(frames, views, keypoints),
        )
        self._learner.resume(saved.weights, saved.moments)
        self._state, self._curve = saved.state, list(saved.curve)
        self._teaching.state, self._teaching.teachers = saved.state.teaching, saved.teachers
        self._teaching.self_calibration = saved.self_calibration

    def _update_network(self) -> None:
        """Give the network the weights that were learnt so far."""
        self._learner.update_network()
        self._teaching.network_changed()

    def _take_step(self) -> tuple[float, float]:
        """Take one optimiser step; return the loss and the reprojection error in pixels."""
        teaching, step = self._teaching, self._state.step
        calibrated = teaching.self_calibration is not None
        batch = self._batches.draw(step, teaching.teachers, perspective=calibrated)
        rate = self._state.schedule.rate_at(step, calibrated=calibrated)
        return self._learner.step(batch, count=step + 1, rate=rate)

    def _settle_by_geometry(self) -> Iterator[Progress]:
        """Find static cameras from keypoints alone; training then starts with teachers."""
        state = self._state
        for _ in self._teaching.settle_by_geometry():
            if state.clock.count() and state.clock.seconds > CALIBRATION_LIMIT * self._budget:
                break
            yield self._progress("refining")
            state.clock.start()
        state.clock.count()
        if state.teaching.cameras == "found":
            state.schedule = Schedule.of_settled(self.config, len(self._data.keypoints))
            state.refreshes_done = 1
            self._plan_within_budget()
            yield self._progress("refining")  # here there is a first answer
            state.clock.start()

    def _make_due_teachers(self) -> Iterator[Progress]:
        """Estimate the cameras and make the teachers that are due."""
        state = self._state
        due = state.schedule.refreshes_due(state.step)
        if due <= state.refreshes_done:
            return
        searching = state.teaching.cameras == "sought"
        if searching or can_afford_refresh(state.clock, self._budget):
            yield from self._make_teachers(searching=searching)
        if not state.refreshes_done:
            # The foreshortening is known from here on: errors are not what they were before.
            state.best = BestError(step=state.step)
        state.refreshes_done = due
        self._plan_within_budget()
        if self.stopped_by is not None:  # no time is left for another step
            self._add_to_curve()
            yield self._progress("refining")

    def _make_teachers(self, *, searching: bool) -> Iterator[Progress]:
        """Make teachers for as long as there is time."""
        clock, budget = self._state.clock, self._budget
        begun = clock.seconds
        limit = begun + (CALIBRATION_LIMIT if searching else 1) * (budget - begun)
        self._update_network()
        most = self._state.schedule.steps // TEACHER_SHARE
        for _ in self._teaching.make_teachers(self.step, most=most):
            clock.count()
            if clock.seconds > limit:
                self._teaching.stop_searching()
                break
            yield self._progress("refining")
            clock.start()
        clock.count()
        if not searching:
            clock.refresh_seconds = clock.seconds - begun

    @property
    def _budget(self) -> float:
        """Seconds that the fit may take."""
        return math.inf if self.config.budget_s is None else self.config.budget_s

    def _plan_what_is_left(self) -> None:
        """Plan the remaining steps again if time is short or the fit stopped improving."""
        if self.step % PLAN_EVERY == 0:
            self._plan_within_budget()
        if (
            self._holdout is not None
            and self.step % math.ceil(self.config.steps / HOLDOUT_CHECKS) == 0
        ):
            self._check_holdout(self._holdout)

    def _plan_within_budget(self) -> None:
        state = self._state
        if self.config.budget_s is not None and state.step > WARM_UP_STEPS:
            state.schedule = plan_within_budget(
                state.schedule,
                state.step,
                state.clock,
                self.config.budget_s,
                cameras_sought=state.teaching.cameras == "sought",
                result_seconds=state.teaching.result_seconds,
            )

    def _check_holdout(self, holdout: Holdout) -> None:
        """Move on to the next stage if the held-out error no longer falls."""
        state = self._state
        self._update_network()
        teachers = self._teaching.teachers
        error = holdout.error(self._network, 0.0 if teachers is None else teachers.foreshortening)
        best = state.best
        if best.error is None or error < (1 - TOLERANCE) * best.error:
            state.best = BestError(error, state.step)
            return
        if state.ends_early or state.step - best.step < PATIENCE * self.config.steps:
            return
        refreshes, last_steps = state.schedule.refreshes, math.ceil(LAST_SHARE * self.config.steps)
        if refreshes and not state.refreshes_done:
            state.schedule = state.schedule.skipped_to(state.step, refreshes[0])
        elif last_steps < state.schedule.steps - state.step:
            state.schedule = state.schedule.with_steps_left(state.step, last_steps)
            state.refreshes_done, state.ends_early = len(refreshes), True

    def _add_to_curve(self) -> None:
        state = self._state
        if not self._curve or self._curve[-1].step < state.step:
            self._curve.append(CurveRow(state.step, state.loss, state.reprojection_error))

    def _progress(self, stage: Stage) -> Progress:
        state, steps = self._state, self._state.schedule.steps
        refreshes = len(state.schedule.refreshes) - state.refreshes_done
        ahead = (refreshes, state.teaching.cameras == "sought", state.teaching.result_seconds)
        left = seconds_left(steps - state.step, state.step, state.clock, self._budget, *ahead)
        known = (state.loss, state.reprojection_error, left, stage, self.stopped_by)
        return Progress(state.step, steps, *known)


def fit(
    keypoints: ArrayLike,
    config: FitConfig | None = None,
    *,
    confidence: ArrayLike | None = None,
    times: ArrayLike | None = None,
    image_sizes: ImageSizes | None = None,
    edges: ArrayLike | None = None,
    start: FittedPrior | None = None,
    device: str = "cpu",
    on_progress: Callable[[Progress], None] | None = None,
) -> FittedPrior:
    """Fit a prior to `keypoints` (N, K, P, 2) pixels; see `Trainer` for pauses and errors."""
    trainer = Trainer(
        keypoints,
        config or FitConfig(),
        confidence=confidence,
        times=times,
        image_sizes=image_sizes,
        edges=edges,
        start=start,
        device=device,
    )
    for progress in trainer.run():
        if on_progress is not None:
            on_progress(progress)
    return trainer.result()


def _running_mean(mean: float, value: float, newest: float | None) -> float:
    """Move a running mean towards a value by the share `newest`; it starts at the first value."""
    return value if newest is None else mean + newest * (value - mean)
