"""Chunks of a lift: what a helper may write, for as long as it holds the lease of a chunk."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from models.findings.finding import Finding, dumped, merged
from store import clock, jobs, keys, lifts
from store.database import Store
from store.disposal import discard
from store.errors import LeaseLostError
from store.ids import new_id
from store.lift_files import Layout, pack
from store.records import LiftChunk, LiftRecord

RECENT_CHUNKS = 16  # whose pace predicts the time left


@dataclass(frozen=True)
class Helper:
    """One process that helps with a lift, a chunk at a time.

    Attributes
    ----------
    token
        The fencing token, which no other process ever has.
    lease_seconds
        How long a chunk is the helper's after each beat.
    """

    lift_id: str
    token: str
    lease_seconds: float


def join(lift_id: str, *, lease_seconds: float) -> Helper:
    """Return a new helper of a lift."""
    return Helper(lift_id, new_id("help"), lease_seconds)


def claim(
    store: Store, helper: Helper, *, on_loss: Callable[[], None] = lambda: None
) -> LiftChunk | None:
    """Claim the first free chunk, or None; a chunk whose lease ran out is free.

    The first claim starts the lift. A lift fails when one of its chunks has taken down too many
    workers. `on_loss` is called if the chunk was taken from one that died.
    """
    condemned: list[str] = []
    lost = False
    with store.writing() as session:
        now, prompt = clock.read_promptly(session)
        lift = _running(session, helper.lift_id)
        if lift is None:
            return None
        chunk = session.scalar(
            select(LiftChunk)
            .where(LiftChunk.lift_id == lift.id, *lifts.claimable(expired=prompt))
            .order_by(LiftChunk.first_frame)
            .limit(1)
        )
        if chunk is not None and chunk.lease_expires_at is not None:  # its worker died
            lost = True
            condemned = _lose(session, lift, chunk, "worker_lost", "its worker died each time")
        if chunk is not None and lift.status in ("queued", "running"):
            chunk.holder, chunk.lease_expires_at = helper.token, now + helper.lease_seconds
            if lift.status == "queued":
                lift.status, lift.started_at = "running", now
                lift.revision += 1
        else:
            chunk = None
    if lost:
        on_loss()
    discard(store, *condemned)
    return chunk


def beat(store: Store, helper: Helper, _progress: object = None) -> None:
    """Keep the lease of the helper's chunk.

    Raises
    ------
    LeaseLostError
        If the lift has ended, or was deleted.
    """
    mine = (
        (LiftChunk.lift_id == helper.lift_id)
        & (LiftChunk.holder == helper.token)
        & LiftChunk.finished_at.is_(None)
    )
    with store.reading() as session:  # the common case takes no write lock
        status = session.scalar(select(LiftRecord.status).where(LiftRecord.id == helper.lift_id))
        left = session.scalar(
            select(func.min(LiftChunk.lease_expires_at) - clock.now()).where(mine)
        )
    if status is None or status in jobs.TERMINAL:
        raise LeaseLostError(f"Lift {helper.lift_id} has ended.")
    if left is not None and left < 0.75 * helper.lease_seconds:
        with store.writing() as session:
            until = clock.now() + helper.lease_seconds
            session.execute(update(LiftChunk).where(mine).values(lease_expires_at=until))


def finish(
    store: Store,
    helper: Helper,
    chunk: LiftChunk,
    *,
    arrays: dict[str, Any],
    lines: bytes,
    findings: Iterable[Finding] = (),
) -> LiftRecord:
    """Store a chunk's result, for good; the last chunk's ends the lift. Returns the lift.

    Parameters
    ----------
    arrays
        The lift's arrays under the names that they have in the result, frames first.
    lines
        The same as JSON lines.
    findings
        Of the chunk's frames, which they name; they are merged with those of the others.

    Raises
    ------
    LeaseLostError
        If the chunk is no longer this helper's.
    """
    with store.reading() as session:  # an older version may have begun it, with fewer arrays
        layout = session.scalar(select(LiftRecord.layout).where(LiftRecord.id == helper.lift_id))
    packed = pack({name: arrays[name] for name, *_ in layout} if layout else arrays)
    arrays_key, lines_key = keys.of_lifted(helper.lift_id, packed.data, lines)
    done = False
    try:
        store.objects.put(arrays_key, packed.data)
        store.objects.put(lines_key, lines)
        with store.writing() as session:
            lift, mine = _held(session, helper, chunk)
            mine.arrays_key, mine.lines_key = arrays_key, lines_key
            lift.stored_bytes += len(packed.data) + len(lines)
            mine.lines_bytes, mine.checksums = len(lines), packed.checksums
            mine.finished_at, mine.holder, mine.lease_expires_at = clock.read(session), None, None
            earlier = (Finding.model_validate(finding) for finding in lift.findings or [])
            lift.findings = dumped(merged((*earlier, *findings)))
            _count(session, lift, mine, packed.layout)
        done = True
    finally:
        if not done:
            discard(store, arrays_key, lines_key)
    return lift


def _count(session: Session, lift: LiftRecord, chunk: LiftChunk, layout: Layout) -> None:
    """Count a finished chunk, and end the lift with its last."""
    lift.layout = lift.layout or layout
    lift.chunks_done += 1
    lift.frames_done += chunk.frames
    if lift.chunks_done == lift.chunks:
        lifts.end(session, lift, "succeeded")
    else:
        lift.revision += 1
        lift.seconds_left = _seconds_left(session, lift)


def _seconds_left(session: Session, lift: LiftRecord) -> float | None:
    """Predict how long the frames left take, at the pace of the chunks finished last."""
    session.flush()
    found = session.scalars(
        select(LiftChunk)
        .where(LiftChunk.lift_id == lift.id, LiftChunk.finished_at.is_not(None))
        .order_by(LiftChunk.finished_at.desc())
        .limit(RECENT_CHUNKS)
    ).all()
    recent = list(found)
    # Helpers work side by side: between their first chunks lies no time that shows a pace.
    all_of_it = len(recent) < RECENT_CHUNKS
    begun = lift.started_at if all_of_it else recent.pop().finished_at
    took = (recent[0].finished_at or 0) - (begun or 0)
    return (lift.frames - lift.frames_done) * took / sum(chunk.frames for chunk in recent)


def release(store: Store, helper: Helper, chunk: LiftChunk) -> None:
    """Give a chunk back undone, to be done by another."""
    with store.writing() as session:
        _, mine = _held(session, helper, chunk)
        mine.holder = mine.lease_expires_at = None


def give_up(store: Store, helper: Helper, chunk: LiftChunk, why: str) -> None:
    """Give a chunk back because of an error; after too many of them, the lift fails.

    Raises ``LeaseLostError`` if the chunk is no longer this helper's.
    """
    with store.writing() as session:
        lift, mine = _held(session, helper, chunk)
        condemned = _lose(session, lift, mine, "internal_error", why)
    discard(store, *condemned)


def fail(store: Store, helper: Helper, code: str, message: str) -> None:
    """End the lift as failed; nothing happens if it has ended already."""
    condemned: list[str] = []
    with store.writing() as session:
        lift = _running(session, helper.lift_id)
        if lift is not None:
            condemned = lifts.end(session, lift, "failed", {"code": code, "message": message})
    discard(store, *condemned)


def _lose(session: Session, lift: LiftRecord, chunk: LiftChunk, code: str, why: str) -> list[str]:
    """Free a chunk that took down its helper; return the objects of a lift that fails of it."""
    chunk.crashes += 1
    chunk.holder = chunk.lease_expires_at = None
    if chunk.crashes < jobs.MAX_CRASHES:
        return []
    session.flush()
    return lifts.end(
        session,
        lift,
        "failed",
        {
            "code": code,
            "message": f"Frames {chunk.first_frame} to {chunk.first_frame + chunk.frames - 1} "
            f"could not be lifted, tried {chunk.crashes} times: {why}."[:500],
        },
    )


def _running(session: Session, lift_id: str) -> LiftRecord | None:
    """Lock a lift before any of its chunks, as everyone does; None if it has ended or is gone."""
    lift = session.get(LiftRecord, lift_id, with_for_update=True)
    return None if lift is None or lift.status in jobs.TERMINAL else lift


def _held(session: Session, helper: Helper, chunk: LiftChunk) -> tuple[LiftRecord, LiftChunk]:
    lift = _running(session, helper.lift_id)
    mine = session.get(LiftChunk, (chunk.lift_id, chunk.first_frame), with_for_update=True)
    if lift is None or mine is None or mine.holder != helper.token:
        raise LeaseLostError(f"Chunk {chunk.first_frame} of {chunk.lift_id} is not held any more.")
    return lift, mine
