"""The checks of ``fewview doctor``: what is right and wrong with a deployment, and what to do."""

import os
import shutil
import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple
from urllib.parse import quote, unquote, urlsplit

import redis.exceptions
from obstore.exceptions import BaseError as ObjectStoreError
from pydantic import AnyUrl
from redis import Redis
from rq import Worker
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from service.settings import Settings
from service.wire import confinement
from store import clock, schema
from store.database import Store
from store.engine import open_engine
from store.errors import StoreError, in_words
from store.housekeeping import known_keys
from store.ids import new_id
from store.integrity import find_damage
from store.mistakes import unknown
from store.records import FitRecord, LiftRecord
from store.settings import StoreSettings, shown
from worker.queue import connect, open_queues

MOST_CLOCK_SECONDS = 5.0
MOST_LOOK_SECONDS = 300.0  # at the file of the records
MOST_WAITING_SECONDS = 3600.0
LITTLE_SPACE, TOO_LITTLE_SPACE = 2**31, 2**28  # bytes
SHOWN = 10  # of many

AWAY = (SQLAlchemyError, ObjectStoreError, OSError)


class Verdict(NamedTuple):
    """What was found of one part of a deployment."""

    state: Literal["ok", "warning", "failed"]
    part: str
    words: str


def examine(settings: Settings, *, deep: bool) -> Iterator[Verdict]:
    """Examine a deployment, part by part; nothing of it is changed.

    Parameters
    ----------
    deep
        Read every stored object, and compare indices of the records with their tables.
    """
    yield Verdict("ok", "versions", f"fewview-server {version('fewview-server')}, Python "
                  f"{sys.version.partition(' ')[0]}")  # fmt: skip
    yield from _settings(settings)
    yield from _space(settings)
    yield _confinement()
    connection = None
    try:
        connection = _queue(settings)
        connection.ping()
        yield Verdict("ok", "queue", "reached")
    except (redis.exceptions.RedisError, FileNotFoundError) as error:
        connection = None
        yield _no_queue(settings, error)
    damage = _damage(settings, deep=deep)
    yield from damage
    if any(verdict.state == "failed" for verdict in damage):
        return
    try:
        store = open_store(settings)
    except (StoreError, *AWAY) as error:
        yield Verdict("failed", "records and objects", in_words(error))
        return
    words = f"both of deployment {store.identity}, tables {schema.REVISIONS[-1]}"
    yield Verdict("ok", "records and objects", words)
    try:
        yield from _clocks(store, connection)
        if connection is not None:
            yield from _jobs(store, connection)
            yield from _lonely_queues(connection)
        yield from _objects(store, deep=deep)
    except redis.exceptions.RedisError as error:
        yield _no_queue(settings, error)
    except AWAY as error:
        yield Verdict("failed", "records and objects", in_words(error))
    store.close()


def open_store(settings: StoreSettings) -> Store:
    """Open a deployment that is there; raise ``StoreError`` rather than make one."""
    url = settings.resolved_database_url
    if url.get_backend_name() == "sqlite" and not Path(str(url.database)).exists():
        raise StoreError(
            f"There are no records in {url.database}: is FEWVIEW_DATA_DIR, or "
            "FEWVIEW_DATABASE_URL, that of the deployment?"
        )
    engine = open_engine(url, forks=False)
    try:
        tables = schema.look(engine)
    finally:
        engine.dispose()
    if tables.state == "empty":
        raise StoreError(
            f"There are no records in {shown(url)}: is FEWVIEW_DATABASE_URL that of the deployment?"
        )
    return Store(settings)


def _damage(settings: Settings, *, deep: bool) -> list[Verdict]:
    """Look through the file of the records, if that is what they are in."""
    url = settings.resolved_database_url
    if url.get_backend_name() != "sqlite" or not Path(str(url.database)).exists():
        return []
    try:
        found = find_damage(open_engine(url, forks=True), seconds=MOST_LOOK_SECONDS, deep=deep)
    except TimeoutError as error:
        return [Verdict("warning", "records", f"{error}: whether they are damaged is not known")]
    except AWAY as error:
        return [Verdict("failed", "records", in_words(error))]
    if found is None:
        return [Verdict("ok", "records", "their file is not damaged, as far as SQLite can tell")]
    words = f"{url.database} is damaged ({found}): stop the service and restore a backup"
    return [Verdict("failed", "records", words)]


def _settings(settings: Settings) -> Iterator[Verdict]:
    settings_of_ours = (f"FEWVIEW_{name.upper()}" for name in Settings.model_fields)
    known = ["FEWVIEW_URL", "FEWVIEW_KEY", *settings_of_ours]  # the client's too
    strange = [n for n in os.environ if n.startswith("FEWVIEW_") and n.upper() not in known]
    for name in strange:
        words = f"{name}: {unknown('setting', name, known)}"
        yield Verdict("warning", "settings", words)
    where = (shown(settings.resolved_database_url), shown(settings.resolved_store_url))
    yield Verdict("ok", "settings", "records in {}, objects in {}".format(*where))
    if (settings.database_url is None) != (settings.store_url is None):
        yield Verdict(
            "warning",
            "settings",
            f"of records and objects one is elsewhere, one in {settings.data_dir.absolute()}: set "
            "FEWVIEW_DATABASE_URL and FEWVIEW_STORE_URL both, unless all processes see that folder",
        )


def _space(settings: Settings) -> Iterator[Verdict]:
    """Report the free space of the folders that are written to."""
    folders = {settings.data_dir.absolute()}
    url, objects = settings.resolved_database_url, urlsplit(settings.resolved_store_url)
    if url.get_backend_name() == "sqlite":
        folders.add(Path(str(url.database)).absolute().parent)
    if objects.scheme == "file":
        folders.add(Path(unquote(objects.path)))
    devices = {folder.stat().st_dev: folder for folder in sorted(folders) if folder.is_dir()}
    for folder in devices.values():
        room = shutil.disk_usage(folder)
        words = f"{room.free / 2**30:.1f} of {room.total / 2**30:.1f} GiB free in {folder}"
        if room.free < LITTLE_SPACE:
            words += ": free some space, or delete old records (see `fewview prune --help`)"
        state: Literal["ok", "warning", "failed"] = "ok"
        if room.free < LITTLE_SPACE:
            state = "failed" if room.free < TOO_LITTLE_SPACE else "warning"
        yield Verdict(state, "space", words)


def _confinement() -> Verdict:
    """Report whether the kernel confines the processes that read uploaded files of detectors."""
    missing = {"landlock", "seccomp"}.difference(confinement.available())
    if not missing:
        return Verdict("ok", "uploads", "what reads a file of others can read nothing else")
    words = (
        f"the kernel has no {' and no '.join(sorted(missing))}: what reads a file of others can be "
        "kept from other files only by its own checks. Linux 5.13 or newer on x86-64 or arm64 has "
        "both"
    )
    return Verdict("warning", "uploads", words)


def _queue(settings: Settings) -> Redis:
    if settings.redis_url is not None:
        return connect(str(settings.redis_url), retries=0)
    socket = settings.data_dir.absolute() / "valkey" / "valkey.sock"
    if not socket.exists():
        raise FileNotFoundError(socket)
    return connect(str(AnyUrl(f"unix://{quote(str(socket))}")), retries=0)


def _no_queue(settings: Settings, error: Exception) -> Verdict:
    if settings.redis_url is None:
        words = "the embedded queue does not run: it does while `fewview serve` runs here"
        return Verdict("warning", "queue", words)
    where = shown(settings.redis_url)
    words = f"{where} cannot be reached ({in_words(error)}): start it, or set FEWVIEW_REDIS_URL"
    return Verdict("failed", "queue", words)


def _clocks(store: Store, connection: Redis | None) -> Iterator[Verdict]:
    began = time.time()
    with store.reading() as session:
        clocks = {"records": clock.read(session) - (began + time.time()) / 2}
    if connection is not None:
        began = time.time()
        seconds, microseconds = connection.time()
        clocks["queue"] = seconds + microseconds / 1e6 - (began + time.time()) / 2
    for name, apart in clocks.items():
        if abs(apart) < MOST_CLOCK_SECONDS:
            yield Verdict("ok", "clocks", f"that of the {name} and of this host agree")
        else:
            yield Verdict(
                "warning",
                "clocks",
                f"that of the {name} is {abs(apart):.0f} s {'ahead of' if apart > 0 else 'behind'} "
                "that of this host: have both set by NTP. No work is lost, but times are wrong",
            )


def _jobs(store: Store, connection: Redis) -> Iterator[Verdict]:
    workers = Worker.count(connection=connection)
    waiting: dict[str, int] = {}
    oldest = 0.0
    with store.reading() as session:
        now = clock.read(session)
        for kind in (FitRecord, LiftRecord):
            queued = kind.status == "queued"
            count, since = session.execute(
                select(func.count(), func.min(kind.created_at)).where(queued)
            ).one()
            waiting[f"{kind.noun}s"] = count
            oldest = max(oldest, now - since if since is not None else 0.0)
    words = f"{workers} running; {waiting['fits']} fits and {waiting['lifts']} lifts wait"
    if any(waiting.values()):
        words += f", the oldest for {oldest:.0f} s"
    if not workers:
        state: Literal["warning", "failed"] = "failed" if any(waiting.values()) else "warning"
        yield Verdict(state, "workers", f"{words}: start `fewview worker`")
    elif oldest > MOST_WAITING_SECONDS:
        yield Verdict("warning", "workers", f"{words}: start more with `fewview worker`")
    else:
        yield Verdict("ok", "workers", words)


def _lonely_queues(connection: Redis) -> Iterator[Verdict]:
    """Name queues from which no worker takes, though there are workers."""
    if not Worker.count(connection=connection):
        return
    for queue in open_queues(connection):
        if not Worker.count(queue=queue):
            waiting = queue.count
            words = f"none takes from the queue {queue.name}, where {waiting} jobs wait: start "
            yield Verdict(
                "failed" if waiting else "warning",
                "workers",
                f"{words}`fewview worker --takes {queue.name}`, or one that takes all",
            )


def _objects(store: Store, *, deep: bool) -> Iterator[Verdict]:
    probe, began = f"doctor/{new_id('probe')}", time.monotonic()
    store.objects.put(probe, b"written by fewview doctor")
    try:
        store.objects.get(probe)
    finally:
        store.objects.delete(probe)
    took = 1000 * (time.monotonic() - began)
    yield Verdict("ok", "objects", f"one was written, read and deleted in {took:.0f} ms")
    if not deep:
        return
    with store.reading() as session:
        known = known_keys(session)
    harmed = store.objects.damaged(known)
    with store.reading() as session:
        harmed &= known_keys(session)  # others were deleted meanwhile
    for key in sorted(harmed)[:SHOWN]:
        yield Verdict("failed", "objects", f"{key} is lost or damaged")
    if harmed:
        words = f"{len(harmed)} of {len(known)} are lost or damaged: restore a backup elsewhere "
        yield Verdict("failed", "objects", words + "and compare, or delete what they belong to")
    else:
        yield Verdict("ok", "objects", f"all {len(known)} were read, and are as they were written")
