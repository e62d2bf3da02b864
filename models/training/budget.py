"""Laying out what is left of a fit for the time there is."""

import time
from dataclasses import dataclass

from models.training.schedule import Schedule

EVERY = 25  # steps between two looks at the time
WARM = 5  # first steps, which say nothing about the next
RECENT = 0.1  # weight of the newest step in the running mean
# Shares of the time that is left, as long as there is no measure: finding the cameras; a lesson,
# which makes teachers anew; what comes after the last step.
CAMERAS, LESSON, LAST = 0.35, 0.04, 0.08
SEARCH = 0.6  # share of the time that is left after which cameras are given up
DEAR = 0.2  # share of the time that is left: a lesson that costs more is left out
LONGEST = 0.15  # share of the budget that is kept for the end at most


@dataclass
class Clock:
    """The time that a fit has taken, over all its attempts, and what its parts take."""

    seconds: float = 0.0
    pace: float = 0.0  # seconds of a step, running mean
    lesson: float = 0.0  # seconds of the last lesson; 0 before there was one
    _mark: float = 0.0

    def start(self) -> None:
        """Count from now on."""
        self._mark = time.perf_counter()

    def tick(self) -> float:
        """Count what has passed since the last look, and return it."""
        now = time.perf_counter()
        passed, self._mark = now - self._mark, now
        self.seconds += passed
        return passed

    def stepped(self, step: int) -> None:
        """Count a step."""
        took = self.tick()
        self.pace = took if step <= WARM else self.pace + RECENT * (took - self.pace)


def affordable(clock: Clock, budget: float) -> bool:
    """Whether a lesson is worth its time."""
    return clock.lesson <= DEAR * (budget - clock.seconds)


def relaid(
    schedule: Schedule, step: int, clock: Clock, budget: float, *, cameras: bool, ending: float
) -> Schedule:
    """Fill the time that is left with what is left of the fit, at the present pace.

    Parameters
    ----------
    cameras
        Whether they will be looked for.
    ending
        Seconds that the result will take, 0 as long as that is not known.
    """
    lessons = len(schedule.refreshes) - schedule.refreshes_by(step)
    left = budget - clock.seconds
    keep = min(ending or LAST * left, LONGEST * budget)
    if cameras and lessons:
        keep += CAMERAS * left
        lessons -= 1
    if affordable(clock, budget):
        keep += lessons * (clock.lesson or LESSON * left)
    steps = min(max(int((left - keep) / clock.pace), 0), schedule.steps_left(step))
    return schedule if steps == schedule.steps - step else schedule.shortened(step, steps)
