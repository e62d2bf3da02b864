"""A host whose clock is wrong harms nobody's work."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest

from store import attempts, clock, datasets, fits, lift_chunks, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.records import FitRecord, LiftRecord

HOUR = 3600.0


@contextmanager
def clock_off(seconds: float) -> Iterator[None]:
    """Be on a host whose clock is off."""
    right = time.time
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "time", lambda: right() + seconds)
        yield


@pytest.mark.parametrize("off", [-HOUR, HOUR])
def test_a_fit_is_not_taken_from_a_worker_that_holds_it(
    store: Store, capture: Capture, off: float
) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    fit = fits.create(store, dataset_id=dataset.id, name="f", config={})
    with clock_off(off):
        attempt = attempts.claim(store, fit.id, lease_seconds=5)
        assert attempt is not None
        attempts.beat(store, attempt, {"step": 1})
    assert fits.recover(store) == []
    assert attempts.claim(store, fit.id, lease_seconds=5) is None
    with clock_off(-off):
        assert fits.recover(store) == []
        fits.cancel(store, fit.id)
        assert not fits.enforce_cancel(store, fit.job_id, patience_seconds=60)
    record = lookup.get(store, FitRecord, fit.id)
    assert (record.status, record.crashes) == ("running", 0)


def make_lift(store: Store, capture: Capture) -> LiftRecord:
    """Record a lift of one chunk."""
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    about: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    model = models.create(store, b"weights", name="m", keypoints=dataset.keypoints, **about)
    chunk_frames = dataset.frames
    return lifts.create(
        store, model_id=model.id, dataset_id=dataset.id, name="l", chunk_frames=chunk_frames
    )


@pytest.mark.parametrize("off", [-HOUR, HOUR])
def test_a_chunk_is_not_taken_from_a_helper_that_holds_it(
    store: Store, capture: Capture, off: float
) -> None:
    lift = make_lift(store, capture)
    with clock_off(off):
        helper = lift_chunks.join(lift.id, lease_seconds=5)
        assert lift_chunks.claim(store, helper) is not None
        lift_chunks.beat(store, helper)
    assert lift_chunks.claim(store, lift_chunks.join(lift.id, lease_seconds=5)) is None
    assert lifts.recover(store) == []
    with clock_off(off):
        lifts.cancel(store, lift.id)
    assert not lifts.was_cancelled(store, lift.job_id, patience_seconds=60)
    assert lifts.was_cancelled(store, lift.job_id, patience_seconds=-1)
    assert lookup.get(store, LiftRecord, lift.id).status == "cancelled"


def test_who_waited_for_the_records_takes_nothing_whose_holder_had_to_wait_too(
    store: Store, capture: Capture
) -> None:
    lift = make_lift(store, capture)
    fit = fits.create(store, dataset_id=lift.dataset_id, name="f", config={})
    assert attempts.claim(store, fit.id, lease_seconds=1.5) is not None
    holder, other = (lift_chunks.join(lift.id, lease_seconds=1.5) for _ in range(2))
    assert lift_chunks.claim(store, holder) is not None
    with ThreadPoolExecutor() as threads:
        with store.writing() as session:
            clock.read(session)
            chunk = threads.submit(lift_chunks.claim, store, other)
            attempt = threads.submit(attempts.claim, store, fit.id, lease_seconds=1.5)
            lost = threads.submit(fits.recover, store)
            time.sleep(2)
        assert (chunk.result(), attempt.result(), lost.result()) == (None, None, [])
    assert lift_chunks.claim(store, other) is not None  # now it means a death
    assert [lost.id for lost in fits.recover(store)] == [fit.id]


def test_the_records_tell_the_time(store: Store) -> None:
    with store.reading() as session:
        assert abs(clock.read(session) - time.time()) < 1
