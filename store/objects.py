"""Arrays and weights as objects: a local folder by default, S3 and friends by URL."""

import errno
import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import BaseError as ObjectStoreError
from obstore.store import LocalStore, from_url

from store import keys
from store.errors import DamagedError

# Of a store that is reached by URL. A request that gets no answer, or that the store cannot serve
# at the moment, is sent again, with pauses that grow; who waits for one that is silent hears within
# a minute.
CONNECTING: dict[str, Any] = {
    "client_options": {
        "connect_timeout": timedelta(seconds=5),
        "read_timeout": timedelta(seconds=20),  # of silence
        "timeout": timedelta(minutes=5),  # of a request with its answer
        "allow_http": True,  # where somebody named an endpoint of http://
    },
    "retry_config": {
        "max_retries": 5,
        "retry_timeout": timedelta(seconds=30),  # after which none is sent again
        "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=3)},
    },
}
READS_AT_A_TIME = 4
PARTS_AT_A_TIME = 4  # of 5 MiB, of an object that is uploaded in parts
NEAR_BYTES = 64 * 1024  # between ranges of an object that are fetched as one


class Objects:
    """Bytes under keys. A put is atomic: a reader sees the old bytes or the new, never a part."""

    def __init__(self, url: str) -> None:
        """Open the store at ``url``; a ``file://`` folder is made if it is missing."""
        self.url = url
        parts = urlsplit(url)
        self._folder = Path(unquote(parts.path)) if parts.scheme == "file" else None
        self._store: Any = (
            from_url(url, **CONNECTING)
            if self._folder is None
            else LocalStore(self._folder, mkdir=True, automatic_cleanup=True)
        )

    def put(self, key: str, data: bytes) -> None:
        """Store ``data`` under ``key``, durably: on return it survives a loss of power.

        Raises
        ------
        ObjectStoreError
            If the objects are away, also if they went away between writing and now.
        """
        try:
            obstore.put(self._store, key, data, max_concurrency=PARTS_AT_A_TIME)
            if self._folder is not None:
                # A local rename is atomic but not durable; the record that will point here is.
                for path in (self._folder / key, (self._folder / key).parent):
                    descriptor = os.open(path, os.O_RDONLY)
                    try:
                        os.fsync(descriptor)
                    finally:
                        os.close(descriptor)
        except OSError as error:  # never the answer that there is no such object
            with suppress(Exception):  # it may not survive, so it shall not be there
                self.delete(key)
            raise ObjectStoreError(f"{key} could not be written: {error}") from error

    def get(self, key: str) -> bytes:
        """Return the bytes under ``key``.

        Raises
        ------
        FileNotFoundError
            If there are none; its ``filename`` is the key.
        DamagedError
            If they are not what was put there.
        """
        with self._naming(key):
            data = bytes(obstore.get(self._store, key).bytes())
        if keys.checksum_of(key) not in (None, zlib.crc32(data)):
            raise DamagedError(key)
        return data

    def get_range(self, key: str, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end`` of an object that holds them.

        Before its first range is returned, an object is read whole and checked; and again once
        anything has written to it since. Raises as :meth:`get` does.
        """
        self._check_once(key)
        return self.peek(key, start, end)

    def get_ranges(self, key: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Do the same for ranges that are not empty; several take little longer than one."""
        self._check_once(key)
        return self._read(key, ranges)

    def peek(self, key: str, start: int, end: int) -> bytes:
        """Do the same unchecked, where a mistake does no harm, or is noticed."""
        if start == end:
            return b""  # which the object store takes for a mistake
        return self._read(key, [(start, end)])[0]

    def _read(self, key: str, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        starts, ends = zip(*ranges, strict=True)
        with self._naming(key):
            try:
                found = obstore.get_ranges(
                    self._store, key, starts=starts, ends=ends, coalesce=NEAR_BYTES
                )
            except ObjectStoreError:
                if obstore.head(self._store, key)["size"] >= max(ends):
                    raise
                found = []  # a range beyond its end
        if [len(data) for data in found] != [end - start for start, end in ranges]:
            raise DamagedError(key)
        return [bytes(data) for data in found]

    def _check_once(self, key: str) -> None:
        if keys.checksum_of(key) is not None:
            _check(self, key, self._written(key))

    @contextmanager
    def _naming(self, key: str) -> Iterator[None]:
        """Have the error of an object that is not there name its key.

        Where the whole folder is missing, an object of it is away, not lost.
        """
        try:
            yield
        except FileNotFoundError as error:
            if self._folder is not None and not self._folder.is_dir():
                raise ObjectStoreError(f"The folder {self._folder} is away: {error}") from error
            raise FileNotFoundError(errno.ENOENT, "there is no such object", key) from error

    def _written(self, key: str) -> tuple[object, ...]:
        """Return what differs once an object was written to, by whomever."""
        with self._naming(key):
            if self._folder is None:
                found = obstore.head(self._store, key)
                return found["e_tag"], found["last_modified"], found["size"]
            file = (self._folder / key).stat()
        return file.st_ino, file.st_ctime_ns, file.st_mtime_ns, file.st_size

    def check(self, key: str) -> int:
        """Read an object, without keeping it, and return its size; raises as :meth:`get` does."""
        with self._naming(key):
            checksum = size = 0
            for piece in obstore.get(self._store, key):
                checksum, size = zlib.crc32(piece, checksum), size + len(piece)
        if keys.checksum_of(key) not in (None, checksum):
            raise DamagedError(key)
        return size

    def damaged(self, listed: Iterable[str]) -> set[str]:
        """Read objects, and return those that are damaged, or not there."""

        def harmed(key: str) -> str | None:
            try:
                self.check(key)
            except (FileNotFoundError, DamagedError):
                return key
            return None

        with ThreadPoolExecutor(READS_AT_A_TIME) as threads:
            return {key for key in threads.map(harmed, listed) if key is not None}

    def has(self, key: str) -> bool:
        """Return whether there is an object under ``key``."""
        try:
            with self._naming(key):
                obstore.head(self._store, key)
        except FileNotFoundError:
            return False
        return True

    def delete(self, *doomed: str) -> None:
        """Delete what is there of ``doomed``; what is gone already is no error."""
        if self._folder is None:
            obstore.delete(self._store, doomed)  # many at a time
            return
        for key in doomed:
            with suppress(FileNotFoundError):
                obstore.delete(self._store, key)

    def list(self) -> Iterator[tuple[str, float]]:
        """Yield every key of ours with the time it was last written, in seconds since the epoch."""
        for folder in keys.FOLDERS:
            for batch in obstore.list(self._store, prefix=folder):
                for entry in batch:
                    if keys.is_ours(entry["path"]):
                        yield entry["path"], entry["last_modified"].timestamp()

    def delete_partial(self, before: float) -> int:
        """Delete what puts that were killed before a time (epoch seconds) left; return how many.

        A local put writes ``key#N`` and renames it. Elsewhere unfinished uploads are the business
        of the bucket's lifecycle rules.
        """
        if self._folder is None:
            return 0
        partial = [
            path
            for path in self._folder.rglob("*#*")
            if keys.is_ours(path.relative_to(self._folder).as_posix().rpartition("#")[0])
            and path.stat().st_mtime < before
        ]
        for path in partial:
            path.unlink(missing_ok=True)
        return len(partial)


# What was found of an object holds until it is written to.
@lru_cache(maxsize=100_000)
def _check(objects: Objects, key: str, _written: tuple[object, ...]) -> None:
    objects.check(key)
