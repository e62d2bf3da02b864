"""Fits that are short of time, learn nothing more, or start from a model."""

import json
import math

import numpy as np
import pytest
from safetensors.torch import load

from models.capture.metrics import pa_mpjpe
from models.capture.synthetic import SyntheticCapture, synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import pack, read_about
from models.settings.config import WARM_STEPS, FitConfig, warm
from models.training.budget import WARM_UP_STEPS, Clock, plan_within_budget, seconds_left
from models.training.holdout import split
from models.training.progress import Progress
from models.training.schedule import PERSPECTIVE_REFRESHES, Schedule
from models.training.trainer import Trainer, fit
from tests.sharing import fitted_once
from tests.tiers import thorough_after

# The cameras move here; looking for static cameras would take most of the time.
QUICK = FitConfig(steps=30, dictionary_sizes=(16, 8), batch_size=8, cameras="moving")
ENDLESS = QUICK.model_copy(update={"steps": 1_000_000, "budget_s": 1.0})


@pytest.fixture(scope="module")
def capture() -> SyntheticCapture:
    return synthetic_capture(frames=220, views=3, noise=1, seed=4)


def test_a_schedule_goes_from_its_rate_to_nothing_and_starts_again_with_the_cameras() -> None:
    plan = Schedule.of(FitConfig(steps=4500, learning_rate=0.01))
    refreshes = [next(s for s in range(4501) if plan.refreshes_due(s) > i) for i in range(4)]
    assert refreshes == [1500, 2250, 3000, 3750]
    assert plan.rate_at(0, calibrated=False) == 0.01
    assert plan.rate_at(2250, calibrated=False) == pytest.approx(0.005)
    assert plan.rate_at(1500, calibrated=True) == pytest.approx(0.01)
    assert plan.rate_at(4499, calibrated=True) < 1e-7


def test_cameras_that_are_settled_before_need_fewer_steps_the_fewer_frames_there_are() -> None:
    config = FitConfig(steps=6000)
    steps = [Schedule.of_settled(config, frames).steps for frames in (20, 1000, 10**6)]
    assert steps == [2000, 3000, 4000]
    assert Schedule.of_settled(FitConfig(steps=1200), 20).steps == 1000
    assert Schedule.of_settled(FitConfig(steps=300), 10**6).steps == 300


def test_what_is_left_is_laid_out_for_the_time_that_is_left() -> None:
    plan = Schedule.of(FitConfig(steps=4500))
    clock = Clock(seconds=2.0, step_seconds=0.01, refresh_seconds=0.5)
    # 8 s are left: 1 for the end, 3 refreshes of 0.5 s, the rest for steps of 10 ms.
    late = plan_within_budget(plan, 2000, clock, 10.0, cameras_sought=False, result_seconds=1.0)
    assert late.steps == pytest.approx(2000 + 550, abs=1)
    assert late.share_at(2000) == plan.share_at(2000)
    assert late.rate_at(2000, calibrated=True) == plan.rate_at(2000, calibrated=True)
    assert late.rate_at(late.steps - 1, calibrated=True) < 1e-6
    assert late.refreshes_due(late.steps) == len(PERSPECTIVE_REFRESHES)
    # The search for cameras gets its share of what is left, before anybody knows what it takes.
    early = plan_within_budget(plan, 1000, clock, 10.0, cameras_sought=True, result_seconds=1.0)
    assert early.steps < 1000 + 550
    # A refresh that is dear is left out, so that there are steps.
    dear = plan_within_budget(
        plan,
        2000,
        Clock(2.0, 0.01, refresh_seconds=3.0),
        10.0,
        cameras_sought=False,
        result_seconds=1.0,
    )
    assert dear.steps == pytest.approx(2000 + 700, abs=1)
    # With time enough, nothing changes; without any, this is the end.
    assert (
        plan_within_budget(plan, 2000, clock, 1e4, cameras_sought=False, result_seconds=1.0) is plan
    )
    assert (
        plan_within_budget(plan, 2000, clock, 1.0, cameras_sought=False, result_seconds=1.0).steps
        == 2000
    )
    # Time that was short may be plenty after all.
    assert (
        plan_within_budget(late, 2100, clock, 1e4, cameras_sought=False, result_seconds=1.0).steps
        > 4000
    )


@pytest.mark.parametrize("refine", thorough_after(1, ["auto", "off"]))
def test_a_budget_ends_a_fit_that_would_not_end_with_a_usable_prior(
    capture: SyntheticCapture, refine: str
) -> None:
    seen: list[Progress] = []
    config = ENDLESS.model_copy(update={"refine": refine})
    prior = fit(capture.keypoints, config, on_progress=seen.append)
    assert seen[-1].stopped_by == "budget"
    assert seen[-1].step == seen[-1].steps < 1_000_000
    assert seen[-1].seconds_left == 0
    assert [progress.stopped_by for progress in seen[:-1]] == [None] * (len(seen) - 1)
    assert prior.curve[-1].step == seen[-1].step
    assert np.isfinite(prior.lift(capture.keypoints).points3d).all()


@pytest.mark.thorough
def test_a_budget_that_suffices_changes_nothing(capture: SyntheticCapture) -> None:
    def weights(config: FitConfig) -> list[bytes]:
        found = fit(capture.keypoints[:60], config).weights
        return [value.numpy().tobytes() for value in found.values()]

    plain = QUICK.model_copy(update={"steps": 60})
    assert weights(plain) == weights(plain.model_copy(update={"budget_s": 3600.0}))


def test_a_resumed_fit_keeps_to_its_budget_and_its_plan(capture: SyntheticCapture) -> None:
    config = ENDLESS.model_copy(update={"budget_s": 300.0, "refine": "off"})

    def advance(trainer: Trainer, step: int) -> Progress:
        return next(progress for progress in trainer.run() if progress.step == step)

    whole = Trainer(capture.keypoints, config)
    advance(whole, 30)  # 25 steps in, the pace is known and the plan is made
    data = whole.checkpoint()
    part = Trainer(capture.keypoints, config, checkpoint=data)
    assert part.seconds == whole.seconds > 0
    one, other = advance(whole, 45), advance(part, 45)
    assert one.steps == other.steps < 1_000_000
    assert whole.result().to_bytes() == part.result().to_bytes()


def test_a_fit_whose_time_is_over_when_teachers_are_due_notes_no_step_twice(
    capture: SyntheticCapture,
) -> None:
    config = QUICK.model_copy(update={"steps": 100, "budget_s": 3600.0, "refine": "off"})
    plan = Schedule.of(config)
    due = next(step for step in range(plan.steps) if plan.refreshes_due(step))
    trainer = Trainer(capture.keypoints[:30], config)
    next(progress for progress in trainer.run() if progress.step == due)
    data = trainer.checkpoint()
    about = read_about(data, kind="checkpoint")
    state = json.loads(about["state"])
    state["clock"]["seconds"] = config.budget_s
    late = pack(load(data), kind="checkpoint", about=about | {"state": json.dumps(state)})
    trainer = Trainer(capture.keypoints[:30], config, checkpoint=late)
    assert [progress.stopped_by for progress in trainer.run()] == ["budget"]
    prior = FittedPrior.from_bytes(trainer.result().to_bytes())  # which reads rising steps alone
    assert [row.step for row in prior.curve[-2:]] == [due - 1, due]


def test_a_fit_that_learns_nothing_more_ends_early() -> None:
    rigid = synthetic_capture(frames=2, views=3, seed=5).keypoints[:1].repeat(220, 0)
    config = QUICK.model_copy(update={"steps": 400, "early_stopping": True, "refine": "off"})
    seen: list[Progress] = []
    fit(rigid, config, on_progress=seen.append)
    assert seen[-1].stopped_by == "early"
    assert seen[-1].step == seen[-1].steps < 400
    through: list[Progress] = []
    patient = config.model_copy(update={"early_stopping": False})
    fit(rigid, patient, on_progress=through.append)
    assert (through[-1].stopped_by, through[-1].step) == ("steps", 400)


def test_held_out_frames_are_a_twentieth_and_none_of_few() -> None:
    frames = np.arange(1000) * 2
    seen, held = split(frames, seed=0)
    assert len(held) == 50
    assert sorted([*seen, *held]) == frames.tolist()
    assert len(split(frames[:199], seed=0)[1]) == 0
    assert len(split(np.arange(100_000), seed=0)[1]) == 200


def test_early_stopping_of_few_frames_changes_nothing() -> None:
    keypoints = synthetic_capture(frames=21, views=2, seed=3).keypoints
    config = QUICK.model_copy(update={"refine": "off"})
    plain = fit(keypoints, config).weights
    held = fit(keypoints, config.model_copy(update={"early_stopping": True})).weights
    for name, value in plain.items():
        np.testing.assert_array_equal(held[name], value)


@pytest.mark.thorough
def test_early_stopping_is_resumed_bit_for_bit(capture: SyntheticCapture) -> None:
    config = QUICK.model_copy(update={"steps": 120, "early_stopping": True, "refine": "off"})
    whole, data = Trainer(capture.keypoints, config), b""
    stops = {20: b"", 63: b"", 80: b""}
    for progress in whole.run():
        if progress.step in stops:
            stops[progress.step] = whole.checkpoint()
    for data in filter(None, stops.values()):
        part = Trainer(capture.keypoints, config, checkpoint=data)
        for _ in part.run():
            pass
        assert part.step == whole.step
        assert part.result().to_bytes() == whole.result().to_bytes()


@pytest.fixture(scope="module")
def source(capture: SyntheticCapture) -> FittedPrior:
    config = FitConfig(steps=300, dictionary_sizes=(32, 8), batch_size=16, refine="off")
    return fitted_once("source", lambda: fit(capture.keypoints[:150], config))


def test_a_start_from_a_model_is_ahead_of_one_from_nothing(
    capture: SyntheticCapture, source: FittedPrior
) -> None:
    rest = slice(150, None)
    config = FitConfig(steps=40, dictionary_sizes=(32, 8), batch_size=16, refine="off")

    def error(start: FittedPrior | None) -> float:
        prior = fit(capture.keypoints[rest], config, start=start)
        lift = prior.lift(capture.keypoints[rest])
        return float(pa_mpjpe(lift.points3d, capture.points3d[rest]).mean)

    assert error(source) < 0.7 * error(None)


def test_a_model_of_another_kind_is_no_start(
    capture: SyntheticCapture, source: FittedPrior
) -> None:
    with pytest.raises(ValueError, match=r"dictionary_sizes \(32, 8\), the fit \(16, 8\)"):
        Trainer(capture.keypoints, QUICK, start=source)
    config = FitConfig(dictionary_sizes=(32, 8))
    with pytest.raises(ValueError, match="keypoints 16, the fit 9"):
        Trainer(capture.keypoints[:, :, :9], config, start=source)


def test_fields_that_are_not_given_suit_a_start_from_a_model() -> None:
    source = FitConfig(dictionary_sizes=(64, 16), seed=3)
    config = warm(FitConfig(seed=1), source)
    assert (config.dictionary_sizes, config.steps, config.seed) == ((64, 16), WARM_STEPS, 1)
    given = FitConfig(steps=7, dictionary_sizes=(32, 8))
    assert warm(given, source) == given
    assert FitConfig().steps > 2 * WARM_STEPS


def test_fits_run_on_the_cpu_by_default(capture: SyntheticCapture) -> None:
    config = QUICK.model_copy(update={"refine": "off"})
    keypoints = capture.keypoints[:40]
    plain, given = fit(keypoints, config), fit(keypoints, config, device="cpu")
    assert plain.to_bytes() == given.to_bytes()


def test_the_search_before_the_first_step_is_no_pace() -> None:
    clock = Clock(seconds=13.0)  # of a search for cameras, and then steps of 8 ms
    left = []
    for step in range(4001):
        left.append(seconds_left(4000 - step, step, clock, math.inf, 3, False, None))
        clock.step_seconds = 0.008
    assert left[: WARM_UP_STEPS + 1] == [None] * (WARM_UP_STEPS + 1)
    assert all(32 * (1 - step / 4000) <= (left[step] or 0) < 60 for step in range(6, 4000))
    assert left[-1] == 0


def test_what_is_measured_replaces_what_is_assumed_of_the_time_left() -> None:
    clock = Clock(step_seconds=0.01, refresh_seconds=2.0)
    assert seconds_left(2000, 2000, clock, math.inf, 4, False, 3.0) == pytest.approx(20 + 8 + 3)
    sought = seconds_left(2000, 2000, clock, math.inf, 4, True, 3.0)
    assert sought is not None
    assert sought > 20 + 6 + 3  # the search takes time, too
    assert seconds_left(2000, 2000, clock, 5.0, 4, True, 3.0) == 5.0  # a budget is kept
