"""What a process counts of its requests and lifts, and where the counts of all are added up."""

import os
import time
from pathlib import Path
from typing import NamedTuple

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, values
from prometheus_client.multiprocess import MultiProcessCollector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

FILES = ("counter", "histogram", "gauge_sum")  # prometheus_client's kinds, a file each
# Of a file, in advance: a store to a page of a memory map that the disk has no space for ends the
# process. All series there can be take less.
FILE_BYTES = 2 * 1024 * 1024
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
OTHER = "other"  # a path or a method that the service does not have
SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)
LIFT_SECONDS = (0.0002, 0.0005, *SECONDS[:11])
FRAMES = (1, 2, 4, 8, 16, 32, 64, 128, 256)


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

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request; called in the event loop."""
        key = (method, route, status)
        series = self._request_series.get(key)
        if series is None:
            method = method if method in METHODS else OTHER
            series = (
                self.requests.labels(method, route, str(status)),
                self.seconds.labels(method, route),
            )
            if method != OTHER:
                self._request_series[key] = series
        series[0].inc()
        series[1].observe(seconds)


class Measured:
    """Counts requests and WebSockets. Routes are those of the service, never paths."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()
        status = 0
        state = scope.setdefault("state", {})

        async def noting(message: Message) -> None:
            nonlocal status
            if "status" in message:
                status = message["status"]
            elif message["type"] == "websocket.accept":
                status = 101
                self._metrics.websockets.inc()
            await send(message)

        try:
            await self._app(scope, receive, noting)
        finally:
            metrics, websocket = self._metrics, scope["type"] == "websocket"
            if websocket and status == 101:
                metrics.websockets.dec()
            method = "GET" if websocket else scope["method"]
            # Without a status, the handshake was refused by closing it, or nobody was answered.
            known = status or (403 if websocket else 500)
            if websocket and known == 101:
                metrics.requests.labels(method, route_of(scope), "101").inc()
            else:
                metrics.request(method, route_of(scope), known, time.perf_counter() - began)
            if "problem" in state:
                metrics.problems.labels(str(known), state["problem"]).inc()


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
    values.ValueClass = values.MultiProcessValue(lambda: place.process)


def all_processes(metrics: Metrics) -> CollectorRegistry:
    """Return a registry, for one answer, of what all API processes of the service count."""
    folder = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
    if folder is None:
        return metrics.registry
    registry = CollectorRegistry()
    MultiProcessCollector(registry, folder)
    return registry
