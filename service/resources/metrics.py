"""Metrics for Prometheus: what all API processes count, and what records and queue hold."""

import logging
from collections.abc import Iterable, Iterator
from importlib.metadata import version

import redis.exceptions
from fastapi import APIRouter, Request
from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest
from prometheus_client.registry import Collector
from redis import Redis
from sqlalchemy.exc import SQLAlchemyError
from starlette.responses import Response

from service.http.dependencies import RedisDep
from service.http.errors import problems
from service.http.metrics import Metrics, all_processes
from store import tallies
from store.database import Store
from worker import at_work, counts

logger = logging.getLogger(__name__)
router = APIRouter(tags=["health"])

TEXT = "text/plain; version=0.0.4; charset=utf-8"
KINDS = ("fit", "lift")


class MetricsText(Response):
    """Metrics in the text format of Prometheus."""

    media_type = "text/plain"


@router.get("/metrics", response_class=MetricsText, responses=problems())
def get_metrics(request: Request, connection: RedisDep) -> Response:
    """Show metrics of the whole service, in the text format of Prometheus.

    Whichever process answers, requests and lifts are those of all processes of this `fewview
    serve`; jobs, bytes and workers are those of the deployment. What cannot be reached is left out
    (`fewview_part_reached`).
    """
    metrics: Metrics = request.app.state.metrics
    store: Store = request.app.state.store  # of the whole deployment, for every caller
    held = CollectorRegistry()
    held.register(_Held(list(_of_everything(store, connection))))
    counted = generate_latest(all_processes(metrics))
    return MetricsText(counted + generate_latest(held), headers={"Content-Type": TEXT})


class _Held(Collector):
    """What was read for one answer."""

    def __init__(self, found: list[Metric]) -> None:
        self._found = found

    def collect(self) -> Iterable[Metric]:
        return self._found


def _of_everything(store: Store, connection: Redis) -> Iterator[Metric]:
    build = GaugeMetricFamily("fewview_build_info", "The version that runs.", labels=["version"])
    build.add_metric([version("fewview-server")], 1)
    yield build
    reached = GaugeMetricFamily(
        "fewview_part_reached", "Whether a part of the service could be asked.", labels=["part"]
    )
    for part, found in (("records", _of_records(store)), ("queue", _of_queue(connection))):
        try:
            yield from list(found)
        except (SQLAlchemyError, redis.exceptions.RedisError) as error:
            logger.warning("No metrics of the %s: %s", part, error)
            reached.add_metric([part], 0)
        else:
            reached.add_metric([part], 1)
    yield reached


def _of_records(store: Store) -> Iterator[Metric]:
    found = tallies.read(store)
    jobs = GaugeMetricFamily(
        "fewview_jobs", "Fits and lifts that are recorded.", labels=["kind", "status"]
    )
    oldest = GaugeMetricFamily(
        "fewview_oldest_waiting_job_seconds",
        "Time since the oldest fit or lift that waits was asked for; 0 where none waits.",
        labels=["kind"],
    )
    expired = GaugeMetricFamily(
        "fewview_expired_leases",
        "Running fits, and chunks of lifts, whose worker is lost and which none has taken yet.",
        labels=["kind"],
    )
    for kind, tally in found.kinds.items():
        for status, count in tally.jobs.items():
            jobs.add_metric([kind, status], count)
        oldest.add_metric([kind], tally.oldest_seconds)
        expired.add_metric([kind], tally.expired)
    stored = GaugeMetricFamily(
        "fewview_stored_bytes",
        "What is kept, records and objects, by kind: what counts in the accounts of projects.",
        labels=["of"],
    )
    for name, size in found.stored_bytes.items():
        stored.add_metric([name], size)
    yield from (jobs, oldest, expired, stored)
    if found.swept_at is not None:
        words = "When the last sweep for objects that no record names began."
        yield GaugeMetricFamily("fewview_last_sweep_timestamp_seconds", words, found.swept_at)
    words = "Objects that no record names, which a later sweep deletes."
    yield GaugeMetricFamily("fewview_condemned_objects", words, found.condemned)


def _of_queue(connection: Redis) -> Iterator[Metric]:
    workers = GaugeMetricFamily(
        "fewview_workers", "Workers that live, and those of them at work.", labels=["state"]
    )
    for state, count in at_work.count(connection)._asdict().items():
        workers.add_metric([state], count)
    yield workers
    counted = counts.read(connection)
    for name, words in (
        ("retries", "Attempts at a fit, and at a chunk of a lift, after its first."),
        ("lease_losses", "Leases of fits and of chunks of lifts that ran out with their worker."),
    ):
        family = CounterMetricFamily(f"fewview_job_{name}", words, labels=["kind"])
        for kind in KINDS:
            family.add_metric([kind], counted.get(f"{kind}_{name}", 0))
        yield family
