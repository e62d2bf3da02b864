"""Doing chunks of a lift: frames and weights in, arrays and JSON lines out."""

import logging
from contextlib import suppress
from typing import cast

import torch
from sqlalchemy.exc import SQLAlchemyError

from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import Lift, join
from models.settings.config import Refine
from store import datasets, lift_chunks, lifts, models
from store.database import Store
from store.errors import LeaseLostError, NotFoundError
from store.lift_chunks import Helper
from store.records import LiftChunk
from worker.pulse import Pulse
from worker.settings import WorkerSettings
from worker.turn import Turn

logger = logging.getLogger(__name__)

SLICE_FRAMES = 512  # lifted between two looks at what is asked of the helper


def do_chunks(
    store: Store,
    helper: Helper,
    first: LiftChunk,
    pulse: Pulse,
    settings: WorkerSettings,
    turn: Turn,
) -> None:
    """Do a claimed chunk and then others, until none is left or this process must leave.

    What comes of it is in the records. An error costs its chunk a try, and is raised again.
    """
    torch.set_num_threads(settings.fit_threads)
    chunk: LiftChunk | None = first
    try:
        prior = _load_prior(store, helper.lift_id)
        while chunk is not None:
            _do(store, helper, chunk, pulse, prior)
            if pulse.lost or pulse.leave or turn.is_over():
                return
            chunk = lift_chunks.claim(store, helper)
    except LeaseLostError:
        logger.warning("Lift %s is no longer ours: leaving it alone", helper.lift_id)
    except NotFoundError as error:
        lift_chunks.fail(store, helper, f"{error.kind}_not_found", str(error))
    except ValueError as error:
        lift_chunks.fail(store, helper, "invalid_arguments", str(error))
        logger.exception("Lift %s failed", helper.lift_id)
    except SQLAlchemyError:  # nothing can be written: the chunk is free once its lease runs out
        raise
    except BaseException as error:
        if chunk is not None:
            with suppress(LeaseLostError):
                why = f"{type(error).__name__}: {error}"
                lift_chunks.give_up(store, helper, chunk, why)
        raise


def _load_prior(store: Store, lift_id: str) -> FittedPrior:
    model = models.get(store, lifts.get(store, lift_id).model_id)
    return FittedPrior.from_bytes(models.load_weights(store, model))


def _do(store: Store, helper: Helper, chunk: LiftChunk, pulse: Pulse, prior: FittedPrior) -> None:
    """Do one chunk, unless the process must leave: then it is given back."""
    lift = lifts.get(store, helper.lift_id)
    end = chunk.first_frame + chunk.frames
    capture = datasets.load_frames(store, lift.dataset_id, chunk.first_frame, end)
    parts: list[Lift] = []
    for start in range(0, chunk.frames, SLICE_FRAMES):
        if pulse.lost:
            return
        if pulse.leave:
            lift_chunks.release(store, helper, chunk)
            return
        part = slice(start, start + SLICE_FRAMES)
        parts.append(
            prior.lift(
                capture.keypoints[part],
                confidence=None if capture.confidence is None else capture.confidence[part],
                refine=cast(Refine | None, lift.refine),
                views=lift.views,
            )
        )
    arrays = join(parts).arrays
    lines = b"\n".join((*frames_to_json(arrays), b""))
    lift_chunks.finish(store, helper, chunk, arrays=arrays, lines=lines)
