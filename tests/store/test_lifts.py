"""Lifts in the records: claims, leases, and a result that is read in any parts."""

import io
import time
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load

from store import datasets, housekeeping, jobs, lift_chunks, lifts, lookup, models
from store.array_files import LaidOutFile
from store.capture import Capture
from store.crc import combine
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import ConflictError, LeaseLostError, LiftError, NotFoundError, QueueFullError
from store.jobs import MAX_CRASHES
from store.lift_chunks import Helper
from store.lift_files import ResultFormat, result_file
from store.records import LiftChunk, LiftRecord
from tests.deployments import scaled_is_thorough

FRAMES, CHUNK = 12, 5
RNG = np.random.default_rng(0)
ARRAYS: dict[str, Any] = {
    "points3d": RNG.normal(size=(FRAMES, 5, 3)).astype(np.float32),
    "scales": RNG.normal(size=(FRAMES, 2)).astype(np.float32),
    "camera_models": RNG.integers(-1, 3, (FRAMES, 2)).astype(np.int8),
    "keypoints_used": RNG.integers(0, 5, (FRAMES, 2)).astype(np.int32),
}


def make_model(store: Store, keypoints: int = 5) -> str:
    columns: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    return models.create(store, b"w", name="m", keypoints=keypoints, **columns).id


@pytest.fixture
def lift(store: Store, capture: Capture) -> LiftRecord:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    return create(store, dataset.id)


def create(store: Store, dataset_id: str, **more: Any) -> LiftRecord:
    model_id = more.pop("model_id", None) or make_model(store)
    asked: dict[str, Any] = {"name": "l", "chunk_frames": CHUNK} | more
    return lifts.create(store, model_id=model_id, dataset_id=dataset_id, **asked)


def join(lift: LiftRecord, lease_seconds: float = 60) -> Helper:
    return lift_chunks.join(lift.id, lease_seconds=lease_seconds)


def claim(store: Store, helper: Helper) -> LiftChunk:
    chunk = lift_chunks.claim(store, helper)
    assert chunk is not None
    return chunk


def finish(store: Store, helper: Helper, chunk: LiftChunk, *, less: str | None = None) -> None:
    part = slice(chunk.first_frame, chunk.first_frame + chunk.frames)
    arrays = {name: array[part] for name, array in ARRAYS.items() if name != less}
    lines = b"".join(b'{"frame":%d}\n' % n for n in range(part.start, part.stop))
    lift_chunks.finish(store, helper, chunk, arrays=arrays, lines=lines)


def objects(store: Store) -> list[str]:
    return [key for key, _ in store.objects.list() if key.startswith("lifts/")]


def test_helpers_share_the_chunks_and_the_last_ends_the_lift(
    store: Store, lift: LiftRecord
) -> None:
    assert (lift.status, lift.frames, lift.chunks) == ("queued", 12, 3)
    ours, theirs = join(lift), join(lift)
    first, second = claim(store, ours), claim(store, theirs)
    assert lookup.get(store, LiftRecord, lift.id).status == "running"
    finish(store, theirs, second)
    assert lookup.get(store, LiftRecord, lift.id).seconds_left is not None  # a chunk is a pace
    third = claim(store, theirs)
    assert [(c.first_frame, c.frames) for c in (first, second, third)] == [(0, 5), (5, 5), (10, 2)]
    assert lift_chunks.claim(store, join(lift)) is None
    finish(store, theirs, third)
    half = lookup.get(store, LiftRecord, lift.id)
    assert (half.status, half.frames_done, half.chunks_done) == ("running", 7, 2)
    assert half.seconds_left is not None
    finish(store, ours, first)
    ended = lookup.get(store, LiftRecord, lift.id)
    assert (ended.status, ended.frames_done, ended.seconds_left) == ("succeeded", 12, None)
    assert lift.revision < half.revision < ended.revision
    assert len(objects(store)) == 6
    assert housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1) == (0, 0)
    lifts.delete(store, lift.id)
    assert objects(store) == []


def test_a_chunk_whose_lease_ran_out_is_anyones_and_its_old_holder_writes_nothing(
    store: Store, lift: LiftRecord
) -> None:
    stale = join(lift, lease_seconds=0.01)
    chunk = claim(store, stale)
    time.sleep(0.02)
    fresh = join(lift)
    again = claim(store, fresh)
    assert again.first_frame == chunk.first_frame
    writes: list[Callable[[], None]] = [
        lambda: finish(store, stale, chunk),
        lambda: lift_chunks.release(store, stale, chunk),
        lambda: lift_chunks.give_up(store, stale, chunk, "x"),
    ]
    for write in writes:
        with pytest.raises(LeaseLostError):
            write()
    assert objects(store) == []
    finish(store, fresh, again)
    with pytest.raises(LeaseLostError):
        finish(store, fresh, again)  # what is done stays as it is
    assert lookup.get(store, LiftRecord, lift.id).chunks_done == 1


def test_a_beat_keeps_the_lease(store: Store, lift: LiftRecord) -> None:
    helper = join(lift, lease_seconds=0.5)
    chunk = claim(store, helper)
    for _ in range(8):
        time.sleep(0.1)
        lift_chunks.beat(store, helper)
    assert claim(store, join(lift)).first_frame != chunk.first_frame
    finish(store, helper, chunk)


@pytest.mark.parametrize("how", ["lease", "error"])
def test_a_chunk_that_takes_down_its_workers_ends_the_lift(
    store: Store, lift: LiftRecord, how: str
) -> None:
    finish(store, done := join(lift), claim(store, done))
    for _ in range(MAX_CRASHES):
        assert lookup.get(store, LiftRecord, lift.id).status == "running"
        helper = join(lift, lease_seconds=0.001)
        chunk = claim(store, helper)
        assert chunk.first_frame == CHUNK
        if how == "error":
            lift_chunks.give_up(store, helper, chunk, "MemoryError: no more")
        time.sleep(0.005)
    assert lift_chunks.claim(store, join(lift)) is None
    record = lookup.get(store, LiftRecord, lift.id)
    assert record.status == "failed"
    assert record.error is not None
    assert record.error["code"] == ("worker_lost" if how == "lease" else "internal_error")
    assert "Frames 5 to 9" in record.error["message"]
    assert objects(store) == []


def test_a_chunk_given_back_counts_as_no_crash(store: Store, lift: LiftRecord) -> None:
    for _ in range(MAX_CRASHES + 1):
        helper = join(lift)
        lift_chunks.release(store, helper, claim(store, helper))
    assert claim(store, join(lift)).crashes == 0


def test_cancelling_is_at_once_and_final(store: Store, lift: LiftRecord) -> None:
    helper = join(lift)
    finish(store, helper, claim(store, helper))
    chunk = claim(store, helper)
    assert lifts.cancel(store, lift.id).status == "cancelled"
    assert lifts.cancel(store, lift.id).status == "cancelled"
    with pytest.raises(LeaseLostError):
        lift_chunks.beat(store, helper)
    with pytest.raises(LeaseLostError):
        finish(store, helper, chunk)
    lift_chunks.fail(store, helper, "x", "y")
    assert lookup.get(store, LiftRecord, lift.id).error is None
    assert lift_chunks.claim(store, helper) is None
    assert lifts.recover(store) == []
    assert objects(store) == []
    assert lifts.was_cancelled(store, lift.job_id, patience_seconds=0)
    assert not lifts.was_cancelled(store, lift.job_id, patience_seconds=60)


def test_a_lift_that_ended_otherwise_cannot_be_cancelled(store: Store, lift: LiftRecord) -> None:
    with pytest.raises(ConflictError):
        lifts.delete(store, lift.id)
    lift_chunks.fail(store, join(lift), "dataset_not_found", "gone")
    with pytest.raises(ConflictError):
        lifts.cancel(store, lift.id)
    lifts.delete(store, lift.id)
    with pytest.raises(NotFoundError):
        lookup.get(store, LiftRecord, lift.id)


def test_each_job_that_starts_makes_room_for_one_more(store: Store, lift: LiftRecord) -> None:
    first = jobs.waiting_job(lift)
    assert first == lift.job_id == lift.id
    claim(store, join(lift))
    called = lifts.call_next(store, lift.id, first)
    assert called is not None
    second = jobs.waiting_job(called)
    assert second != first
    for job_id in (first, second):
        found = lifts.helped(store, job_id)
        assert found is not None
        assert found.id == lift.id
    assert lifts.call_next(store, lift.id, first) is None  # it came twice
    assert [jobs.waiting_job(waiting) for waiting in lifts.recover(store)] == [second]
    helper = join(lift)
    chunk = claim(store, helper)
    claim(store, join(lift))
    assert lifts.recover(store) == []  # nothing is left to help with
    assert lifts.call_next(store, lift.id, second) is None
    lift_chunks.release(store, helper, chunk)
    assert len(lifts.recover(store)) == 1


def test_what_a_lift_needs_cannot_be_deleted(store: Store, lift: LiftRecord) -> None:
    for delete, identifier in ((datasets.delete, lift.dataset_id), (models.delete, lift.model_id)):
        with pytest.raises(ConflictError, match=lift.id):
            delete(store, identifier)
    lifts.cancel(store, lift.id)
    datasets.delete(store, lift.dataset_id)
    models.delete(store, lift.model_id)


def test_what_cannot_be_lifted_is_refused(store: Store, lift: LiftRecord) -> None:
    for model_id, dataset_id in ((lift.model_id, "ds_x"), ("mdl_x", lift.dataset_id)):
        with pytest.raises(NotFoundError):
            create(store, dataset_id, model_id=model_id)
    with pytest.raises(LiftError, match="6 keypoints as in the model, got one of 5") as refused:
        create(store, lift.dataset_id, model_id=make_model(store, 6))
    assert refused.value.field == "dataset_id"
    for views in ([0], [0, 0], [0, 1, 2]):
        with pytest.raises(LiftError) as refused:
            create(store, lift.dataset_id, views=views)
        assert refused.value.field == "views"
    assert create(store, lift.dataset_id, views=[3, 1]).views == [3, 1]
    with pytest.raises(QueueFullError):
        create(store, lift.dataset_id, max_queued=2)


@scaled_is_thorough
def test_many_keypoints_make_short_chunks(store: Store) -> None:
    rng = np.random.default_rng(0)  # moving keypoints are checked fast: static ones are compared
    many = Capture.checked(rng.uniform(0, 900, (9, 16, 512, 2)))
    dataset = datasets.create(store, many, CaptureDescription("a"))
    model_id = make_model(store, 512)
    lift = create(store, dataset.id, model_id=model_id, chunk_frames=4096)
    assert lift.chunks == 1
    wide = Capture.checked(rng.uniform(0, 900, (130, 32, 512, 2)))
    dataset = datasets.create(store, wide, CaptureDescription("a"))
    assert create(store, dataset.id, model_id=model_id, chunk_frames=4096).chunks == 3


@pytest.mark.parametrize(("start", "stop"), [(0, 12), (0, 1), (3, 9), (4, 8), (11, 12), (5, 5 + 7)])
def test_frames_are_read_without_the_others(store: Store, start: int, stop: int) -> None:
    rng = np.random.default_rng(1)
    keypoints = rng.uniform(0, 900, (12, 2, 5, 2)).astype(np.float32)
    confidence = rng.uniform(0, 1, (12, 2, 5)).astype(np.float32)
    truth = rng.normal(size=(12, 5, 3))
    dataset = datasets.create(store, Capture.checked(keypoints[:4]), CaptureDescription("a"))
    for cut in (slice(4, 5), slice(5, 12)):
        more = Capture.checked(keypoints[cut], confidence[cut], truth[cut])
        datasets.append(store, dataset.id, more, max_frames=100)
    confidence[:4] = 1
    found = datasets.load_frames(store, dataset.id, start, stop)
    np.testing.assert_array_equal(found.keypoints, keypoints[start:stop])
    if found.confidence is None:
        assert stop <= 4
    else:
        np.testing.assert_array_equal(found.confidence, confidence[start:stop])
    assert found.points3d is None
    with pytest.raises(NotFoundError):
        datasets.load_frames(store, dataset.id, start, 13)


def result(store: Store, lift: LiftRecord, wanted: ResultFormat) -> LaidOutFile:
    helper = join(lift)
    while (chunk := lift_chunks.claim(store, helper)) is not None:
        finish(store, helper, chunk)
    lift = lookup.get(store, LiftRecord, lift.id)
    return result_file(lift, lifts.finished_chunks(store, lift), wanted, {"lift_id": lift.id})


@scaled_is_thorough
@pytest.mark.parametrize("wanted", ["jsonl", "npz", "safetensors"])
def test_a_result_is_one_file_whichever_parts_of_it_are_read(
    store: Store, lift: LiftRecord, wanted: ResultFormat
) -> None:
    file = result(store, lift, wanted)
    get = store.objects.get_range
    whole = b"".join(file.read(get, 0, file.size))
    assert len(whole) == file.size
    # Each range is a request to the store. All places are read of objects that were fetched once.
    objects = {key: store.objects.get(key) for key, _ in store.objects.list()}

    def fetched(key: str, start: int, end: int) -> bytes:
        return objects[key][start:end]

    for step, read in ((97, get), (7, fetched)):
        for start in range(0, file.size, step):
            for end in (start + 1, start + 100, file.size):
                assert b"".join(file.read(read, start, min(end, file.size))) == whole[start:end]
    if wanted == "jsonl":
        assert whole == b"".join(b'{"frame":%d}\n' % n for n in range(FRAMES))
    else:
        found = load(whole) if wanted == "safetensors" else dict(np.load(io.BytesIO(whole)))
        assert found.keys() == ARRAYS.keys()
        for name, array in ARRAYS.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)


def test_a_lift_that_an_older_version_began_has_the_arrays_that_it_knew(
    store: Store, lift: LiftRecord
) -> None:
    helper = join(lift)
    finish(store, helper, claim(store, helper), less="scales")
    file = result(store, lift, "safetensors")
    arrays = load(b"".join(file.read(store.objects.get_range, 0, file.size)))
    assert arrays.keys() == ARRAYS.keys() - {"scales"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, ARRAYS[name])


def test_each_format_of_each_lift_has_a_checksum_of_its_own(store: Store, lift: LiftRecord) -> None:
    other = create(store, lift.dataset_id)
    formats: tuple[ResultFormat, ...] = ("jsonl", "npz", "safetensors")
    found = {
        result(store, asked, wanted).checksum() for asked in (lift, other) for wanted in formats
    }
    assert len(found) == 6
    assert result(store, lift, "npz").checksum() in found


def test_checksums_of_parts_make_that_of_the_whole() -> None:
    for size in (0, 1, 2, 255, 4096, 100_003):
        first, second = RNG.bytes(37), RNG.bytes(size)
        whole = combine(zlib.crc32(first), zlib.crc32(second), size)
        assert whole == zlib.crc32(first + second)
