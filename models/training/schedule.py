"""The schedule of a fit: its learning rate, and the steps at which it makes teachers.

Both depend on the share of the fit that is done. Every step adds the same share. If a fit is short
of time or stops improving, its remaining share is distributed over fewer steps.
"""

import math
from dataclasses import dataclass, replace
from typing import cast

from models.settings.config import FitConfig

# Figures: evidence/network.md.
# Shares of the fit after which teachers are made, and made anew with a better network.
WEAK_PERSPECTIVE_REFRESHES = (1 / 2, 3 / 4)
# With perspective, the cameras are found at the first of these.
PERSPECTIVE_REFRESHES = (1 / 3, 1 / 2, 2 / 3, 5 / 6)
# Where geometry settles the cameras before the first step, teachers are there at once.
SETTLED_REFRESHES = (0.0, 2 / 3)
# Such a fit needs fewer steps, because teachers replace the first part that learns from
# reprojection alone, and fewer still for few frames: a share of the whole, by frames.
MOST_SETTLED, LEAST_SETTLED, SETTLED_FRAMES = 2 / 3, 1 / 3, 2000
LEAST_STEPS = 1000  # that are always taken, if the configuration has as many
NEARLY_DONE = 1 - 1e-9  # largest share that is done: the remaining share is a divisor


@dataclass(frozen=True)
class Schedule:
    """The plan of a fit from some step on."""

    learning_rate: float  # Adam's step size at the start
    refreshes: tuple[float, ...]  # shares of the fit after which teachers are made
    full_steps: int  # of a whole fit without a time limit
    steps: int  # at which the fit ends
    first_step: int = 0  # step at which this plan began
    done_before: float = 0.0  # share of the fit that was done by then

    @classmethod
    def of(cls, config: FitConfig) -> "Schedule":
        """Plan the fit that is configured."""
        refreshes: tuple[float, ...] = PERSPECTIVE_REFRESHES
        if config.refine == "off":
            refreshes = WEAK_PERSPECTIVE_REFRESHES if config.distillation else ()
        rate = cast("float", config.learning_rate)  # which the configuration has filled in
        return cls(rate, refreshes, config.steps, config.steps)

    @classmethod
    def of_settled(cls, config: FitConfig, frames: int) -> "Schedule":
        """Plan a fit to so many frames whose cameras are settled before its first step."""
        share = min(max(frames / SETTLED_FRAMES, LEAST_SETTLED), MOST_SETTLED)
        steps = max(round(share * config.steps), min(config.steps, LEAST_STEPS))
        rate = cast("float", config.learning_rate)
        return cls(rate, SETTLED_REFRESHES, steps, steps)

    def share_at(self, step: int) -> float:
        """Return the share of the fit that is done before a step."""
        planned = max(self.steps - self.first_step, 1)
        return self.done_before + (1 - self.done_before) * (step - self.first_step) / planned

    def refreshes_due(self, step: int) -> int:
        """Return how many times teachers are to be made before a step is taken."""
        planned = self.steps - self.first_step
        shares = [(share - self.done_before) / (1 - self.done_before) for share in self.refreshes]
        return sum(self.first_step + int(share * planned) <= step for share in shares)

    def rate_at(self, step: int, *, calibrated: bool) -> float:
        """Return the learning rate of a step, which falls to zero along half a cosine.

        When the cameras are found (`calibrated`), it starts again from the top.
        """
        start = self.refreshes[0] if calibrated else 0.0
        phase = max(self.share_at(step) - start, 0) / (1 - start)
        return self.learning_rate / 2 * (1 + math.cos(math.pi * phase))

    def full_steps_left(self, step: int) -> int:
        """Return how many steps the remaining part takes without a time limit."""
        return round((1 - self.share_at(step)) * self.full_steps)

    def with_steps_left(self, step: int, steps_left: int) -> "Schedule":
        """Distribute the share that remains at a step over so many more steps."""
        share = min(self.share_at(step), NEARLY_DONE)
        return replace(self, first_step=step, done_before=share, steps=step + steps_left)

    def skipped_to(self, step: int, share: float) -> "Schedule":
        """Continue at a step as if this share of the fit were done."""
        left = round((1 - share) * self.full_steps)
        return replace(self, first_step=step, done_before=share, steps=step + left)
