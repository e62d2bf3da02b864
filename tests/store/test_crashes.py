"""A process that is killed while it writes leaves the old or the new, never a half."""

import random
import subprocess
import time
from pathlib import Path

import numpy as np

from store import datasets, housekeeping, keys, lookup
from store.capture import extend_checksum
from store.database import Store
from store.ids import new_id
from store.records import DatasetRecord
from store.settings import StoreSettings
from tests.deployments import embedded_only, scaled_is_thorough
from tests.fork_server import Popen
from worker.process import python

WRITER = """
import sys
import numpy as np
from store import datasets
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.settings import StoreSettings

store = Store(StoreSettings.model_validate_json(sys.argv[1]))
capture = Capture.checked(np.random.default_rng(0).normal(size=(200, 4, 31, 2)))
datasets.create(store, capture, CaptureDescription("first"))
print("ready", flush=True)
while True:
    dataset = datasets.create(store, capture, CaptureDescription("a"))
    datasets.append(store, dataset.id, capture, max_frames=1000)
    datasets.delete(store, datasets.create(store, capture, CaptureDescription("b")).id)
"""


@scaled_is_thorough
def test_killed_writers_leave_whole_datasets_and_orphans_that_are_swept(
    store: Store, settings: StoreSettings
) -> None:
    rng = random.Random(0)  # noqa: S311
    for _ in range(6):
        command = python("-c", WRITER, settings.model_dump_json())
        with Popen(command, stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            time.sleep(rng.uniform(0.02, 0.2))
            writer.kill()
    stored = lookup.page(store, DatasetRecord, limit=10_000, after=None)
    assert stored
    for dataset in stored:
        capture = datasets.load(store, dataset.id)
        assert capture.frames == dataset.frames
        assert extend_checksum("", capture) == dataset.checksum
        assert np.isfinite(capture.keypoints).all()
    housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
    chunks = sum(dataset.frames // 200 for dataset in stored)
    assert len(list(store.objects.list())) == chunks
    for dataset in stored:
        datasets.load(store, dataset.id)


@embedded_only
def test_a_killed_put_leaves_no_object_and_its_part_is_swept(store: Store, tmp_path: Path) -> None:
    code = (
        "import sys; from store.objects import Objects; objects = Objects(sys.argv[1]);"
        "data = bytes(200_000_000); print('ready', flush=True); objects.put(sys.argv[2], data)"
    )
    key = keys.of_chunk(new_id("ds"), b"")
    command = python("-c", code, store.objects.url, key)
    for _ in range(10):  # until the kill is not too late
        with Popen(command, stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            while not list(tmp_path.glob("objects/datasets/*/*")):
                time.sleep(0.001)
            writer.kill()
        if not store.objects.has(key):
            break
        store.objects.delete(key)
    left = list(tmp_path.glob("objects/datasets/*/*"))
    assert left
    assert list(store.objects.list()) == []
    assert housekeeping.sweep(store) == (0, 0)  # it might still be under way
    assert housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1) == (0, len(left))
    assert list(tmp_path.glob("objects/datasets/*/*")) == []


def test_sweeping_keeps_young_objects(store: Store) -> None:
    store.objects.put(keys.of_chunk(new_id("ds"), b""), b"being written")
    assert housekeeping.sweep(store) == (0, 0)
    assert housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1) == (1, 1)
    assert list(store.objects.list()) == []
