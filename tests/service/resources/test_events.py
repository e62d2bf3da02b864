"""Following jobs: bounded in number, at the price of one look for all, through outages."""

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, text
from starlette.testclient import TestClient

from models.capture.synthetic import synthetic_capture
from models.settings.config import FitConfig
from service.resources.events import LOOK_SECONDS, Events
from service.settings import Settings
from store import datasets, fits
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.records import FitRecord
from tests.service.conftest import make_dataset, problem, served
from tests.waiting import wait_for

MANY = 40


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(Settings(data_dir=tmp_path))
    yield opened
    opened.close()


def queued(store: Store) -> FitRecord:
    keypoints = synthetic_capture(frames=4, views=2, seed=0).keypoints
    dataset = datasets.create(store, Capture.checked(keypoints), CaptureDescription("figure"))
    config = FitConfig().model_dump(mode="json")
    return fits.create(store, dataset_id=dataset.id, name="f", config=config)


async def followed(events: Events, fit: FitRecord) -> list[tuple[int, str]]:
    return [(job.revision, job.status) async for job in events.follow(fit, 0)]


def test_all_who_follow_cost_one_look(store: Store) -> None:
    looks: list[str] = []
    fit, other = queued(store), queued(store)

    async def follow() -> list[list[tuple[int, str]]]:
        events = Events(store, asyncio.Event())
        following = [
            asyncio.create_task(followed(events, [fit, other][n % 2])) for n in range(MANY)
        ]
        await asyncio.sleep(6 * LOOK_SECONDS)
        assert len(looks) <= 7
        for job in (fit, other):
            await asyncio.to_thread(fits.cancel, store, job.id)
        async with asyncio.timeout(60):
            return list(await asyncio.gather(*following))

    @event.listens_for(store.engine, "before_cursor_execute")
    def note(_connection: Any, _cursor: Any, statement: str, *_rest: Any) -> None:
        if statement.startswith("SELECT") and "IN (" in statement:
            looks.append(statement)

    found = asyncio.run(follow())
    assert len(found) == MANY
    for seen in found:
        assert [status for _, status in seen] == ["queued", "cancelled"]
        assert seen[0][0] < seen[1][0]


def test_an_outage_of_the_records_ends_nothing(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    fit = queued(store)

    async def follow() -> list[tuple[int, str]]:
        events = Events(store, asyncio.Event())
        following = asyncio.create_task(followed(events, fit))
        for there, away in (("fits", "elsewhere"), ("elsewhere", "fits")):
            with store.engine.execution_options(writing=True).begin() as connection:
                connection.execute(text(f"ALTER TABLE {there} RENAME TO {away}"))
            await asyncio.sleep(3 * LOOK_SECONDS)
            assert not following.done()
        await asyncio.to_thread(fits.cancel, store, fit.id)
        async with asyncio.timeout(60):
            return await following

    assert [status for _, status in asyncio.run(follow())] == ["queued", "cancelled"]
    message = [record for record in caplog.records if "cannot be read" in record.message]
    assert len(message) == 1  # of several looks in vain


def test_no_more_may_follow_than_are_allowed(settings: Settings, api: TestClient) -> None:
    fit = api.post("/fits", json={"dataset_id": make_dataset(api)["id"]}).json()
    url = f"/fits/{fit['id']}/events"
    with served(settings.model_copy(update={"max_event_streams": 2})) as http, ExitStack() as stack:
        following = [stack.enter_context(http.stream("GET", url)).iter_lines() for _ in range(2)]
        assert ["progress" in next(lines) for lines in following] == [True, True]
        refused = http.get(url)
        problem(refused, 503, "overloaded")
        assert int(refused.headers["retry-after"]) > 0
        assert http.get("/health/live").status_code == 200
        assert api.post(f"/fits/{fit['id']}/cancel").status_code == 202
        assert ["event: end" in [*lines] for lines in following] == [True, True]
        stack.close()
        wait_for(lambda: http.get(url).status_code == 200, "a place")
