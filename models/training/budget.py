"""Planning the remaining steps of a fit for the remaining time."""

import time
from dataclasses import dataclass

from models.training.schedule import Schedule

# Figures: evidence/network.md.
PLAN_EVERY = 25  # steps
WARM_UP_STEPS = 5  # slower than all others, so not used to predict these
NEWEST_WEIGHT = 0.1  # of the newest step in the running mean
# Shares of the remaining time that are assumed until they are measured: estimating the cameras; a
# refresh, which makes teachers again; the result, after the last step.
CALIBRATION_SHARE, REFRESH_SHARE, RESULT_SHARE = 0.35, 0.04, 0.08
CALIBRATION_LIMIT = 0.6  # share of the time that is left after which the search for cameras ends
REFRESH_LIMIT = 0.2  # share of the time that is left: a refresh that takes more is left out
RESULT_LIMIT = 0.15  # share of the budget that is kept for the result at most


@dataclass
class Clock:
    """The time that a fit has taken, over all its attempts, and what its parts take."""

    seconds: float = 0.0
    step_seconds: float = 0.0  # of a step, running mean
    refresh_seconds: float | None = None  # of the last refresh; None before there was one

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Count from now on."""
        self._counted_until = time.perf_counter()

    def count(self) -> float:
        """Add the seconds since the last count or start, and return them."""
        now = time.perf_counter()
        passed, self._counted_until = now - self._counted_until, now
        self.seconds += passed
        return passed

    def count_step(self, step: int) -> None:
        """Add the seconds of a step, and update the estimate of how long a step takes."""
        took = self.count()
        newest = 1.0 if step <= WARM_UP_STEPS else NEWEST_WEIGHT
        self.step_seconds += newest * (took - self.step_seconds)


def can_afford_refresh(clock: Clock, budget_s: float) -> bool:
    """Whether there is enough time to make teachers again."""
    return (clock.refresh_seconds or 0.0) <= REFRESH_LIMIT * (budget_s - clock.seconds)


def seconds_left(
    steps_left: int,
    step: int,
    clock: Clock,
    budget_s: float,
    refreshes: int,
    cameras_sought: bool,
    result_seconds: float | None,
) -> float | None:
    """Predict how long the remaining part takes, at the present pace and within the budget.

    None while there is no pace: the search for cameras before the first step shows none, nor do the
    first steps. What has not been measured counts as the share of the time that is assumed for it.

    Parameters
    ----------
    refreshes
        How many are not done; where `cameras_sought`, the first of them estimates the cameras.
    """
    if steps_left <= 0:
        return 0.0
    if step <= WARM_UP_STEPS:
        return None
    measured, assumed = steps_left * clock.step_seconds, 0.0
    if result_seconds is None:
        assumed += RESULT_SHARE
    else:
        measured += result_seconds
    if cameras_sought and refreshes > 0:
        assumed += CALIBRATION_SHARE
        refreshes -= 1
    if clock.refresh_seconds is None:
        assumed += REFRESH_SHARE * max(refreshes, 0)
    else:
        measured += max(refreshes, 0) * clock.refresh_seconds
    return max(min(measured / (1 - assumed), budget_s - clock.seconds), 0.0)


def plan_within_budget(
    schedule: Schedule,
    step: int,
    clock: Clock,
    budget_s: float,
    *,
    cameras_sought: bool,
    result_seconds: float | None,
) -> Schedule:
    """Fit the remaining steps into the remaining time, at the present pace.

    Parameters
    ----------
    cameras_sought
        Whether the cameras are still to be estimated, at the next refresh.
    result_seconds
        How long the result will take; None if this was not measured yet.
    """
    refreshes = len(schedule.refreshes) - schedule.refreshes_due(step)
    left = budget_s - clock.seconds
    result = RESULT_SHARE * left if result_seconds is None else result_seconds
    reserved = min(result, RESULT_LIMIT * budget_s)
    if cameras_sought and refreshes:
        reserved += CALIBRATION_SHARE * left
        refreshes -= 1
    if can_afford_refresh(clock, budget_s):
        each = REFRESH_SHARE * left if clock.refresh_seconds is None else clock.refresh_seconds
        reserved += refreshes * each
    affordable = max(int((left - reserved) / clock.step_seconds), 0)
    steps_left = min(affordable, schedule.full_steps_left(step))
    if steps_left == schedule.steps - step:
        return schedule
    return schedule.with_steps_left(step, steps_left)
