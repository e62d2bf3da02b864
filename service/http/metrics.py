"""What a process counts of its requests and lifts, and where the counts of all are added up."""

import asyncio
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    values,
)
from prometheus_client.multiprocess import MultiProcessCollector
from starlette.types import Scope

FILES = ("counter", "histogram", "gauge_sum")  # prometheus_client's kinds, a file each
# Of a file, in advance: a store to a page of a memory map that the disk has no space for ends the
# process. All series there can be take less.
FILE_BYTES = 2 * 1024 * 1024
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
FLUSH_SECONDS = 0.05  # after which what was noted is counted
SWITCHED = 101  # the status of a handshake that is accepted
OTHER = "other"  # a path or a method that the service does not have
SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)
LIFT_SECONDS = (0.0002, 0.0005, *SECONDS[:11])
FRAMES = (1, 2, 4, 8, 16, 32, 64, 128, 256)


disable_created_metrics()  # type: ignore[no-untyped-call]  # series without use


class Metrics:
    """What one API process counts.

    Attributes
    ----------
    registry
        That of this process alone; :func:`all_processes` returns everybody's.
    """

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        self.requests = Counter(
            "fewview_http_requests",
            "Requests that were answered.",
            ("method", "route", "status"),
            registry=registry,
        )
        self.seconds = Histogram(
            "fewview_http_request_duration_seconds",
            "From a request's head to the end of its answer.",
            ("method", "route"),
            buckets=SECONDS,
            registry=registry,
        )
        self.problems = Counter(
            "fewview_http_problems",
            "Answers that are problem details, by their code; refusals are those of 429 and 503.",
            ("status", "code"),
            registry=registry,
        )
        self.websockets = Gauge(
            "fewview_websockets_open",
            "WebSockets that are open.",
            multiprocess_mode="sum",
            registry=registry,
        )
        self.websockets.set(0)  # those of a process that died were closed
        self.lift_seconds = Histogram(
            "fewview_lift_duration_seconds",
            "From asking the engine for a lift to its answer, of requests and streams.",
            buckets=LIFT_SECONDS,
            registry=registry,
        )
        self.lift_frames = Histogram(
            "fewview_lift_batch_frames",
            "Frames that were lifted together.",
            buckets=FRAMES,
            registry=registry,
        )
        self._request_series: dict[tuple[str, str, int], tuple[Counter, Histogram]] = {}
        self._pending: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._scheduled = False

    def batch(self, frames: int) -> None:
        """Note frames that are lifted together; called in any thread, before `lifted`."""
        self._pending.append((self.lift_frames.observe, (frames,)))

    def lifted(self, seconds: float) -> None:
        """Note how long a lift took; called in the event loop, as those below are."""
        self._note(self.lift_seconds.observe, seconds)

    def opened(self) -> None:
        """Note that a WebSocket was opened."""
        self.websockets.inc()

    def answered(self, scope: Scope, status: int, seconds: float) -> None:
        """Note the end of a request, or of a WebSocket."""
        if scope["type"] == "http":
            self._note(self._request, scope["method"], route_of(scope), status, seconds)
        else:
            if status == SWITCHED:
                self.websockets.dec()
            self._note(self.requests.labels("GET", route_of(scope), str(status)).inc)
        if "problem" in scope["state"]:
            self._note(self.problems.labels(str(status), scope["state"]["problem"]).inc)

    def refused(self, status: int, code: str) -> None:
        """Note what was refused before it was a request."""
        self._note(self.requests.labels(OTHER, OTHER, str(status)).inc)
        self._note(self.problems.labels(str(status), code).inc)

    def flush(self) -> None:
        """Count what was noted."""
        self._scheduled = False
        while self._pending:
            count, figures = self._pending.popleft()
            count(*figures)

    def _note(self, count: Callable[..., None], *figures: Any) -> None:
        """Have something counted soon, and not now, when somebody waits for an answer."""
        self._pending.append((count, figures))
        if not self._scheduled:
            self._scheduled = True
            asyncio.get_running_loop().call_later(FLUSH_SECONDS, self.flush)

    def _request(self, method: str, route: str, status: int, seconds: float) -> None:
        key = (method, route, status)
        series = self._request_series.get(key)
        if series is None:
            known = method if method in METHODS else OTHER
            series = (
                self.requests.labels(known, route, str(status)),
                self.seconds.labels(known, route),
            )
            if known != OTHER:
                self._request_series[key] = series
        series[0].inc()
        series[1].observe(seconds)


def route_of(scope: Scope) -> str:
    """Return the template of the route that answers, of which there are as many as in the code."""
    path = getattr(scope.get("route"), "path", None)
    return OTHER if path is None else str(path)


class Place(NamedTuple):
    """Where an API process counts.

    Attributes
    ----------
    folder
        Of the files of all processes.
    process
        The name of this one, which the process that takes its place has, too: so it goes on
        counting where this one ended, and no file of a dead process is ever left.
    """

    folder: Path
    process: str


def share(place: Place) -> None:
    """Have what this process counts from now on be kept in the folder, with that of others.

    Raises
    ------
    OSError
        If there is no space for it.
    """
    for kind in FILES:
        file = os.open(place.folder / f"{kind}_{place.process}.db", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            os.posix_fallocate(file, 0, FILE_BYTES)
        finally:
            os.close(file)
    os.environ["PROMETHEUS_MULTIPROC_DIR"] = str(place.folder)
    values.ValueClass = values.MultiProcessValue(  # type: ignore[no-untyped-call]
        lambda: place.process
    )


def all_processes(metrics: Metrics) -> CollectorRegistry:
    """Return a registry, for one answer, of what all API processes of the service count."""
    metrics.flush()
    folder = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
    if folder is None:
        return metrics.registry
    registry = CollectorRegistry()
    MultiProcessCollector(registry, folder)  # type: ignore[no-untyped-call]
    return registry
