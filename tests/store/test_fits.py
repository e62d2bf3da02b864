import re
import time
from typing import Any

import pytest

from models.settings.config import WARM_STEPS, FitConfig
from store import attempts, datasets, fits, housekeeping, jobs, lifts, lookup, models
from store.attempts import Attempt
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import (
    ConfigError,
    ConflictError,
    LeaseLostError,
    NotFoundError,
    QueueFullError,
    SourceError,
)
from store.idempotency import Idempotency
from store.jobs import MAX_CRASHES
from store.records import FitRecord, ModelRecord
from store.reports import Report, load_report
from store.version import VERSION

DESCRIBE = {
    "keypoints": 5,
    "config": {},
    "training_curve": [],
    "metrics": {},
}


@pytest.fixture
def fit(store: Store, capture: Capture) -> FitRecord:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    return fits.create(store, dataset_id=dataset.id, name="f", config={"seed": 1})


def claim(store: Store, fit: FitRecord, lease_seconds: float = 60) -> Attempt:
    attempt = attempts.claim(store, fit.id, lease_seconds=lease_seconds)
    assert attempt is not None
    return attempt


def succeed(store: Store, attempt: Attempt) -> str:
    return attempts.succeed(
        store, attempt, weights=b"w", reconstruction=b"r", progress=None, describe=DESCRIBE
    )


def objects(store: Store) -> set[str]:
    return {re.split("[_.]", key.split("/")[2])[0] for key, _ in store.objects.list()}


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"calibration": [None]}, "expected 2, got 1"),
        ({"known_length": {"keypoints": [0, 5], "length": 1}}, "2 different keypoints below 5"),
        ({"known_length": {"keypoints": [3, 3], "length": 1}}, "2 different keypoints"),
        ({"handedness": [0, 1, 2, 2]}, "4 different keypoints"),
        ({"handedness": [0, 1, 2, 9]}, r"got \[0, 1, 2, 9\]"),
    ],
)
def test_a_config_must_speak_of_the_datasets_views_and_keypoints(
    store: Store, fit: FitRecord, config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        fits.create(store, dataset_id=fit.dataset_id, name="f", config=config)
    assert [refused.value.field] == list(config)
    good = {
        "calibration": [None, None],
        "known_length": {"keypoints": [0, 4], "length": 1},
        "handedness": [0, 1, 2, 4],
    }
    kept = fits.create(store, dataset_id=fit.dataset_id, name="f", config=good).config
    assert kept == FitConfig.model_validate(good).model_dump(mode="json")


def _model(store: Store, *, keypoints: int) -> str:
    return models.create(
        store,
        b"weights",
        name="m",
        fit_id=None,
        dataset_id=None,
        views=2,
        keypoints=keypoints,
        frames=3,
        config=FitConfig(dictionary_sizes=(16, 8)).model_dump(mode="json"),
        skeleton=None,
        training_curve=[],
        metrics={},
    ).id


def test_a_fit_may_start_from_a_model_of_the_same_keypoints(store: Store, fit: FitRecord) -> None:
    def start(model_id: str, config: dict[str, Any]) -> FitRecord:
        return fits.create(
            store, dataset_id=fit.dataset_id, name="f", config=config, from_model=model_id
        )

    good = _model(store, keypoints=5)
    made = start(good, {"seed": 2})
    assert made.from_model == good
    assert made.config["dictionary_sizes"] == [16, 8]
    assert (made.config["steps"], made.config["seed"]) == (WARM_STEPS, 2)
    other = start(good, {"steps": 9})
    assert other.config["steps"] == 9
    with pytest.raises(SourceError, match="expected 5 as in the dataset, got 6") as refused:
        start(_model(store, keypoints=6), {})
    assert refused.value.field == "from_model"
    with pytest.raises(ConfigError, match=r"expected \[16, 8\], got \[16, 4\]"):
        start(good, {"dictionary_sizes": [16, 4]})
    for waiting in (made, other):
        fits.cancel(store, waiting.id)
    models.delete(store, good)
    with pytest.raises(NotFoundError, match=good):
        start(good, {})


def test_one_attempt_at_a_time(store: Store, fit: FitRecord) -> None:
    claim(store, fit)
    assert attempts.claim(store, fit.id, lease_seconds=60) is None
    assert lookup.get(store, FitRecord, fit.id).status == "running"


def test_a_stale_attempt_can_write_nothing(store: Store, fit: FitRecord) -> None:
    stale = claim(store, fit, lease_seconds=0.01)
    attempts.save_checkpoint(store, stale, b"old")
    time.sleep(0.02)
    fresh = claim(store, fit)
    before = lookup.get(store, FitRecord, fit.id)
    for write in (
        lambda: attempts.beat(store, stale, {"step": 99}),
        lambda: attempts.save_checkpoint(store, stale, b"stale"),
        lambda: succeed(store, stale),
        lambda: attempts.end(store, stale, "failed", error={"code": "x", "message": "x"}),
        lambda: attempts.release(store, stale),
    ):
        with pytest.raises(LeaseLostError):
            write()
    after = lookup.get(store, FitRecord, fit.id)
    assert (after.status, after.revision, after.progress, after.model_id) == (
        "running",
        before.revision,
        None,
        None,
    )
    assert attempts.load_checkpoint(store, fit.id) == b"old"
    assert objects(store) == {"chunk", "checkpoint"}
    assert lookup.page(store, ModelRecord, limit=1, after=None) == []
    succeed(store, fresh)


def test_success_leaves_model_and_reconstruction_and_no_checkpoint(
    store: Store, fit: FitRecord
) -> None:
    attempt = claim(store, fit)
    attempts.save_checkpoint(store, attempt, b"1")
    attempts.save_checkpoint(store, attempt, b"2")
    model_id = succeed(store, attempt)
    record = lookup.get(store, FitRecord, fit.id)
    assert (record.status, record.model_id) == ("succeeded", model_id)
    assert lookup.get(store, ModelRecord, model_id).fit_id == fit.id
    assert objects(store) == {"chunk", "weights", "reconstruction"}


@pytest.mark.parametrize("status", ["succeeded", "failed", "cancelled"])
def test_terminal_states_are_never_left(store: Store, fit: FitRecord, status: str) -> None:
    attempt = claim(store, fit)
    if status == "succeeded":
        succeed(store, attempt)
    else:
        attempts.end(store, attempt, status)
    assert attempts.claim(store, fit.id, lease_seconds=60) is None
    assert fits.recover(store) == []
    with pytest.raises(LeaseLostError):
        attempts.beat(store, attempt, None)
    if status == "cancelled":
        fits.cancel(store, fit.id)
    else:
        with pytest.raises(ConflictError):
            fits.cancel(store, fit.id)
    ended = lookup.get(store, FitRecord, fit.id)
    assert (ended.status, ended.version) == (status, VERSION)


def test_cancelling(store: Store, fit: FitRecord) -> None:
    attempt = claim(store, fit)
    assert attempts.beat(store, attempt, None) is False
    asked = fits.cancel(store, fit.id)
    assert asked.status == "running"
    assert attempts.beat(store, attempt, None) is True
    assert fits.enforce_cancel(store, fit.job_id, patience_seconds=60) is False
    assert fits.enforce_cancel(store, fit.job_id, patience_seconds=0) is True
    assert lookup.get(store, FitRecord, fit.id).status == "cancelled"
    with pytest.raises(LeaseLostError):
        succeed(store, attempt)


def test_a_queued_fit_is_cancelled_at_once(store: Store, fit: FitRecord) -> None:
    assert fits.cancel(store, fit.id).status == "cancelled"
    assert attempts.claim(store, fit.id, lease_seconds=60) is None


def test_a_fit_nobody_runs_any_more_is_cancelled_at_once(store: Store, fit: FitRecord) -> None:
    attempt = claim(store, fit, lease_seconds=0.01)
    time.sleep(0.02)
    assert fits.cancel(store, fit.id).status == "cancelled"
    with pytest.raises(LeaseLostError):
        attempts.beat(store, attempt, None)


def test_a_lost_fit_is_queued_again_and_given_up_in_the_end(store: Store, fit: FitRecord) -> None:
    for crash in range(1, MAX_CRASHES + 1):
        claim(store, fit, lease_seconds=0.001)
        time.sleep(0.005)
        queued = [lost.id for lost in fits.recover(store)]
        assert queued == ([fit.id] if crash < MAX_CRASHES else [])
    record = lookup.get(store, FitRecord, fit.id)
    assert record.status == "failed"
    assert record.error is not None
    assert record.error["code"] == "worker_lost"


def test_a_released_fit_counts_no_crash_and_keeps_its_checkpoint(
    store: Store, fit: FitRecord
) -> None:
    attempt = claim(store, fit)
    attempts.save_checkpoint(store, attempt, b"half")
    attempts.release(store, attempt)
    record = lookup.get(store, FitRecord, fit.id)
    assert (record.status, record.crashes) == ("queued", 0)
    claim(store, fit)
    assert attempts.load_checkpoint(store, fit.id) == b"half"


def test_a_fit_released_as_it_is_cancelled_is_cancelled(store: Store, fit: FitRecord) -> None:
    attempt = claim(store, fit)
    fits.cancel(store, fit.id)
    attempts.release(store, attempt)
    assert lookup.get(store, FitRecord, fit.id).status == "cancelled"
    assert fits.recover(store) == []


def test_whoever_ends_a_fit_its_checkpoint_goes(store: Store, fit: FitRecord) -> None:
    attempt = claim(store, fit)
    attempts.save_checkpoint(store, attempt, b"half")
    fits.cancel(store, fit.id)
    assert fits.enforce_cancel(store, fit.job_id, patience_seconds=0)
    housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
    assert objects(store) == {"chunk"}


def test_only_so_many_fits_wait_and_a_repeated_request_is_none_of_them(
    store: Store, fit: FitRecord
) -> None:
    def create(idempotency: Idempotency | None) -> str:
        return fits.create(
            store,
            dataset_id=fit.dataset_id,
            name="g",
            config={},
            max_queued=2,
            idempotency=idempotency,
        ).id

    request = Idempotency("POST /fits", "k", "x")
    assert create(request) == create(request)
    with pytest.raises(QueueFullError):
        create(None)


def test_attempts_count_starts(store: Store, fit: FitRecord) -> None:
    claim(store, fit, lease_seconds=0.001)
    time.sleep(0.005)
    fits.recover(store)
    assert claim(store, fit).number == 2


def test_one_fit_per_job(store: Store, fit: FitRecord) -> None:
    first = fits.create(store, dataset_id=fit.dataset_id, name="x", config={}, job_id="job")
    again = fits.create(store, dataset_id=fit.dataset_id, name="x", config={}, job_id="job")
    assert first.id == again.id


def test_deleting_a_fit_keeps_its_model(store: Store, fit: FitRecord) -> None:
    attempt = claim(store, fit)
    with pytest.raises(ConflictError):
        fits.delete(store, fit.id)
    model_id = succeed(store, attempt)
    fits.delete(store, fit.id)
    assert lookup.get(store, ModelRecord, model_id).fit_id is None
    assert "reconstruction" not in objects(store)


def test_a_report_is_kept_with_its_fit_and_goes_with_it(store: Store, fit: FitRecord) -> None:
    with pytest.raises(ConflictError, match="only a fit that succeeded"):
        load_report(store, fit)
    made: dict[str, Any] = {"weights": b"w", "reconstruction": b"r", "describe": DESCRIBE}
    report = Report("Rely on it.", b"{}")
    attempts.succeed(store, claim(store, fit), report=report, progress=None, **made)
    done = lookup.get(store, FitRecord, fit.id)
    assert (done.report_words, load_report(store, done)) == report
    assert done.stored_bytes == len(b"r") + len(report.data)
    housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
    assert "report" in objects(store)
    fits.delete(store, fit.id)
    assert "report" not in objects(store)
    with pytest.raises(NotFoundError):
        load_report(store, done)


def test_a_lift_in_its_room_keeps_a_fit(store: Store, fit: FitRecord) -> None:
    model_id = succeed(store, claim(store, fit))
    asked: dict[str, Any] = {"model_id": model_id, "dataset_id": fit.dataset_id, "chunk_frames": 5}
    lifts.create(store, name="canonical", **asked)
    lift = lifts.create(store, name="upright", frame="room", up=[0, -1, 0], **asked)
    with pytest.raises(ConflictError, match=rf"{fit.id}.*in use by {lift.id}: cancel"):
        fits.delete(store, fit.id)
    lifts.cancel(store, lift.id)
    fits.delete(store, fit.id)


def test_a_fit_that_gets_further_each_time_is_tried_on(store: Store, fit: FitRecord) -> None:
    def crash_at(step: int) -> FitRecord:
        attempt = claim(store, fit)
        attempts.beat(store, attempt, {"step": step})
        attempts.give_up(store, attempt, "killed")
        return lookup.get(store, FitRecord, fit.id)

    for step in range(10, 10 * jobs.MAX_CRASHES, 10):
        assert crash_at(step).status == "queued"
    for _ in range(jobs.MAX_CRASHES - 2):
        assert crash_at(step).status == "queued"
    assert crash_at(step - 1).status == "failed"
