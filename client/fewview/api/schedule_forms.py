"""When a fit is expected to start and to end, as a frozen dataclass."""

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class FitSchedule:
    """When a fit is expected to start and to end; None where nothing is known.

    Attributes
    ----------
    ahead
        Fits that wait now and are expected to start before it.
    workers
        Those that take from its queue.
    measured_fits
        Of how many fits durations are known.
    """

    status: str
    ahead: int
    expected_start: datetime | None
    expected_end: datetime | None
    workers: int
    measured_fits: int
