"""Corrections lie over what was detected: every reader sees them, and nothing is lost."""

import io
from collections.abc import Iterator

import numpy as np
import pytest

from store import dataset_changes, datasets, fits, lookup
from store.capture import Capture, concatenate
from store.capture_files import capture_file
from store.corrections import MOST, Correction, Place
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import InputError, NotFoundError
from store.records import DatasetRecord
from store.usage import usage
from tests.deployments import scaled_is_thorough

MOVED = Correction(Place(2, 1, 3), (412.5, 230.25))
REMOVED = Correction(Place(13, 0, 1), None)
FOUND = Correction(Place(3, 1, 0), (7.0, 8.0))  # where nothing was detected


@pytest.fixture
def dataset(store: Store, capture: Capture) -> str:
    """Return a dataset of two chunks, the second of which has confidence."""
    made = datasets.create(store, capture, CaptureDescription("a"))
    trust = np.full(capture.keypoints.shape[:3], 0.5, np.float32)
    datasets.append(store, made.id, Capture(capture.keypoints, trust), max_frames=100)
    return made.id


def expected(capture: Capture, corrections: list[Correction]) -> Capture:
    trust = np.full(capture.keypoints.shape[:3], 0.5, np.float32)
    whole = concatenate([capture, Capture(capture.keypoints, trust)])
    assert whole.confidence is not None
    for place, position in corrections:
        whole.keypoints[place] = (np.nan, np.nan) if position is None else position
        whole.confidence[place] = 0 if position is None else 1
    return whole


def read(store: Store, dataset: str) -> Iterator[Capture]:
    """Yield a dataset's keypoints as each of its readers has them."""
    yield datasets.load(store, dataset)
    halves = [datasets.load_frames(store, dataset, *span) for span in ((0, 9), (9, 24))]
    trusts = [half.confidence for half in halves]
    assert halves[0].confidence is None
    yield concatenate([Capture(half.keypoints, t) for half, t in zip(halves, trusts, strict=True)])
    record, known = dataset_changes.corrections_of(store, dataset)
    file = capture_file(store, record, known)
    pieces = [  # of few bytes, so that they begin and end within a correction
        piece
        for start in range(0, file.size, 7)
        for piece in file.read(store.objects.get_range, start, min(start + 7, file.size))
    ]
    with np.load(io.BytesIO(b"".join(pieces))) as arrays:  # which checks the CRC-32
        yield Capture(arrays["keypoints"], arrays["confidence"])


@scaled_is_thorough
def test_every_reader_has_the_corrections_and_undoing_gives_back_every_bit(
    store: Store, dataset: str, capture: Capture
) -> None:
    before = lookup.get(store, DatasetRecord, dataset)
    moved_on = Correction(MOVED.place, (1.0, 2.0))
    for corrected, undone, now in (
        ([MOVED, REMOVED, FOUND], [], [MOVED, REMOVED, FOUND]),
        ([moved_on], [FOUND.place], [moved_on, REMOVED]),
        ([], [MOVED.place, REMOVED.place, FOUND.place], []),
    ):
        record = dataset_changes.correct(store, dataset, corrected, undone)
        assert record.corrections_count == len(now)
        whole = expected(capture, now)
        for found in read(store, dataset):
            np.testing.assert_array_equal(found.keypoints, whole.keypoints)
            if found.confidence is not None:
                trust = whole.confidence
                if len(found.confidence) == 24:
                    np.testing.assert_array_equal(found.confidence, trust)
    after = lookup.get(store, DatasetRecord, dataset)
    assert (after.corrections_checksum, after.checksum) == (None, before.checksum)


def test_a_fit_sees_the_corrections_that_it_was_made_with(
    store: Store, dataset: str, capture: Capture
) -> None:
    first = fits.create(store, dataset_id=dataset, name="f", config={})
    corrected = dataset_changes.correct(store, dataset, [MOVED])
    second = fits.create(store, dataset_id=dataset, name="f", config={})
    dataset_changes.correct(store, dataset, [REMOVED], [MOVED.place])
    for fit, known in ((first, []), (second, [MOVED])):
        seen = fits.load_fitted(store, fit)
        np.testing.assert_array_equal(seen.keypoints, expected(capture, known).keypoints)
    assert first.corrections_checksum is None
    assert second.corrections_checksum == corrected.corrections_checksum


def test_appended_frames_keep_corrections_and_findings_follow_them(store: Store) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1000, (40, 2, 6, 2)).astype(np.float32)
    made = datasets.create(store, Capture.checked(pixels.copy()), CaptureDescription("a"))

    def never_seen(record: DatasetRecord) -> bool:
        return "keypoint_never_seen" in [each["code"] for each in record.findings or []]

    everywhere = [Correction(Place(frame, 1, 4), (5.0 + frame, 5.0)) for frame in range(40)]
    by_one_view = [Correction(Place(frame, 1, 4), None) for frame in range(40)]
    elsewhere = [Correction(Place(frame, 0, 3), (7.0, 7.0)) for frame in range(40)]
    assert not never_seen(made)
    assert never_seen(dataset_changes.correct(store, made.id, by_one_view))
    assert not never_seen(dataset_changes.correct(store, made.id, everywhere))
    dataset_changes.correct(store, made.id, elsewhere)
    longer = datasets.append(store, made.id, Capture.checked(pixels.copy()), max_frames=100)
    assert (longer.frames, longer.corrections_count) == (80, 80)
    kept = datasets.load(store, made.id).keypoints[:40, 1, 4]
    np.testing.assert_array_equal(kept[:, 0], 5.0 + np.arange(40))


@pytest.mark.parametrize(
    ("corrected", "undone", "field"),
    [
        ([Correction(Place(24, 0, 0), None)], [], "correct/0/frame"),
        ([MOVED, Correction(Place(0, 2, 0), None)], [], "correct/1/view"),
        ([], [Place(0, 0, 5)], "undo/0/keypoint"),
        ([MOVED, MOVED], [], "correct/1"),
        ([Correction(Place(0, 0, 0), (-200.0, 5.0))], [], "correct/0/position"),
        ([Correction(Place(0, 1, 0), (-200.0, 1e6))], [], "correct/0/position"),
    ],
)
def test_what_is_not_in_the_dataset_is_refused_and_nothing_changes(
    store: Store,
    dataset: str,
    corrected: list[Correction],
    undone: list[Place],
    field: str,
) -> None:
    dataset_changes.change(store, DatasetRecord, dataset, {"image_sizes": [[300, 300], None]})
    with pytest.raises(InputError) as refused:
        dataset_changes.correct(store, dataset, corrected, undone)
    assert refused.value.field == field
    assert dataset_changes.corrections_of(store, dataset)[1] == []


def test_corrections_are_bounded_counted_and_go_with_their_dataset(store: Store) -> None:
    pixels = np.random.default_rng(0).uniform(0, 9, (MOST + 1, 1, 5, 2)).astype(np.float32)
    made = datasets.create(store, Capture.checked(pixels), CaptureDescription("a"))
    many = [Correction(Place(frame, 0, 0), (0.5, 0.25)) for frame in range(MOST)]
    before = usage(store, 1).project["datasets"].size
    dataset_changes.correct(store, made.id, many)
    one_more = [Correction(Place(MOST, 0, 0), None)]
    with pytest.raises(InputError, match=str(MOST)):
        dataset_changes.correct(store, made.id, one_more)
    assert dataset_changes.correct(store, made.id, one_more, [many[0].place]).corrections_count
    assert usage(store, 1).project["datasets"].size - before > 10 * MOST
    datasets.delete(store, made.id)
    with pytest.raises(NotFoundError):
        dataset_changes.corrections_of(store, made.id)
