import threading

import numpy as np
import pytest

from store import datasets, fits, lookup
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import CaptureError, ConflictError, KeyReusedError, NotFoundError
from store.idempotency import Idempotency
from store.records import DatasetRecord
from tests.deployments import scaled_is_thorough

BIG = 1_000_000


def objects(store: Store) -> set[str]:
    return {key for key, _ in store.objects.list()}


def test_a_dataset_comes_back_as_it_was(store: Store, capture: Capture) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    loaded = datasets.load(store, dataset.id)
    np.testing.assert_array_equal(loaded.keypoints, capture.keypoints)
    assert loaded.confidence is None
    assert loaded.points3d is None
    assert dataset.observed == [12 * 5 - 1, 12 * 5 - 5]


def test_the_checksum_does_not_depend_on_the_cuts(store: Store, capture: Capture) -> None:
    whole = datasets.create(store, capture, CaptureDescription("whole"))
    parts = [Capture(capture.keypoints[a:b]) for a, b in ((0, 1), (1, 7), (7, 12))]
    streamed = datasets.create(store, parts[0], CaptureDescription("streamed"))
    for part in parts[1:]:
        streamed = datasets.append(store, streamed.id, part, max_frames=BIG)
    assert streamed.checksum == whole.checksum
    assert streamed.frames == whole.frames == 12
    assert streamed.observed == whole.observed
    shuffled = datasets.create(store, Capture(capture.keypoints[::-1]), CaptureDescription("other"))
    assert shuffled.checksum != whole.checksum


@scaled_is_thorough
def test_appending_from_many_threads_loses_nothing(store: Store) -> None:
    frame = np.zeros((1, 1, 4, 2), np.float32)
    dataset = datasets.create(store, Capture.checked(frame), CaptureDescription("a"))

    def append(value: int) -> None:
        datasets.append(store, dataset.id, Capture.checked(frame + value), max_frames=BIG)

    threads = [threading.Thread(target=append, args=(value,)) for value in range(1, 13)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    loaded = datasets.load(store, dataset.id).keypoints[:, 0, 0, 0]
    assert sorted(loaded) == list(range(13))
    assert lookup.get(store, DatasetRecord, dataset.id).frames == 13
    assert len(objects(store)) == 13


def test_confidence_and_truth_may_come_with_some_chunks_only(store: Store) -> None:
    keypoints = np.ones((2, 1, 4, 2), np.float32)
    half, truth = np.full((2, 1, 4), 0.5), np.zeros((2, 4, 3))
    dataset = datasets.create(store, Capture.checked(keypoints), CaptureDescription("a"))
    datasets.append(store, dataset.id, Capture.checked(keypoints, half, truth), max_frames=BIG)
    loaded = datasets.load(store, dataset.id)
    assert loaded.confidence is not None
    assert loaded.points3d is not None
    np.testing.assert_array_equal(loaded.confidence[:, 0, 0], [1, 1, 0.5, 0.5])
    np.testing.assert_array_equal(np.isnan(loaded.points3d[:, 0, 0]), [True, True, False, False])
    assert lookup.get(store, DatasetRecord, dataset.id).ground_truth


def test_times_come_back_exactly_whole_and_in_parts(store: Store, capture: Capture) -> None:
    times = 1.7e9 + np.arange(capture.frames) / 59.94
    by_view = times[:, None] + np.array([0, 0.0071])
    for seconds in (times, by_view):
        parts = [
            Capture.checked(capture.keypoints[part], times=seconds[part])
            for part in (slice(0, 5), slice(5, None))
        ]
        dataset = datasets.create(store, parts[0], CaptureDescription("a"))
        dataset = datasets.append(store, dataset.id, parts[1], max_frames=BIG)
        assert dataset.last_times == np.atleast_1d(seconds[-1]).tolist()
        np.testing.assert_array_equal(datasets.load(store, dataset.id).times, seconds)
        np.testing.assert_array_equal(
            datasets.load_frames(store, dataset.id, 3, 9).times, seconds[3:9]
        )
        whole = Capture.checked(capture.keypoints, times=seconds)
        assert datasets.create(store, whole, CaptureDescription("b")).checksum == dataset.checksum


def test_frames_must_go_on_in_time(store: Store) -> None:
    frames = np.ones((3, 2, 4, 2), np.float32)
    timed = Capture.checked(frames, times=[1, 2, 3])
    dataset = datasets.create(store, timed, CaptureDescription("a", fps=1.0))
    for times in ([3, 4, 5], None, [[4, 4], [5, 5], [6, 6]], [4, 4.5, 5]):
        with pytest.raises(CaptureError) as refused:
            datasets.append(store, dataset.id, Capture.checked(frames, times=times), max_frames=BIG)
        assert refused.value.field == "times"
    untimed = datasets.create(store, Capture.checked(frames), CaptureDescription("b"))
    with pytest.raises(CaptureError):
        datasets.append(store, untimed.id, timed, max_frames=BIG)


def test_frames_per_second_tell_times(store: Store, capture: Capture) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("a", fps=25.0))
    part = datasets.load_frames(store, dataset.id, 5, 8)
    times = datasets.times_of(dataset, part, 5)
    assert times is not None
    np.testing.assert_allclose(times, np.array([0.2, 0.24, 0.28]))


@pytest.mark.parametrize(
    ("shape", "max_frames"), [((1, 3, 5, 2), BIG), ((1, 2, 6, 2), BIG), ((2, 2, 5, 2), 13)]
)
def test_a_refused_chunk_leaves_nothing(
    store: Store, capture: Capture, shape: tuple[int, ...], max_frames: int
) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    before = objects(store)
    with pytest.raises(CaptureError):
        datasets.append(store, dataset.id, Capture.checked(np.zeros(shape)), max_frames=max_frames)
    assert objects(store) == before
    assert lookup.get(store, DatasetRecord, dataset.id).checksum == dataset.checksum


def test_deleting_removes_arrays_too_unless_a_fit_needs_them(
    store: Store, capture: Capture
) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    fit = fits.create(store, dataset_id=dataset.id, name="f", config={})
    with pytest.raises(ConflictError, match=fit.id):
        datasets.delete(store, dataset.id)
    fits.cancel(store, fit.id)
    datasets.delete(store, dataset.id)
    assert objects(store) == set()
    with pytest.raises(NotFoundError):
        lookup.get(store, DatasetRecord, dataset.id)
    for read in (datasets.load, datasets.delete):
        with pytest.raises(NotFoundError):
            read(store, dataset.id)


def test_a_repeated_request_makes_one_dataset(store: Store, capture: Capture) -> None:
    request = Idempotency("POST /datasets", "key", "digest")
    first = datasets.create(store, capture, CaptureDescription("a"), idempotency=request)
    again = datasets.create(store, capture, CaptureDescription("a"), idempotency=request)
    assert again.id == first.id
    assert len(objects(store)) == 1
    with pytest.raises(KeyReusedError):
        datasets.create(
            store,
            capture,
            CaptureDescription("b"),
            idempotency=Idempotency("POST /datasets", "key", "another"),
        )
    appended = Idempotency("POST /frames", "key", "digest")
    for _ in range(2):
        datasets.append(store, first.id, capture, max_frames=BIG, idempotency=appended)
    assert lookup.get(store, DatasetRecord, first.id).frames == 24


def test_pages_hold_every_dataset_once(store: Store, capture: Capture) -> None:
    made = [datasets.create(store, capture, CaptureDescription(str(n))).id for n in range(7)]
    seen, after = [], None
    while page := lookup.page(store, DatasetRecord, limit=3, after=after):
        seen += [dataset.id for dataset in page]
        after = seen[-1]
    assert sorted(seen) == sorted(made)
