"""How long fits take, from those that this deployment has made."""

from collections.abc import Iterable
from functools import lru_cache
from math import log
from statistics import median
from typing import NamedTuple

from models.settings.config import FitConfig

MEASURED = 50  # of the last fits, how many durations are looked at
APART = 1.25  # ratio of work from which two fits show what more of it takes; below, they are alike
FEWEST, NEAREST = 3, 9  # alike ones that suffice, and how many count where there are fewer
RESULT_STEPS = 10  # a guess: as many steps take what a frame takes besides


class Size(NamedTuple):
    """What decides how long a fit takes."""

    frames: int
    views: int
    keypoints: int
    steps: int
    batch_size: int | None

    @property
    def work(self) -> float:
        """Frames of training steps and of the result, times views and keypoints."""
        batch = FitConfig.model_construct(batch_size=self.batch_size).batch_of(self.frames)
        frames = self.steps * min(batch, self.frames) + RESULT_STEPS * self.frames
        return float(max(frames * self.views * self.keypoints, 1))


class Durations:
    """The durations of fits, by their sizes."""

    def __init__(self, measured: Iterable[tuple[float, Size]]) -> None:
        """Take seconds and sizes of fits that were made, the last one first."""
        self._known = [(seconds, size.work) for seconds, size in measured]
        slopes = [
            (seconds - less) / (work - smaller)
            for seconds, work in self._known
            for less, smaller in self._known
            if work > APART * smaller
        ]
        self._slope = max(median(slopes), 0.0) if slopes else 0.0
        self.usual = lru_cache(maxsize=None)(self._usual)

    def __len__(self) -> int:
        return len(self._known)

    def _usual(self, size: Size) -> float | None:
        """Return the seconds that a fit takes; None where no duration is known.

        It is the median of the most alike, each with what more work took of others (Theil, 1950),
        and never less than the shortest of them by more than its work is less.
        """
        work = size.work
        apart = sorted(self._known, key=lambda known: abs(log(known[1] / work)))
        alike = [known for known in apart if work / APART < known[1] < work * APART]
        if len(alike) < FEWEST:
            alike = apart[:NEAREST]
        if not alike:
            return None
        return median(
            max(seconds + self._slope * (work - of), seconds * min(work / of, 1.0))
            for seconds, of in alike
        )
