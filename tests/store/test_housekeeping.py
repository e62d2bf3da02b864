"""What a sweep may delete: only what is ours, what crashes leave, and not at once."""

import logging
from pathlib import Path

import pytest
from sqlalchemy import text

from store import datasets, housekeeping, keys
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.ids import new_id


def sweep(store: Store, *, grace_seconds: float = 3600) -> tuple[int, int]:
    return housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=grace_seconds)


def listed(store: Store) -> set[str]:
    return {key for key, _ in store.objects.list()}


def orphan(store: Store) -> str:
    key = keys.of_chunk(new_id("ds"), b"left behind")
    store.objects.put(key, b"left behind")
    return key


def test_an_orphan_is_condemned_first_and_goes_when_its_time_has_come(store: Store) -> None:
    orphan(store)
    assert sweep(store) == (1, 0)
    assert sweep(store, grace_seconds=-1) == (0, 0)  # its time was set when it was condemned
    with store.writing() as session:
        session.execute(text("UPDATE condemned_objects SET due_at = 0"))
    assert sweep(store) == (0, 1)
    assert listed(store) == set()
    assert sweep(store) == (0, 0)


def test_what_a_record_knows_again_is_spared(store: Store, capture: Capture) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("restored"))
    (key,) = listed(store)
    with store.writing() as session:  # the records are restored from a backup that is too old
        session.execute(text("UPDATE chunks SET key = 'other'"))
    assert sweep(store) == (1, 0)
    with store.writing() as session:  # and then from the right one
        session.execute(text("UPDATE chunks SET key = :key"), {"key": key})
        session.execute(text("UPDATE condemned_objects SET due_at = 0"))
    assert sweep(store) == (0, 0)
    assert datasets.load(store, dataset.id).frames == capture.frames


def test_what_others_keep_in_the_same_place_is_left_alone(store: Store, tmp_path: Path) -> None:
    # A bucket without a prefix has other people's data in it.
    theirs = ("notes.txt", "datasets/raw/camera1.mp4", "models/yolo.safetensors", "fits/a/b.csv")
    for key in theirs:
        store.objects.put(key, b"precious")
    part = tmp_path / "objects" / "datasets" / "raw" / "part#1"  # of no meaning but in a folder
    part.parent.mkdir(parents=True, exist_ok=True)
    part.write_bytes(b"precious")
    assert sweep(store, grace_seconds=-1) == (0, 0)
    assert all(store.objects.has(key) for key in theirs)
    assert part.exists()


def test_more_than_crashes_leave_is_not_condemned(
    store: Store, capture: Capture, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(housekeeping.FEW + 1):
        datasets.create(store, capture, CaptureDescription("season"))
    with store.writing() as session:
        session.execute(text("DELETE FROM datasets"))
    before = listed(store)
    with caplog.at_level(logging.ERROR):
        assert sweep(store, grace_seconds=-1) == (0, 0)
    assert "21 of 21 objects" in caplog.text
    assert listed(store) == before


def test_what_a_user_deletes_goes_however_much_and_whatever_fails(
    store: Store, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [datasets.create(store, capture, CaptureDescription("old")).id for _ in range(30)]
    kept = datasets.create(store, capture, CaptureDescription("kept"))

    def away(*_: str) -> None:
        raise OSError("the objects are away")

    with monkeypatch.context() as patch:
        patch.setattr(store.objects, "delete", away)
        for identifier in made:
            datasets.delete(store, identifier)
    assert len(listed(store)) == 31
    assert sweep(store) == (0, 30)
    assert datasets.load(store, kept.id).frames == capture.frames


def test_what_a_sweep_condemned_can_be_deleted_by_its_user(store: Store, capture: Capture) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("restored"))
    (key,) = listed(store)
    with store.writing() as session:
        session.execute(text("INSERT INTO condemned_objects VALUES (:key, 1e12)"), {"key": key})
    datasets.delete(store, dataset.id)
    assert listed(store) == set()
    assert sweep(store) == (0, 0)


def test_one_of_all_workers_sweeps_and_only_so_often(store: Store) -> None:
    assert housekeeping.take_turn(store)
    assert not housekeeping.take_turn(store)
    with store.writing() as session:
        session.execute(text("UPDATE deployment SET next_sweep_at = next_sweep_at - 3601"))
    assert housekeeping.take_turn(store)
