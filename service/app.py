"""The FastAPI application."""

import asyncio
import gc
import logging
import os
import resource
import socket
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import Depends, FastAPI
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp

from service.http import errors
from service.http.authentication import PROBES, Authentication, needed
from service.http.body_bytes import BodyLimit
from service.http.connections import KEEP_ALIVE_SECONDS, Connection
from service.http.dependencies import refuse_foreign_changes, refuse_unknown_query
from service.http.faults import Faults
from service.http.head import Head
from service.http.hosts import Hosts
from service.http.key_rates import Rates
from service.http.keyring import Keyring, fixed_callers
from service.http.leaving import CLOSE_SECONDS, Server
from service.http.local_owner import VARIABLE, LocalOwner
from service.http.metrics import Metrics, Place, share
from service.http.operations import registered_schemas
from service.http.places import InHand, Places, Threads, Turns
from service.http.preconditions import describe_preconditions
from service.http.request_ids import Watched
from service.http.safe_headers import SafeHeaders
from service.http.websockets import WebSocketConnection
from service.page.documentation import serve_documentation
from service.page.serving import serve_page
from service.realtime import lift, stream, watch
from service.realtime.engine import Engine
from service.realtime.open_streams import OpenStreams
from service.realtime.rooms import Rooms
from service.resources import (
    aliases,
    animations,
    audit,
    cameras,
    captures,
    corrections,
    datasets,
    evaluations,
    fits,
    health,
    keys,
    labels,
    lifts,
    metrics,
    models,
    previews,
    queues,
    reconstructions,
    reports,
    schedules,
    skeletons,
    storage,
    webhooks,
)
from service.resources.events import Events
from service.resources.integrity import Integrity
from service.resources.schedules import Schedules
from service.settings import Settings
from store.access_keys import new_token
from store.database import Store
from worker import logs
from worker.patience import patiently
from worker.queue import connect

logger = logging.getLogger(__name__)

# Lifts come first: routes are tried in this order, and nothing else is in such a hurry.
RESOURCES = (
    lift,
    stream,
    watch,
    datasets,
    skeletons,
    previews,
    captures,
    corrections,
    fits,
    schedules,
    reconstructions,
    cameras,
    reports,
    animations,
    labels,
    models,
    aliases,
    lifts,
    evaluations,
    queues,
    storage,
    webhooks,
    keys,
    audit,
    health,
    metrics,
)

# What every route refuses, in this order.
REFUSALS = (refuse_foreign_changes, refuse_unknown_query)

QUEUE_PATIENCE_SECONDS = 0.5  # requests do not wait for a queue that hangs: the records will do

# Files of detectors that are read beside as many as there may be large uploads: reading may take
# minutes, and this many slow ones keep no other waiting. `reading_apart.MEMORY` bounds each.
SPARE_READERS = 2

# Endpoints, and pieces of downloads, that are worked on at a time. A process has 40 threads for
# them and others, and 20 connections to the records: one key with three quarters leaves some.
ENDPOINTS = 24

# New lists and objects before each of Python's searches for garbage: JSON of a large capture is
# millions of lists, and with Python's own thresholds parsing it takes twice as long.
GARBAGE_THRESHOLDS = (100_000, 50, 100)

# What scripts of web pages may read, besides what they always may.
EXPOSED_HEADERS = (
    "Accept-Ranges",
    "Content-Disposition",
    "Content-Range",
    "ETag",
    "Location",
    "Retry-After",
    "X-Request-Id",
)

BEARER = {
    "type": "http",
    "scheme": "bearer",
    "description": "The token of a key, as `fewview key create` or `POST /keys` gives it. Who "
    "connects from the service's own machine, as its own user or as root, needs none, unless by a "
    "browser, which needs that of `GET /page-key`.",
}

DESCRIPTION = """
3D structure and camera rotations from the 2D keypoints of a few uncalibrated, possibly moving
cameras. Store a capture (`POST /datasets`), fit a model to it (`POST /fits`), follow the fit
(`GET /fits/{id}/events`), read its main product (`GET /fits/{id}/reconstruction`), then lift new
frames in real time (`POST /lift`, or a stream of them: `/lift/stream`).

Keypoints are pixels, x right, y down. Errors are RFC 9457 problem details.
"""


def create_app(settings: Settings, page_key: str | None = None) -> FastAPI:
    """Return the application; the store and the queue are opened when it starts.

    Parameters
    ----------
    page_key
        What the page sends for the service's own user; None: a new one.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        gc.set_threshold(*GARBAGE_THRESHOLDS)
        app.state.store = Store(settings)
        app.state.redis = connect(
            str(settings.redis_url), retries=1, timeout_seconds=QUEUE_PATIENCE_SECONDS
        )
        _set_bounds(app, settings)
        app.state.schedules = Schedules(app.state.store, app.state.redis, settings)
        app.state.events = Events(app.state.store, app.state.leaving)
        app.state.engine = _make_engine(app, settings)
        app.state.keyring = Keyring(app.state.store, fixed_callers(settings))
        app.state.integrity = Integrity(app.state.store)
        app.state.rooms = Rooms(app.state.store)
        threading.Thread(target=app.state.engine.models.begin, daemon=True).start()
        yield
        await _close(app)

    app = FastAPI(
        title="Fewview",
        version=version("fewview-server"),
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=lifespan,
        generate_unique_id_function=_operation_id,
        docs_url=None,
        redoc_url=None,
        dependencies=[Depends(refuse) for refuse in REFUSALS],
    )
    app.state.settings = settings
    app.state.local_owner = LocalOwner(settings, page_key or new_token())
    app.state.leaving = asyncio.Event()
    app.state.metrics = Metrics()
    for module in RESOURCES:
        app.include_router(module.router)
    serve_documentation(app)
    serve_page(app)
    errors.install(app)
    app.add_middleware(
        BodyLimit,
        max_bytes=settings.max_body_bytes,
        max_pending_bytes=settings.resolved_pending_bytes,
        seconds=settings.request_seconds,
    )
    app.add_middleware(InHand, most=settings.max_requests)
    app.add_middleware(Head)
    app.add_middleware(Authentication, settings=settings, owner=app.state.local_owner)
    if settings.allowed_origins:
        app.add_middleware(Faults)
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.allowed_origins,
            allow_methods=["*"],
            allow_headers=["*"],
            expose_headers=EXPOSED_HEADERS,
        )
    app.add_middleware(Hosts, settings=settings)
    _wrap(app)
    _describe(app)
    return app


async def _close(app: FastAPI) -> None:
    await asyncio.to_thread(app.state.engine.close)
    app.state.metrics.flush()
    app.state.lift_bodies.close()
    app.state.keyring.close()
    await app.state.rates.close()
    await app.state.open_streams.close()
    app.state.store.close()
    app.state.redis.close()


def _make_engine(app: FastAPI, settings: Settings) -> Engine:
    metrics: Metrics = app.state.metrics
    return Engine(
        app.state.store,
        max_bytes=settings.warm_model_bytes,
        threads=settings.lift_threads,
        on_batch=metrics.batch,
        on_answer=metrics.lifted,
    )


def _set_bounds(app: FastAPI, settings: Settings) -> None:
    """Set the limits of concurrent work."""
    large = settings.large_at_a_time
    app.state.large_uploads = Turns(large)
    app.state.readers = Turns(large + SPARE_READERS, reserving=True)
    app.state.endpoints = Turns(ENDPOINTS, reserving=True)
    app.state.calculations = Turns(large)
    app.state.large_lifts = Turns(large)
    # As many again are for small ones, which do not wait for large ones.
    app.state.lift_bodies = Threads(2 * large, "lift-body")
    app.state.rates = Rates(str(settings.redis_url))
    app.state.open_streams = OpenStreams(str(settings.redis_url))
    app.state.streams = Places(settings.max_streams)
    app.state.event_places = Places(settings.max_event_streams)


def _wrap(app: FastAPI) -> None:
    """Put around the application what sees every answer, of faults too.

    Starlette answers those outside of all that `add_middleware` adds.
    """
    build = app.build_middleware_stack

    def wrapped() -> ASGIApp:
        return Watched(SafeHeaders(build()), app.state.metrics)

    app.build_middleware_stack = wrapped  # type: ignore[method-assign]


def _operation_id(route: APIRoute) -> str:
    return route.name


def _describe(app: FastAPI) -> None:
    """Add to the OpenAPI document what FastAPI cannot derive from the code."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = generate()
            schemas = schema["components"]["schemas"]
            schemas.update(errors.problem_schemas())
            schemas.update(registered_schemas())
            schema["components"]["securitySchemes"] = {"bearer": BEARER}
            for path, operations in schema["paths"].items():
                for method, operation in operations.items():
                    operation["security"] = [{"bearer": [*needed(method.upper(), path)]}]
                    if path in PROBES:  # which need a key on loopback alone
                        operation["security"].append({})
            describe_preconditions(schema["paths"])
            for unused in ("HTTPValidationError", "ValidationError"):
                schemas.pop(unused, None)
            for name, kind in ((n, k) for module in RESOURCES for n, k in vars(module).items()):
                is_schema = isinstance(kind, type) and issubclass(kind, BaseModel)
                if is_schema and "example" in schemas.get(name, {}):
                    # FastAPI has taken its nulls out.
                    schemas[name]["example"] = kind.model_config["json_schema_extra"]["example"]
            for path in ("/fits/{fit_id}/events", "/lifts/{lift_id}/events"):
                events = schema["paths"][path]["get"]["responses"]["200"]
                # FastAPI writes what only OpenAPI 3.2 knows into a document of version 3.1.
                events["content"]["text/event-stream"] = {"schema": {"type": "string"}}
        assert app.openapi_schema is not None  # noqa: S101
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def make_server(settings: Settings, page_key: str | None = None) -> Server:
    """Return what serves the application."""
    app = create_app(settings, page_key)
    connection: Any = partial(
        Connection, seconds=settings.request_seconds, on_refusal=app.state.metrics.refused
    )
    web_socket: Any = partial(WebSocketConnection, seconds=settings.request_seconds)
    config = uvicorn.Config(
        app,
        loop="uvloop",
        http=connection,
        ws=web_socket,
        ws_max_size=settings.max_stream_bytes,
        ws_per_message_deflate=False,  # numbers hardly shrink, and it takes longer than the lift
        log_config=None,  # what it logs goes where everything else does
        log_level="warning",
        access_log=False,
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=CLOSE_SECONDS,
        server_header=False,
    )
    return Server(
        config,
        app.state.leaving,
        drain_seconds=settings.drain_seconds,
        grace_seconds=settings.grace_seconds,
    )


def main() -> None:
    """Serve the API as a child of ``fewview serve``, with the settings in the environment.

    The arguments are the sockets that it listens on, for a restarted API finds the requests that
    came while it was away; the folder in which all processes count, and the name of this one there.
    The page's key is in the environment, which other users cannot read.
    While records or objects are away it waits for them: one that could not start would be started
    again and again.
    """
    listeners, folder, process = sys.argv[1:]
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # for connections that are kept open
    settings = Settings()
    logs.set_up(settings.log_format)
    patiently(lambda: Store(settings).close(), hurry=lambda: False)  # SIGTERM ends it
    if folder:
        try:
            share(Place(Path(folder), process))
        except OSError:
            logger.exception("Metrics are of this process alone")
    server = make_server(settings, os.environ.pop(VARIABLE, None))
    server.run(sockets=[socket.socket(fileno=int(number)) for number in listeners.split(",")])


if __name__ == "__main__":
    main()
