"""The numbers of a fit that change from step to step; a checkpoint holds all of them as JSON."""

import json
from dataclasses import asdict, dataclass, field
from typing import Literal

from pydantic import TypeAdapter

from models.numerics.tensor_files import WeightsError
from models.training.budget import Clock
from models.training.schedule import Schedule

# Whether the cameras of a fit are still sought, are found, or are not sought: because the
# configuration does not ask for them, or because the time for it is over.
CameraSearch = Literal["sought", "found", "not_sought"]


@dataclass
class TeachingState:
    """The state of cameras and teachers, besides these themselves."""

    cameras: CameraSearch
    found_at_step: int | None = None  # where the cameras were found
    mirrored: bool = False  # whether the network's structures are mirror images of the true ones
    result_seconds: float | None = None  # duration of the result's last step, once measured


@dataclass
class BestError:
    """The least error of the held-out frames so far."""

    error: float | None = None  # None before the first measurement
    step: int = 0


@dataclass
class TrainerState:
    """A fit at one step, without its weights, teachers and cameras."""

    schedule: Schedule
    teaching: TeachingState
    clock: Clock = field(default_factory=Clock)
    best: BestError = field(default_factory=BestError)
    step: int = 0  # steps taken
    loss: float = 0.0  # running mean over recent batches
    reprojection_error: float = 0.0  # pixels, running mean over recent batches
    refreshes_done: int = 0  # how many times teachers were made, or skipped for lack of time
    ends_early: bool = False  # whether the fit stopped improving and takes its last steps


_ADAPTER = TypeAdapter(TrainerState)
ANOTHER_VERSION = "the checkpoint was written by another version, or is damaged; start anew"


def state_to_json(state: TrainerState) -> str:
    """Return a state as JSON text, which gives back every number exactly."""
    return json.dumps(asdict(state))


def state_from_json(text: str) -> TrainerState:
    """Read what `state_to_json` returned.

    Raises
    ------
    WeightsError
        When the text is anything else, such as the state of another version.
    """
    try:
        state = _ADAPTER.validate_python(json.loads(text))
    except (ValueError, RecursionError) as error:  # pydantic's errors are ValueErrors
        raise WeightsError(ANOTHER_VERSION) from error
    if state_to_json(state) != text:  # names are missing, or there are others
        raise WeightsError(ANOTHER_VERSION)
    return state
