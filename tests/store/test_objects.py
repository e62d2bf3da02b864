"""Objects in a folder and on S3: the same behaviour, through outages too."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from obstore.exceptions import BaseError as ObjectStoreError

from store import keys
from store.ids import new_id
from store.objects import Objects
from tests.object_stores import S3, s3_served


@pytest.fixture(params=["folder", "s3"])
def objects(request: pytest.FixtureRequest, tmp_path: Path) -> Objects:
    if request.param == "folder":
        return Objects(tmp_path.as_uri())
    s3: S3 = request.getfixturevalue("s3")
    return Objects(s3.new_url())


def test_what_is_put_is_got_whole_and_in_part(objects: Objects) -> None:
    key = keys.of_chunk(new_id("ds"))
    data = os.urandom(11 * 1024 * 1024)  # on S3: uploaded in parts
    objects.put(key, data)
    assert objects.has(key)
    assert objects.get(key) == data
    assert objects.get_range(key, 5, 5) == b""
    assert objects.get_range(key, 6_000_000, 6_000_003) == data[6_000_000:6_000_003]
    objects.put(key, b"other")
    assert objects.get(key) == b"other"


def test_what_is_not_there_is_said_so(objects: Objects) -> None:
    key = keys.of_chunk(new_id("ds"))
    assert not objects.has(key)
    with pytest.raises(FileNotFoundError):
        objects.get(key)
    with pytest.raises(FileNotFoundError):
        objects.get_range(key, 0, 8)
    objects.delete(key)
    objects.delete()


def test_all_of_ours_are_listed_and_deleted(objects: Objects) -> None:
    # More than S3 lists, or deletes, at a time.
    mine = {keys.of_weights(new_id("mdl")) for _ in range(1100)}
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
    key = keys.of_weights(new_id("mdl"))
    one.put(key, b"w")
    assert not other.has(key)
    assert dict(other.list()) == {}


def test_a_store_that_pauses_is_waited_for_and_one_that_is_gone_is_told_soon() -> None:
    with s3_served() as s3:
        objects = Objects(s3.new_url())
        key = keys.of_weights(new_id("mdl"))
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
