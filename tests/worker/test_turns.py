"""Projects take turns at the workers, whatever one of them has put on the queues."""

from typing import Any, cast

import pytest
from redis import Redis

from store import datasets, fits, lookup
from store.authors import Author
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.jobs import RAISE_SECONDS, Priority
from store.records import FitRecord
from tests.deployments import on_every_deployment
from tests.waiting import wait_for
from tests.worker.conftest import CONFIG, LONG, StartWorker, wait_for_step, wait_until
from worker.fair_order import bring_forward, note_turn
from worker.queue import WorkQueue, enqueue, open_queue
from worker.schedule import Forecast, schedules
from worker.settings import WorkerSettings
from worker.time_slice import FitTurn

BRIEF = CONFIG | {"steps": 1, "refine": "off"}


class Users:
    """Who queues fits, each on behalf of a project and a key."""

    def __init__(self, store: Store, redis: Redis, capture: Capture) -> None:
        self._store, self._capture, self.queue = store, capture, open_queue(redis)

    def ask(
        self,
        project: str,
        key_id: str = "1",
        config: dict[str, Any] = BRIEF,
        priority: Priority = "normal",
    ) -> str:
        """Queue a fit, and return its identifier, which is its job's, too."""
        mine = self._store.on_behalf_of(Author(project, key_id))
        dataset = datasets.create(mine, self._capture, CaptureDescription("figure"))
        fit = fits.create(mine, dataset_id=dataset.id, name="f", config=config, priority=priority)
        enqueue(self.queue, fit)
        return fit.id


@pytest.fixture
def settings(settings: WorkerSettings) -> WorkerSettings:
    """Have a fit's turn end soon."""
    return settings.model_copy(update={"fit_turn_seconds": 1.0})


@pytest.fixture
def users(store: Store, redis: Redis, capture: Capture) -> Users:
    return Users(store, redis, capture)


def taken_in_turn(store: Store, queue: WorkQueue) -> list[str]:
    """Take all jobs as a worker does."""
    taken = []
    while queue.count:
        bring_forward(store, [queue])
        job_id = cast(bytes, queue.connection.lpop(queue.key)).decode()
        note_turn(store, queue.connection, job_id)
        taken.append(job_id)
    return taken


@on_every_deployment
def test_projects_and_their_keys_take_turns(store: Store, users: Users) -> None:
    first = [users.ask("greedy", "1") for _ in range(4)]
    second = [users.ask("greedy", "2") for _ in range(2)]
    others = [users.ask("other") for _ in range(2)]
    assert taken_in_turn(store, users.queue) == [
        *(first[0], others[0]),
        *(second[0], others[1]),
        *(first[1], second[1], first[2], first[3]),
    ]


def test_one_projects_jobs_stay_in_their_order(store: Store, users: Users) -> None:
    asked = [users.ask("one") for _ in range(3)]
    assert taken_in_turn(store, users.queue) == asked


def test_a_job_that_is_taken_meanwhile_does_not_come_back(
    store: Store, users: Users, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = [users.ask("greedy"), users.ask("greedy"), users.ask("other")]
    note_turn(store, users.queue.connection, asked[0])
    seen = users.queue.get_job_ids()
    users.queue.connection.lrem(users.queue.key, 1, asked[2])
    monkeypatch.setattr(users.queue, "get_job_ids", lambda: seen)
    bring_forward(store, [users.queue])
    monkeypatch.undo()
    assert users.queue.get_job_ids() == asked[:2]


def test_a_long_fit_gives_way_and_goes_on_where_it_was(
    store: Store, users: Users, start_worker: StartWorker
) -> None:
    long = users.ask("greedy", config=LONG)
    start_worker()
    wait_for_step(store, long, 1)
    own = users.ask("greedy")  # which waits for its own key's
    other = users.ask("other")
    wait_until(store, other, "succeeded")
    gave_way = lookup.get(store, FitRecord, long)
    assert lookup.get(store, FitRecord, own).status == "queued"
    assert gave_way.checkpoint_key is not None
    wait_for(lambda: lookup.get(store, FitRecord, long).attempt == 2, "the next attempt", 60)
    before = (gave_way.progress or {})["step"]
    wait_for_step(store, long, before + 1)
    went_on = lookup.get(store, FitRecord, long)
    assert (went_on.attempt, went_on.crashes, went_on.status) == (2, 0, "running")
    fits.cancel(store, long)
    wait_until(store, own, "succeeded")


def test_a_fit_gives_way_to_who_is_seen_to_wait_twice(
    store: Store, users: Users, redis: Redis, settings: WorkerSettings
) -> None:
    """Another worker may be free to take what has just come."""
    running = lookup.get(store, FitRecord, users.ask("greedy"))
    at_once = settings.model_copy(update={"fit_turn_seconds": 0.0})
    turn = FitTurn(redis, store, at_once, running)
    users.ask("other")
    assert not turn.is_over()
    wait_for(turn.is_over, "the second look", 20)


def test_urgent_fits_of_a_project_come_first_and_push_nobody_else_back(
    store: Store, users: Users
) -> None:
    greedy = {
        name: [users.ask("greedy", key, priority=name) for key in ("1", "1", "2")]
        for name in ("low", "normal", "high")
    }
    others = [users.ask("other") for _ in range(4)]
    taken = taken_in_turn(store, users.queue)
    assert taken[1:8:2] == others
    own = [fit for fit in taken if fit not in others]
    for name, place in (("high", 0), ("normal", 3), ("low", 6)):
        assert set(own[place : place + 3]) == set(greedy[name])


def test_each_day_of_waiting_counts_as_the_next_priority(store: Store, users: Users) -> None:
    asked = [users.ask("one", priority=each) for each in ("low", "normal", "high", "low")]
    for fit, days in zip(asked, (1, 0, 0, 2), strict=True):
        with store.writing() as session:
            lookup.lock(session, FitRecord, fit).created_at -= days * RAISE_SECONDS
    assert taken_in_turn(store, users.queue) == [asked[2], asked[3], asked[0], asked[1]]


def test_an_urgent_fit_takes_the_place_of_one_that_runs(
    store: Store, users: Users, start_worker: StartWorker
) -> None:
    long = users.ask("one", config=LONG)
    start_worker()
    wait_for_step(store, long, 1)
    low, high = users.ask("one", priority="low"), users.ask("one", priority="high")
    wait_until(store, high, "succeeded")
    assert lookup.get(store, FitRecord, low).status == "queued"
    fits.cancel(store, long)
    wait_until(store, low, "succeeded")


def test_fits_start_in_the_expected_order(
    store: Store, users: Users, start_worker: StartWorker
) -> None:
    first = [users.ask("greedy") for _ in range(3)]
    others = [users.ask("other"), users.ask("other", priority="high")]

    def expect() -> dict[str, Forecast]:
        return schedules(store, users.queue.connection, 300.0)

    before = expect()
    assert before.keys() == {*first, *others}
    assert all(
        (of.start, of.end, of.workers, of.measured) == (None, None, 0, 0) for of in before.values()
    )
    order = sorted(before, key=lambda fit: before[fit].ahead)
    assert [before[fit].ahead for fit in order] == [0, 1, 2, 3, 4]
    assert order == [first[0], others[1], first[1], others[0], first[2]]
    worker = start_worker()
    for fit in order:
        wait_until(store, fit, "succeeded")
    started = {fit: lookup.get(store, FitRecord, fit).started_at or 0.0 for fit in order}
    assert sorted(started, key=lambda fit: started[fit]) == order
    assert expect() == {}
    worker.kill()
    worker.wait()
    asked = [users.ask("greedy"), users.ask("greedy", priority="high"), users.ask("other")]
    known = expect()
    assert {(each.workers, each.measured) for each in known.values()} == {(1, 5)}
    soon = [known[fit] for fit in (asked[2], asked[1], asked[0])]  # the other's turn is next
    assert [each.ahead for each in soon] == [0, 1, 2]
    moments = [moment or 0.0 for each in soon for moment in (each.start, each.end)]
    assert moments == sorted(moments)
    assert moments[0] > max(started.values())
