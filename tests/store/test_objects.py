"""Objects in a folder and on S3: the same behaviour, through outages too."""

import os
import shutil
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from obstore.exceptions import BaseError as ObjectStoreError

from store import datasets, housekeeping, keys
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import DamagedError
from store.ids import new_id
from store.objects import Objects
from store.settings import StoreSettings
from tests.object_stores import S3, s3_served


@pytest.fixture(params=["folder", "s3"])
def objects(request: pytest.FixtureRequest, tmp_path: Path) -> Objects:
    if request.param == "folder":
        return Objects(tmp_path.as_uri())
    s3: S3 = request.getfixturevalue("s3")
    return Objects(s3.new_url())


def test_what_is_put_is_got_whole_and_in_part(objects: Objects) -> None:
    data = os.urandom(11 * 1024 * 1024)  # on S3: uploaded in parts
    key = keys.of_chunk(new_id("ds"), data)
    objects.put(key, data)
    assert objects.has(key)
    assert objects.get(key) == data
    assert objects.get_range(key, 5, 5) == b""
    assert objects.get_range(key, 6_000_000, 6_000_003) == data[6_000_000:6_000_003]
    ranges = [(6_000_000, 6_000_003), (6_000_100, 9_000_000), (0, 8)]  # two of them near
    assert objects.get_ranges(key, ranges) == [data[start:end] for start, end in ranges]


def test_missing_objects_are_reported(objects: Objects) -> None:
    key = keys.of_chunk(new_id("ds"), b"w")
    assert not objects.has(key)
    with pytest.raises(FileNotFoundError):
        objects.get(key)
    with pytest.raises(FileNotFoundError):
        objects.get_range(key, 0, 8)
    objects.delete(key)
    objects.delete()


def test_objects_of_a_missing_folder_are_away_not_lost(tmp_path: Path) -> None:
    folder = tmp_path / "objects"
    objects, key = Objects(folder.as_uri()), keys.of_chunk(new_id("ds"), b"capture")
    objects.put(key, b"capture")
    folder.rename(tmp_path / "elsewhere")
    for read in (
        lambda: objects.get(key),
        lambda: objects.get_range(key, 0, 4),
        lambda: objects.check(key),
        lambda: objects.has(key),
        lambda: objects.damaged([key]),
    ):
        with pytest.raises(ObjectStoreError, match="is away"):
            read()
    (tmp_path / "elsewhere").rename(folder)
    assert objects.get(key) == b"capture"


def test_a_folder_that_goes_away_as_it_is_written_is_away(tmp_path: Path) -> None:
    objects, done = Objects(tmp_path.as_uri()), threading.Event()
    key = keys.of_chunk(new_id("ds"), b"capture")

    def take_away() -> None:
        while not done.is_set():
            shutil.rmtree(tmp_path / key.partition("/")[0], ignore_errors=True)

    with ThreadPoolExecutor(1) as threads:
        threads.submit(take_away)
        errors = []
        for _ in range(300):
            try:
                objects.put(key, b"capture")
            except Exception as error:  # noqa: BLE001 (whatever comes is compared)
                errors.append(type(error))
        done.set()
    assert errors
    assert all(issubclass(error, ObjectStoreError) for error in errors)


@pytest.mark.parametrize("found", [b"capturf", b"captu", b""])
def test_what_is_not_what_was_put_is_not_given(objects: Objects, found: bytes) -> None:
    key = keys.of_chunk(new_id("ds"), b"capture")
    objects.put(key, found)  # as if it had become so
    with pytest.raises(DamagedError, match=key):
        objects.get(key)
    with pytest.raises(DamagedError):
        objects.get_range(key, 0, 2)
    with pytest.raises(DamagedError):
        objects.check(key)
    older = key.replace(key.split(".")[1] + ".", "")  # which has no checksum
    objects.put(older, found)
    assert objects.get(older) == found
    with pytest.raises(DamagedError):
        objects.get_range(older, 4, 20)
    with pytest.raises(DamagedError):
        objects.get_ranges(older, [(0, 1), (4, 20)])
    assert objects.damaged([key, older]) == {key}


def test_what_is_damaged_after_it_was_read_is_not_given(objects: Objects) -> None:
    data = os.urandom(1000)
    key = keys.of_chunk(new_id("ds"), data)
    objects.put(key, data)
    assert objects.get_range(key, 0, 8) == data[:8]
    for found in (data[:-1] + bytes([data[-1] ^ 1]), data[:500]):
        file = Path(unquote(urlsplit(objects.url).path), key)
        times = (file.stat().st_atime_ns, file.stat().st_mtime_ns) if file.exists() else None
        objects.put(key, found)
        if times:  # as if nothing had been written
            os.utime(file, ns=times)
        for _ in range(2):
            with pytest.raises(DamagedError, match=key):
                objects.get_range(key, 0, 8)
            with pytest.raises(DamagedError, match=key):
                objects.get_ranges(key, [(0, 8), (20, 30)])
        objects.put(key, data)  # from a backup
        assert objects.get_range(key, 0, 8) == data[:8]
    objects.delete(key)
    with pytest.raises(FileNotFoundError):
        objects.get_range(key, 0, 8)


def test_all_of_ours_are_listed_and_deleted(objects: Objects) -> None:
    many = 1100 if objects.url.startswith("s3") else 60  # more than S3 lists, or deletes, at a time
    mine = {keys.of_weights(new_id("mdl"), b"w") for _ in range(many)}
    for key in mine:
        objects.put(key, b"w")
    objects.put("models/theirs.safetensors", b"precious")
    listed = dict(objects.list())
    assert listed.keys() == mine
    assert all(abs(at - time.time()) < 120 for at in listed.values())
    objects.delete(*mine)
    assert dict(objects.list()) == {}
    assert objects.get("models/theirs.safetensors") == b"precious"


def test_places_of_one_bucket_do_not_see_each_other(s3: S3) -> None:
    one, other = Objects(s3.new_url()), Objects(s3.new_url())
    key = keys.of_weights(new_id("mdl"), b"w")
    one.put(key, b"w")
    assert not other.has(key)
    assert dict(other.list()) == {}


def test_a_store_that_pauses_is_waited_for_and_one_that_is_gone_is_reported_soon() -> None:
    with s3_served() as s3:
        objects = Objects(s3.new_url())
        key = keys.of_weights(new_id("mdl"), b"w")
        objects.put(key, b"w")
        started = time.monotonic()
        os.kill(s3.process.pid, signal.SIGSTOP)
        awake = threading.Timer(1, os.kill, (s3.process.pid, signal.SIGCONT))
        awake.start()
        assert objects.get(key) == b"w"
        awake.join()
        assert time.monotonic() - started >= 1
        s3.process.kill()
        s3.process.wait()
        started = time.monotonic()
        with pytest.raises(ObjectStoreError):
            objects.get(key)
        assert time.monotonic() - started < 60


def test_whoever_deletes_does_not_wait_for_objects_that_are_away(
    tmp_path: Path, capture: Capture
) -> None:
    with s3_served() as s3:
        store = Store(StoreSettings(data_dir=tmp_path, store_url=s3.new_url()))
        made = [datasets.create(store, capture, CaptureDescription("old")).id for _ in range(12)]
        os.kill(s3.process.pid, signal.SIGSTOP)
        started = time.monotonic()
        datasets.delete(store, made[0])
        assert time.monotonic() - started < 3
        with ThreadPoolExecutor(11) as threads:  # as requests do
            list(threads.map(partial(datasets.delete, store), made[1:]))
        assert time.monotonic() - started < 6
        os.kill(s3.process.pid, signal.SIGCONT)
        housekeeping.sweep(store)
        assert dict(store.objects.list()) == {}
        store.close()
