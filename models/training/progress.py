"""The progress of a fit while it goes on."""

from dataclasses import dataclass
from typing import Literal

StoppedBy = Literal["steps", "budget", "early"]
Stage = Literal["training", "refining"]


@dataclass(frozen=True)
class Progress:
    """Where a fit stands after one optimiser step."""

    step: int
    steps: int
    loss: float  # running mean over recent batches
    reprojection_error: float  # pixels, running mean over recent batches
    seconds_left: float | None  # None while no pace is known
    stage: Stage = "training"
    stopped_by: StoppedBy | None = None  # why the fit ended; None while it goes on
