"""When a fit does what: learning rate, and the steps at which it makes teachers.

Everything is a function of the share of the fit that is done. Steps and shares go together unless a
fit is short of time, or learns nothing more: then the rest of it is laid out anew over fewer steps.
"""

import math
from dataclasses import dataclass, replace
from typing import cast

from models.settings.config import FitConfig

REFRESHES = (1 / 2, 3 / 4)  # shares after which settled teachers are (re)made
# Shares after which the cameras are found, and teachers with them, and after which the teachers are
# made anew, with the network in place of the shape model.
DISCOVERY = (1 / 3, 1 / 2, 2 / 3, 5 / 6)


@dataclass(frozen=True)
class Schedule:
    """The plan of a fit from some step on."""

    rate: float  # Adam's step size at the start
    refreshes: tuple[float, ...]  # shares of the fit after which teachers are made
    most: float  # steps of a whole fit that has all the time it needs
    steps: int  # at which the fit ends
    since: int = 0  # step at which this plan began
    done: float = 0.0  # share of the fit that was done by then

    @classmethod
    def of(cls, config: FitConfig) -> "Schedule":
        """Plan the fit that is configured."""
        refreshes: tuple[float, ...] = REFRESHES if config.refine == "off" else DISCOVERY
        if not config.distillation and config.refine == "off":
            refreshes = ()
        rate = cast("float", config.learning_rate)  # which the configuration has filled in
        return cls(rate, refreshes, config.steps, config.steps)

    def share_at(self, step: int) -> float:
        """Return the share of the fit that is done before a step."""
        ahead = max(self.steps - self.since, 1)
        return self.done + (1 - self.done) * (step - self.since) / ahead

    def refreshes_by(self, step: int) -> int:
        """Return how many times teachers are to be made before a step is taken."""
        ahead = self.steps - self.since
        shares = [(share - self.done) / (1 - self.done) for share in self.refreshes]
        return sum(self.since + int(share * ahead) <= step for share in shares)

    def rate_at(self, step: int, *, found: bool) -> float:
        """Return the learning rate: half a cosine, two if the cameras are found on the way."""
        start = self.refreshes[0] if found else 0.0
        phase = max(self.share_at(step) - start, 0) / (1 - start)
        return self.rate / 2 * (1 + math.cos(math.pi * phase))

    def steps_left(self, step: int) -> int:
        """Return how many steps the rest takes that has all the time it needs."""
        return round((1 - self.share_at(step)) * self.most)

    def shortened(self, step: int, steps_left: int) -> "Schedule":
        """Do what is left in so many steps."""
        share = min(self.share_at(step), 1 - 1e-9)
        return replace(self, since=step, done=share, steps=step + steps_left)

    def advanced(self, step: int, share: float) -> "Schedule":
        """Leave out what lies before a share of the fit."""
        return replace(self, since=step, done=share, steps=step + round((1 - share) * self.most))
