"""Health: which version is this, is the process up, and can it reach its parts."""

import logging
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Literal

import redis.exceptions
from fastapi import APIRouter, Request
from obstore.exceptions import BaseError as ObjectStoreError
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.exc import SQLAlchemyError

from service.http.dependencies import RedisDep, refuse_if_leaving
from service.http.errors import ApiError, problems
from store import deployment
from store.database import Store
from store.errors import DeploymentError
from store.integrity import RECORDS_DAMAGED, is_corrupt
from worker import at_work
from worker.queue import open_queues

logger = logging.getLogger(__name__)
router = APIRouter(tags=["health"])

API_VERSION = 1  # grows when clients must change; what is only added leaves it


class Liveness(BaseModel):
    """The process answers."""

    model_config = ConfigDict(json_schema_extra={"example": {"status": "ok"}})

    status: Literal["ok"] = "ok"


class Check(BaseModel):
    """One part that was reached."""

    status: Literal["ok"] = "ok"
    milliseconds: float


class Readiness(BaseModel):
    """Every part was reached."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "status": "ok",
                "queue": {"status": "ok", "milliseconds": 0.3},
                "records": {"status": "ok", "milliseconds": 0.5},
                "objects": {"status": "ok", "milliseconds": 1.2},
                "workers": 1,
            }
        }
    )

    status: Literal["ok"] = "ok"
    queue: Check
    records: Check
    objects: Check
    workers: int = Field(description="Workers that do their work, here or elsewhere.")


class Version(BaseModel):
    """What runs here."""

    model_config = ConfigDict(json_schema_extra={"example": {"service": "0.1.0", "api": 1}})

    service: str = Field(description="Of the package `fewview-server`.")
    api: int = Field(
        description="Grows when clients must change; what is only added leaves it as it is."
    )


@router.get("/version", responses=problems())
async def get_version() -> Version:
    """Return the versions of the service and of its API."""
    return Version(service=version("fewview-server"), api=API_VERSION)


@router.get("/health/live", responses=problems())
async def check_live() -> Liveness:
    """Report that the process is up."""
    return Liveness()  # asynchronous: all threads may be waiting for the records


@router.get("/health/ready", responses=problems("unavailable", "draining"))
def check_ready(request: Request, connection: RedisDep) -> Readiness:
    """Reach queue, records and objects; 503 names those that cannot be reached, or are damaged.

    It is 503, too, while jobs wait and there are workers, but none of them does its work. Whether
    a file of records is damaged is looked for once in a while, beside these requests. Once the
    service stops it is 503 with the code `draining`.
    """
    refuse_if_leaving(request)
    store: Store = request.app.state.store  # of the whole deployment: balancers have no key
    parts: dict[str, Callable[[], object]] = {
        "queue": connection.ping,
        "records": store.check_records,
        "objects": partial(deployment.check, store.objects, store.identity),
    }
    checks: dict[str, Check] = {}
    failures: list[tuple[str, str]] = []
    for name, reach in parts.items():
        started = time.perf_counter()
        try:
            reach()
        except (redis.exceptions.RedisError, SQLAlchemyError, ObjectStoreError, OSError) as error:
            logger.warning("%s cannot be used: %s", name, error)
            words = "cannot be reached; see the log for the reason"
            failures.append((f"/{name}", RECORDS_DAMAGED if is_corrupt(error) else words))
        except DeploymentError as error:
            logger.error("%s", error)
            failures.append((f"/{name}", "not those of the records; see the log for details"))
        else:
            checks[name] = Check(milliseconds=round(1000 * (time.perf_counter() - started), 3))
    if "records" in checks and request.app.state.integrity.damage() is not None:
        failures.append(("/records", RECORDS_DAMAGED))
    if failures:
        names = ", ".join(pointer.lstrip("/") for pointer, _ in failures)
        words = f"Cannot be reached, or are damaged: {names}."
        raise ApiError("unavailable", words, errors=failures)
    workers = at_work.count(connection)
    waits = any(queue.has_work() for queue in open_queues(connection))
    if waits and workers.known and not workers.at_work:
        why = "jobs wait, and no worker is working; see the workers' logs for the reason"
        raise ApiError("unavailable", f"workers: {why}.", errors=[("/workers", why)])
    return Readiness(**checks, workers=workers.at_work)
