"""When a fit does what: learning rate, and the steps at which it makes teachers."""

import math
from dataclasses import dataclass

from models.config import FitConfig

REFRESHES = (0.5, 0.75)  # shares of the steps after which settled teachers are (re)made
# Shares of the steps after which the cameras are found, and teachers with them, and after which the
# teachers are made anew, with the network in place of the shape model.
DISCOVERY = (1 / 3, 1 / 2, 2 / 3, 5 / 6)


@dataclass(frozen=True)
class Schedule:
    """The plan of a fit of a known number of steps."""

    steps: int
    rate: float  # Adam's step size at the start
    shares: tuple[float, ...]  # of the steps after which teachers are made

    @classmethod
    def of(cls, config: FitConfig) -> "Schedule":
        """Plan the fit that is configured."""
        shares: tuple[float, ...] = REFRESHES if config.refine == "off" else DISCOVERY
        if not config.distillation and config.refine == "off":
            shares = ()
        return cls(config.steps, config.learning_rate, shares)

    @property
    def refreshes(self) -> list[int]:
        """The steps before which teachers are made."""
        return [int(share * self.steps) for share in self.shares]

    def rate_at(self, step: int, *, found: bool) -> float:
        """Return the learning rate: half a cosine, two if the cameras are found on the way."""
        start = self.refreshes[0] if found else 0
        return self.rate / 2 * (1 + math.cos(math.pi * (step - start) / (self.steps - start)))
