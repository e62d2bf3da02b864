"""What several processes do to the same records at once."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Barrier
from typing import Any

import pytest

from store import attempts, datasets, fits, jobs, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import ConflictError, KeyReusedError, NotFoundError, QueueFullError, StoreError
from store.idempotency import Idempotency
from store.records import DatasetRecord, FitRecord, LiftRecord, ModelRecord
from store.settings import StoreSettings

ROUNDS = 6
DESCRIBE: dict[str, Any] = {"keypoints": 5, "config": {}, "training_curve": [], "metrics": {}}


@pytest.fixture
def stores(store: Store, settings: StoreSettings) -> Iterator[list[Store]]:
    """Open the deployment four times, as four processes do."""
    others = [Store(settings) for _ in range(3)]
    yield [store, *others]
    for other in others:
        other.close()


def at_once(*works: Callable[[], Any]) -> list[Any]:
    """Do all of it at the same time; return what each gave, or its error if that is the store's."""
    start = Barrier(len(works))

    def run(work: Callable[[], Any]) -> Any:
        start.wait()
        try:
            return work()
        except StoreError as error:
            return error

    with ThreadPoolExecutor(len(works)) as threads:
        return list(threads.map(run, works))


def by_all(stores: list[Store], work: Callable[..., Any], *given: Any) -> list[Any]:
    return at_once(*(partial(work, store, *given) for store in stores))


def succeeded(store: Store, dataset_id: str) -> tuple[str, str]:
    """Return a fit that has ended and its model."""
    fit = fits.create(store, dataset_id=dataset_id, name="f", config={})
    attempt = attempts.claim(store, fit.id, lease_seconds=60)
    assert attempt is not None
    model_id = attempts.succeed(
        store, attempt, weights=b"w", reconstruction=b"r", progress=None, describe=DESCRIBE
    )
    return fit.id, model_id


@pytest.mark.parametrize("kind", ["dataset", "model", "fit", "frames"])
def test_a_request_that_comes_many_times_at_once_makes_one_thing(
    stores: list[Store], capture: Capture, kind: str
) -> None:
    dataset = datasets.create(stores[0], capture, CaptureDescription("a")).id
    makers: dict[str, Callable[[Store, Idempotency], Any]] = {
        "dataset": lambda store, key: datasets.create(
            store, capture, CaptureDescription("b"), idempotency=key
        ),
        "model": lambda store, key: models.create(
            store, b"w", name="m", idempotency=key, **DESCRIBE
        ),
        "fit": lambda store, key: fits.create(
            store, dataset_id=dataset, name="f", config={}, idempotency=key
        ),
        "frames": lambda store, key: datasets.append(
            store, dataset, capture, max_frames=10**6, idempotency=key
        ),
    }
    for number in range(ROUNDS):
        made = by_all(stores, makers[kind], Idempotency(kind, str(number), "digest"))
        assert len({one.id for one in made}) == 1, made
    others = [Idempotency(kind, "other", digest) for digest in "abcd"]
    different = at_once(*map(partial, [makers[kind]] * 4, stores, others))
    assert sum(isinstance(one, KeyReusedError) for one in different) == 3
    frames = lookup.get(stores[0], DatasetRecord, dataset).frames
    assert frames == capture.frames * (1 + (ROUNDS + 1) * (kind == "frames"))


def test_a_queue_job_is_recorded_once_and_the_queue_keeps_its_bound(
    stores: list[Store], capture: Capture
) -> None:
    dataset = datasets.create(stores[0], capture, CaptureDescription("a")).id

    def make(store: Store, job_id: str) -> str:
        return fits.create(
            store, dataset_id=dataset, name="f", config={}, job_id=job_id, max_queued=ROUNDS + 1
        ).id

    def refuse(store: Store, job_id: str) -> str:
        fields: dict[str, Any] = {"name": "f", "dataset_id": "", "config": {}}
        return jobs.refuse(store, FitRecord, job_id=job_id, error={"code": "x"}, **fields)

    for number in range(ROUNDS):
        assert len(set(by_all(stores, make, f"job{number}"))) == 1
        assert len(set(by_all(stores, refuse, f"refused{number}"))) == 1
    more = at_once(*map(partial, [make] * 4, stores, "abcd"))
    assert sum(isinstance(one, QueueFullError) for one in more) == 3


def test_what_is_deleted_is_used_by_nothing_new(stores: list[Store], capture: Capture) -> None:
    first = stores[0]
    for _ in range(ROUNDS):
        dataset = datasets.create(first, capture, CaptureDescription("a")).id
        model = models.create(first, b"w", name="m", **DESCRIBE).id
        begin = partial(fits.create, name="n", config={}, dataset_id=dataset)
        lift = partial(lifts.create, name="n", chunk_frames=5, dataset_id=dataset, model_id=model)
        at_once(
            partial(begin, stores[1]),
            partial(lift, stores[2]),
            partial(models.delete, stores[3], model),
            partial(datasets.delete, first, dataset),
        )
        for fit in lookup.page(first, FitRecord, limit=9, after=None):
            assert lookup.get(first, DatasetRecord, fit.dataset_id)
            fits.cancel(first, fit.id)
            fits.delete(first, fit.id)
        for made in lookup.page(first, LiftRecord, limit=9, after=None):
            assert lookup.get(first, DatasetRecord, made.dataset_id)
            assert lookup.get(first, ModelRecord, made.model_id)
            lifts.cancel(first, made.id)
            lifts.delete(first, made.id)


def test_a_fit_and_its_model_are_deleted_side_by_side(
    stores: list[Store], capture: Capture
) -> None:
    dataset = datasets.create(stores[0], capture, CaptureDescription("a")).id
    for _ in range(ROUNDS):
        (fit, model), (other_fit, other_model) = (succeeded(stores[0], dataset) for _ in range(2))
        gone = at_once(
            partial(fits.delete, stores[0], fit),
            partial(models.delete, stores[1], model),
            partial(models.delete, stores[2], other_model),
            partial(fits.delete, stores[3], other_fit),
        )
        assert gone == [None] * 4


def test_a_model_that_a_fit_is_to_start_from_stays(store: Store, capture: Capture) -> None:
    dataset = datasets.create(store, capture, CaptureDescription("a")).id
    _, model = succeeded(store, dataset)
    fit = fits.create(store, dataset_id=dataset, name="f", config={}, from_model=model)
    with pytest.raises(ConflictError, match=fit.id):
        models.delete(store, model)
    fits.cancel(store, fit.id)
    models.delete(store, model)
    with pytest.raises(NotFoundError):
        models.delete(store, model)


def test_what_is_deleted_twice_at_once_is_gone_once(stores: list[Store], capture: Capture) -> None:
    for _ in range(ROUNDS):
        dataset = datasets.create(stores[0], capture, CaptureDescription("a")).id
        gone = by_all(stores, datasets.delete, dataset)
        assert gone.count(None) == 1
        assert sum(isinstance(one, NotFoundError) for one in gone) == 3
