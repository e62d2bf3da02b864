"""Datasets: stored captures, taken whole or streamed in chunks."""

import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import func, select

from models.settings.times import check_rate
from store import audit, corrections, dataset_findings, jobs, keys
from store.account import PART_BYTES
from store.authors import owned_by
from store.capture import Capture, Float64, concatenate, extend_checksum
from store.corrections import Corrections
from store.database import Store
from store.disposal import condemn, discard
from store.errors import CaptureError, NotFoundError
from store.idempotency import Idempotency, claim, replayed
from store.ids import new_id
from store.labels import Labels
from store.lookup import get, lock, lost
from store.records import Chunk, DatasetRecord, FitRecord, LiftRecord
from store.space import discarded_if_full
from store.usage import check


@dataclass(frozen=True)
class CaptureDescription:
    """The description of a dataset besides its arrays."""

    name: str
    skeleton: dict[str, Any] | None = None
    view_names: list[str] | None = None
    image_sizes: list[Any] | None = None
    fps: float | None = None
    calibration: dict[str, Any] | None = None
    notes: list[str] = field(default_factory=list)
    labels: Labels = field(default_factory=Labels)


def create(
    store: Store,
    capture: Capture,
    description: CaptureDescription,
    *,
    idempotency: Idempotency | None = None,
) -> DatasetRecord:
    """Store a capture as a new dataset, or return the one this request made before."""
    dataset_id, data = new_id("ds"), capture.to_bytes()
    with store.reading() as session:  # before anything is stored in vain
        earlier = replayed(session, idempotency)
        if earlier is None:
            check(session, len(data))
    if earlier is not None:
        return get(store, DatasetRecord, earlier)
    key, size = _put_chunk(store, dataset_id, data)
    dataset = described(store, capture, description)
    dataset.id, dataset.stored_bytes = dataset_id, size
    with discarded_if_full(store, key), store.writing() as session:
        earlier = claim(session, idempotency, dataset_id)
        if earlier is None:
            session.add(dataset)
            session.flush()
            session.add(Chunk(dataset_id=dataset_id, first_frame=0, frames=capture.frames, key=key))
            audit.note(session, "dataset.create", dataset_id)
    if earlier is not None:
        discard(store, key)
        return get(store, DatasetRecord, earlier)
    return dataset


def described(store: Store, capture: Capture, description: CaptureDescription) -> DatasetRecord:
    """Return the record that a capture would have; nothing is stored, and it has no identifier."""
    return DatasetRecord(
        name=description.name,
        created_at=time.time(),
        frames=capture.frames,
        views=capture.keypoints.shape[1],
        keypoints=capture.keypoints.shape[2],
        observed=capture.observed(),
        confidence=capture.confidence is not None,
        ground_truth=capture.points3d is not None,
        checksum=extend_checksum("", capture),
        skeleton=description.skeleton,
        view_names=description.view_names,
        image_sizes=description.image_sizes,
        fps=description.fps,
        calibration=description.calibration,
        last_times=_last_times(capture),
        notes=description.notes,
        findings=dataset_findings.of_new(capture, description.image_sizes),
        **owned_by(store.author),
        **description.labels.columns(),
    )


def append(
    store: Store,
    dataset_id: str,
    capture: Capture,
    *,
    max_frames: int,
    idempotency: Idempotency | None = None,
) -> DatasetRecord:
    """Add frames at the end of a dataset.

    Raises
    ------
    NotFoundError
        If there is no such dataset.
    CaptureError
        If views or keypoints are not the dataset's, or it would grow beyond ``max_frames``; if
        only one of them has times, or those of the new frames are not later.
    """
    dataset = get(store, DatasetRecord, dataset_id)
    expected = (dataset.views, dataset.keypoints)
    if capture.keypoints.shape[1:3] != expected:
        raise CaptureError(
            "keypoints",
            f"expected {expected[0]} views of {expected[1]} keypoints as in the dataset, "
            f"got {capture.keypoints.shape[1]} of {capture.keypoints.shape[2]}",
        )
    data = capture.to_bytes()
    with store.reading() as session:  # before anything is stored in vain
        if replayed(session, idempotency) is None:
            check(session, len(data))
    key, size = _put_chunk(store, dataset_id, data)
    appended = False
    try:
        while not appended:
            with store.reading() as session:
                if replayed(session, idempotency) is not None:
                    break
            dataset = get(store, DatasetRecord, dataset_id)
            if dataset.frames + capture.frames > max_frames:
                raise CaptureError(
                    "keypoints",
                    f"expected at most {max_frames} frames in a dataset, it has {dataset.frames} "
                    f"and {capture.frames} more came; start a new dataset",
                )
            _check_times(dataset, capture)
            columns = _with(dataset, capture)  # too slow for a transaction
            columns["findings"] = dataset_findings.of_longer(store, dataset, capture)
            with discarded_if_full(store, key), store.writing() as session:
                if replayed(session, idempotency) is not None:
                    break
                record = lock(session, DatasetRecord, dataset_id)
                appended = corrections.same_keypoints(record, dataset)  # else others changed them
                if appended:
                    columns["stored_bytes"] = record.stored_bytes + size
                    for name, value in columns.items():
                        setattr(record, name, value)
                    session.add(
                        Chunk(
                            dataset_id=dataset_id,
                            first_frame=dataset.frames,
                            frames=capture.frames,
                            key=key,
                        )
                    )
                    claim(session, idempotency, dataset_id)  # no other request has it: see above
                    audit.note(session, "dataset.append", dataset_id)
    finally:
        if not appended:
            discard(store, key)
    return get(store, DatasetRecord, dataset_id)


def _with(dataset: DatasetRecord, capture: Capture) -> dict[str, Any]:
    """Return the columns of a dataset that a capture's frames are added to."""
    observed = zip(dataset.observed, capture.observed(), strict=True)
    return {
        "frames": dataset.frames + capture.frames,
        "observed": [sum(counts) for counts in observed],
        "confidence": dataset.confidence or capture.confidence is not None,
        "ground_truth": dataset.ground_truth or capture.points3d is not None,
        "checksum": extend_checksum(dataset.checksum, capture),
        "last_times": _last_times(capture),
    }


def _last_times(capture: Capture) -> list[float] | None:
    """Return the time of the last frame, or those of its views; None without times."""
    return None if capture.times is None else np.atleast_1d(capture.times[-1]).tolist()


def _check_times(dataset: DatasetRecord, capture: Capture) -> None:
    """Raise ``CaptureError`` unless the times of new frames go on from those of the dataset."""
    last, times = dataset.last_times, capture.times
    if last is None and times is None:
        return
    if last is None or times is None or len(last) != np.atleast_1d(times[0]).size:
        has = "none" if last is None else "one a frame" if len(last) == 1 else "one a view"
        raise CaptureError(
            "times", f"expected times as in the frames before, which have {has}; give the same"
        )
    if (np.atleast_1d(times[0]) <= last).any():
        raise CaptureError(
            "times",
            f"expected the first frame to be later than the last one of the dataset, at {last} s, "
            f"got {np.atleast_1d(times[0]).tolist()}",
        )
    if dataset.fps is not None:
        try:
            check_rate(dataset.fps, times)
        except ValueError as error:
            raise CaptureError("times", str(error)) from error


def times_of(dataset: DatasetRecord, capture: Capture, first_frame: int = 0) -> Float64 | None:
    """Return the times (N,) or (N, K) of a dataset's frames from ``first_frame`` on, in seconds.

    None if the dataset has neither times nor frames per second.
    """
    if capture.times is not None or dataset.fps is None:
        return capture.times
    return (first_frame + np.arange(capture.frames)) / dataset.fps


def load(
    store: Store,
    dataset_id: str,
    *,
    frames: int | None = None,
    corrected: Corrections | None = None,
) -> Capture:
    """Read a dataset's arrays, all of them or the first ``frames``, with corrections applied.

    Those are the ones that the dataset has now, unless others are given.
    """
    query = select(Chunk).where(Chunk.dataset_id == dataset_id).order_by(Chunk.first_frame)
    if frames is not None:
        query = query.where(Chunk.first_frame < frames)
    with store.reading() as session:
        keys = [chunk.key for chunk in session.scalars(query)]
        if corrected is None:
            corrected = corrections.of(session, DatasetRecord, dataset_id)
    if not keys:
        raise NotFoundError("dataset", dataset_id)
    try:
        detected = concatenate([Capture.from_bytes(store.objects.get(key)) for key in keys])
    except FileNotFoundError as error:
        raise lost(store, DatasetRecord, dataset_id, error) from error
    return corrections.applied(detected, corrected)


def load_frames(
    store: Store, dataset_id: str, start: int, stop: int, *, corrected: Corrections | None = None
) -> Capture:
    """Read the frames from ``start`` up to ``stop``, and no others, without the ground truth.

    Corrections are applied, as :func:`load` has it.

    Raises ``NotFoundError`` if there is no such dataset, or if it has not all of these frames.
    """
    before = select(func.max(Chunk.first_frame)).where(
        Chunk.dataset_id == dataset_id, Chunk.first_frame <= start
    )
    query = (
        select(Chunk)
        .where(
            Chunk.dataset_id == dataset_id,
            Chunk.first_frame >= before.scalar_subquery(),
            Chunk.first_frame < stop,
        )
        .order_by(Chunk.first_frame)
    )
    with store.reading() as session:
        chunks = list(session.scalars(query))
        if corrected is None:
            corrected = corrections.of(session, DatasetRecord, dataset_id)
    if not chunks or chunks[-1].first_frame + chunks[-1].frames < stop:
        raise NotFoundError("dataset", dataset_id)
    try:
        detected = concatenate(
            [
                Capture.frames_from(
                    partial(store.objects.get_range, chunk.key),
                    slice(
                        max(start - chunk.first_frame, 0),
                        min(stop - chunk.first_frame, chunk.frames),
                    ),
                )
                for chunk in chunks
            ]
        )
    except FileNotFoundError as error:
        raise lost(store, DatasetRecord, dataset_id, error) from error
    return corrections.applied(detected, corrected, start)


def delete(store: Store, dataset_id: str) -> None:
    """Delete a dataset and its arrays.

    Raises
    ------
    NotFoundError
        If there is no such dataset.
    ConflictError
        If a fit or a lift of it is queued or running.
    """
    with store.writing() as session:
        dataset = lock(session, DatasetRecord, dataset_id)
        refuse = partial(jobs.refuse_if_used, session, "Dataset", dataset_id)
        refuse(FitRecord, FitRecord.dataset_id == dataset_id)
        refuse(LiftRecord, LiftRecord.dataset_id == dataset_id)
        chunks = session.scalars(select(Chunk.key).where(Chunk.dataset_id == dataset_id)).all()
        condemned = condemn(session, chunks)
        session.delete(dataset)
        audit.note(session, "dataset.delete", dataset_id)
    discard(store, *condemned)


def _put_chunk(store: Store, dataset_id: str, data: bytes) -> tuple[str, int]:
    """Store frames as an object; return its key, and the bytes of it and of its row."""
    key = keys.of_chunk(dataset_id, data)
    store.objects.put(key, data)
    return key, len(data) + PART_BYTES
