"""Doing chunks of a lift: frames and weights in, arrays and JSON lines out."""

import logging
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

from models.capture.clocks import frames_apart, in_step
from models.capture.motion import with_neighbours
from models.findings.finding import Finding, log_findings
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import LiftedFrames, join
from models.lifting.lift_findings import lift_findings
from models.numerics.threads import use_threads
from models.settings.config import Refine
from models.settings.uncertainty import Uncertainty, of_uncertainty
from store import corrections, datasets, lift_chunks, lookup, models
from store.capture import Capture, Float64
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

AROUND = 3  # frames beside those that late views are read from, for interpolation
SLICE_FRAMES = 512  # lifted between two looks at what is asked of the helper


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


class _Loaded(NamedTuple):
    """The frames of a chunk, with the views in step, and what is around them."""

    capture: Capture
    times: Float64 | None  # seconds, of each frame or of its views
    own: slice  # the frames of the chunk among these


def _load_in_step(store: Store, lift: LiftRecord, chunk: LiftChunk, prior: FittedPrior) -> _Loaded:
    """Load a chunk's frames with the views in step, if the dataset has times."""
    dataset = lookup.get(store, DatasetRecord, lift.dataset_id)
    own = slice(chunk.first_frame, chunk.first_frame + chunk.frames)
    with store.reading() as session:
        corrected = corrections.of(session, LiftRecord, lift.id)
    read = partial(datasets.load_frames, store, dataset.id, corrected=corrected)
    capture = read(own.start, own.stop)
    times = datasets.times_of(dataset, capture, own.start)
    if times is None:
        return _Loaded(capture, None, slice(0, chunk.frames))
    clocks = prior.capture.clocks_of(lift.views, dataset.views)
    around = with_neighbours(own) if prior.smooths else own
    apart = frames_apart(times, clocks)
    if apart:
        around = slice(max(around.start - apart - AROUND, 0), around.stop + apart + AROUND)
    if around != own:
        stop = min(around.stop, lift.frames)
        capture = read(around.start, stop)
        times = datasets.times_of(dataset, capture, around.start)
    moved = in_step(capture.keypoints, capture.confidence, times, clocks)
    return _Loaded(Capture(*moved), times, slice(own.start - around.start, own.stop - around.start))


def _lift(loaded: _Loaded, start: int, job: LiftRecord, prior: FittedPrior) -> LiftedFrames:
    """Lift some of a chunk's frames."""
    keypoints, trust, times = loaded.capture.keypoints, loaded.capture.confidence, loaded.times
    first = loaded.own.start + start
    own = slice(first, min(first + SLICE_FRAMES, loaded.own.stop))
    around = with_neighbours(own) if prior.smooths and times is not None else own
    return prior.lift(
        keypoints[around],
        confidence=None if trust is None else trust[around],
        refine=cast(Refine | None, job.refine),
        views=job.views,
        times=None if times is None else times[around],
        only=slice(own.start - around.start, own.stop - around.start),
        uncertainty=_uncertainty_of(job),
    )


def _uncertainty_of(job: LiftRecord) -> Uncertainty:
    return cast(Uncertainty, job.uncertainty or "sd")  # None: of an older version


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
    loaded = _load_in_step(store, lift, chunk, prior)
    parts: list[LiftedFrames] = []
    findings: list[Finding] = []
    for start in range(0, chunk.frames, SLICE_FRAMES):
        if heartbeat.lost:
            return
        if heartbeat.leave:
            lift_chunks.release(store, helper, chunk)
            return
        lifted = _lift(loaded, start, lift, prior)
        if room is not None:
            lifted = room.place(lifted, lift.views)
        parts.append(lifted)
        findings += lift_findings(lifted, prior, first_frame=chunk.first_frame + start)
    arrays = of_uncertainty(join(parts).arrays, _uncertainty_of(lift))
    lines = b"\n".join((*frames_to_json(arrays), b""))
    done = lift_chunks.finish(store, helper, chunk, arrays=arrays, lines=lines, findings=findings)
    if done.status == "succeeded":
        merged_findings = (Finding.model_validate(one) for one in done.findings or [])
        log_findings(logger, f"Lift {done.id}", merged_findings)
