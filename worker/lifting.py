"""Doing chunks of a lift: frames and weights in, arrays and JSON lines out."""

import logging
from collections.abc import Callable
from functools import partial
from typing import cast

from models.findings.finding import Finding, log_findings
from models.lifting.film import Film, Shown, read_film
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import LiftedFrames, join
from models.lifting.lift_findings import lift_findings
from models.numerics.threads import use_threads
from models.settings.config import Refine
from models.settings.uncertainty import Uncertainty, of_uncertainty
from store import corrections, datasets, lift_chunks, lookup, models
from store.database import Store
from store.errors import ConflictError
from store.lift_chunks import Helper
from store.records import DatasetRecord, LiftChunk, LiftRecord, ModelRecord
from worker.heartbeat import Heartbeat
from worker.outcomes import Outcomes, recorded
from worker.patience import patiently
from worker.rooms import Room, find_room
from worker.settings import WorkerSettings
from worker.time_slice import TimeSlice

logger = logging.getLogger(__name__)


def do_chunks(
    store: Store,
    helper: Helper,
    first: LiftChunk,
    claim: Callable[[], LiftChunk | None],
    heartbeat: Heartbeat,
    settings: WorkerSettings,
    time_slice: TimeSlice,
) -> None:
    """Do a claimed chunk and then others, until none is left or this process must leave.

    The results are in the records; see :func:`worker.outcomes.recorded` for errors. A fault of ours
    costs its chunk a try, and is raised again.
    """
    use_threads(settings.fit_threads)
    chunk: LiftChunk | None = first

    def try_again(why: str) -> None:
        if chunk is not None:
            lift_chunks.give_up(store, helper, chunk, why)

    waiting = partial(patiently, hurry=lambda: heartbeat.leave or heartbeat.lost)
    outcomes = Outcomes(
        fail=partial(lift_chunks.fail, store, helper),
        try_again=try_again,
        fault=try_again,
        unusable="invalid_arguments",
    )
    with recorded(helper.lift_id, outcomes):
        prior = waiting(partial(_load_prior, store, helper.lift_id))
        room = waiting(partial(_find_room, store, helper.lift_id, prior))
        while chunk is not None:
            waiting(partial(_do, store, helper, chunk, heartbeat, prior, room))
            if heartbeat.lost or heartbeat.leave or time_slice.is_over():
                return
            chunk = waiting(claim)


def _load_prior(store: Store, lift_id: str) -> FittedPrior:
    model = lookup.get(store, ModelRecord, lookup.get(store, LiftRecord, lift_id).model_id)
    return FittedPrior.from_bytes(models.load_weights(store, model))


def _find_room(store: Store, lift_id: str, prior: FittedPrior) -> Room | None:
    lift = lookup.get(store, LiftRecord, lift_id)
    if lift.frame != "room":
        return None
    up = tuple(lift.up) if isinstance(lift.up, list) else lift.up
    try:
        return find_room(store, lift.model_id, prior.cameras, up)
    except ConflictError as error:
        raise ValueError(str(error)) from error


def _film_of(store: Store, lift: LiftRecord, chunk: LiftChunk, prior: FittedPrior) -> Film:
    """Return a chunk's frames of a dataset."""
    dataset = lookup.get(store, DatasetRecord, lift.dataset_id)
    with store.reading() as session:
        corrected = corrections.of(session, LiftRecord, lift.id)

    def read(start: int, stop: int) -> Shown:
        capture = datasets.load_frames(store, dataset.id, start, stop, corrected=corrected)
        times = datasets.times_of(dataset, capture, start)
        return capture.keypoints, capture.confidence, times

    own = slice(chunk.first_frame, chunk.first_frame + chunk.frames)
    return read_film(prior, read, own, lift.frames, lift.views)


def _do(
    store: Store,
    helper: Helper,
    chunk: LiftChunk,
    heartbeat: Heartbeat,
    prior: FittedPrior,
    room: Room | None,
) -> None:
    """Do one chunk, unless the process must leave: then it is given back."""
    lift = lookup.get(store, LiftRecord, helper.lift_id)
    film = _film_of(store, lift, chunk, prior)
    uncertainty = cast(Uncertainty, lift.uncertainty or "sd")  # None: of an older version
    first = chunk.first_frame - film.own.start
    parts: list[LiftedFrames] = []
    findings: list[Finding] = []
    for part in film.parts:
        if heartbeat.lost:
            return
        if heartbeat.leave:
            lift_chunks.release(store, helper, chunk)
            return
        lifted = film.lift(part, refine=cast(Refine | None, lift.refine), uncertainty=uncertainty)
        if room is not None:
            lifted = room.place(lifted, lift.views)
        parts.append(lifted)
        findings += lift_findings(lifted, prior, first_frame=first + part.start)
    arrays = of_uncertainty(join(parts).arrays, uncertainty)
    lines = b"\n".join((*frames_to_json(arrays), b""))
    done = lift_chunks.finish(store, helper, chunk, arrays=arrays, lines=lines, findings=findings)
    if done.status == "succeeded":
        merged_findings = (Finding.model_validate(one) for one in done.findings or [])
        log_findings(logger, f"Lift {done.id}", merged_findings)
