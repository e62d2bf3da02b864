"""Aliases of models: they stand for an identifier everywhere, and are moved in one step."""

import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from store import access_keys, datasets, fits, lifts
from store.authors import Author
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import NotFoundError
from tests.service.conftest import (
    BYTES,
    frames_of,
    problem,
    served,
    to_safetensors,
)
from tests.service.realtime.conftest import as_bytes, read_bytes, started
from tests.waiting import wait_for

ALIAS = "walk@production"
ONE_FRAME = np.random.default_rng(0).uniform(0, 1000, (1, 3, 16, 2))


@pytest.fixture(scope="module")
def http(settings: Settings) -> Iterator[httpx2.Client]:
    """Serve from another process, as far as models in memory go, than `api`."""
    with served(settings) as client:
        yield client


@pytest.fixture(scope="module")
def other_model(api: TestClient, weights: bytes) -> str:
    return str(api.post("/models?name=other", content=weights, headers=BYTES).json()["id"])


@pytest.fixture
def alias(api: TestClient, model: str) -> Iterator[str]:
    answer = api.put(f"/models/{ALIAS}", json={"model_id": model})
    assert answer.status_code == 200, answer.text
    yield ALIAS
    api.delete(f"/models/{ALIAS}")


def lifted_by(client: Any, capture: SyntheticCapture, name: str = ALIAS) -> str:
    body = {"model": name, "frames": frames_of(capture.keypoints[:1]), "refine": "off"}
    answer = client.post("/lift", json=body)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["model"])


def test_an_alias_stands_for_its_model(
    api: TestClient, http: httpx2.Client, alias: str, model: str, capture: SyntheticCapture
) -> None:
    assert api.get(f"/models/{alias}").json() == api.get(f"/models/{model}").json()
    for part in ("cameras", "weights"):
        found = api.get(f"/models/{alias}/{part}")
        assert found.status_code == 200
        assert found.content == api.get(f"/models/{model}/{part}").content
    assert api.patch(f"/models/{alias}", json={"tags": ["in use"]}).json()["id"] == model
    assert api.patch(f"/models/{model}", json={"tags": []}).json()["tags"] == []

    assert lifted_by(api, capture) == model
    body = to_safetensors(keypoints=capture.keypoints[:2])
    url = "/lift?model={}&format=safetensors"
    answers = [api.post(url.format(n), content=body, headers=BYTES) for n in (alias, model)]
    assert answers[0].content == answers[1].content
    streamed = []
    for name in (alias, model):
        with started(http, name, model_id=model) as socket:
            socket.send(as_bytes(1, capture.keypoints[0]))
            streamed.append(socket.recv(timeout=60))
    assert streamed[0] == streamed[1]


def test_jobs_keep_the_model_that_an_alias_stood_for(
    api: TestClient, alias: str, model: str, capture: SyntheticCapture
) -> None:
    body = to_safetensors(keypoints=capture.keypoints[:8])
    dataset = api.post("/datasets", content=body, headers=BYTES).json()["id"]
    asked = {"dataset_id": dataset, "model_id": alias}
    lift = api.post("/lifts", json=asked | {"views": [0, 1, 2]}).json()
    assert lift["model_id"] == model
    fit = api.post("/fits", json={"dataset_id": dataset, "from_model": alias}).json()
    assert fit["from_model"] == model
    listed = api.get(f"/lifts?model_id={alias}").json()["items"]
    assert lift["id"] in [found["id"] for found in listed]
    for kind, made in (("lifts", lift), ("fits", fit)):
        assert api.post(f"/{kind}/{made['id']}/cancel").status_code == 202


def test_jobs_from_the_queue_know_aliases_of_their_project_alone(
    settings: Settings, weights: bytes, api: TestClient, alias: str, model: str
) -> None:
    with closing(Store(settings)) as store:  # on whose behalf nobody asks
        mine, theirs = (
            datasets.create(
                store.on_behalf_of(author), Capture.checked(ONE_FRAME), CaptureDescription("queued")
            )
            for author in (Author(), Author("theirs"))
        )
        lift = lifts.create(store, model_id=alias, dataset_id=mine.id, name="l", chunk_frames=8)
        assert lift.model_id == model
        lifts.cancel(store, lift.id)
        with pytest.raises(NotFoundError, match="no alias"):
            lifts.create(store, model_id=alias, dataset_id=theirs.id, name="l", chunk_frames=8)
        with pytest.raises(NotFoundError, match="no alias"):
            fits.create(store, dataset_id=theirs.id, name="f", config={}, from_model=alias)


def test_a_moved_alias_is_followed_within_a_second_and_by_every_lift(
    api: TestClient,
    http: httpx2.Client,
    alias: str,
    model: str,
    other_model: str,
    capture: SyntheticCapture,
) -> None:
    """While it is moved to and fro, every lift is answered, by one model or the other."""
    ended = threading.Event()
    seen: set[str] = set()

    def move() -> None:
        while not ended.is_set():
            for target in (other_model, model):
                answer = api.put(f"/models/{alias}", json={"model_id": target})
                assert answer.json()["model_id"] == target

    moving = threading.Thread(target=move)
    moving.start()
    try:
        for _ in range(30):
            seen.add(lifted_by(http, capture))
        wait_for(lambda: {*seen, lifted_by(http, capture)} == {model, other_model}, "both", 20)
    finally:
        ended.set()
        moving.join()
    assert seen <= {model, other_model}
    wait_for(lambda: lifted_by(http, capture) == model, "the last move", 10)
    with started(http, alias, model_id=model) as socket:
        assert api.put(f"/models/{alias}", json={"model_id": other_model}).status_code == 200
        assert lifted_by(api, capture) == other_model  # at once where it was moved
        wait_for(lambda: lifted_by(http, capture) == other_model, "the other process", 10)
        socket.send(as_bytes(1, capture.keypoints[0]))  # goes on with its model
        assert read_bytes(socket.recv(timeout=60)).sequence == 1
    moved = api.put("/models/walk@next", json={"model_id": alias}).json()
    assert moved["model_id"] == other_model  # of what the other alias stands for
    api.delete("/models/walk@next")


def test_a_model_with_an_alias_is_not_deleted_and_an_alias_without_its_model(
    api: TestClient, weights: bytes, capture: SyntheticCapture
) -> None:
    made = api.post("/models", content=weights, headers=BYTES).json()["id"]
    api.put("/models/run@test", json={"model_id": made})
    detail = problem(api.delete(f"/models/{made}"), 409, "conflict")
    assert "run@test" in detail
    refused = api.delete(f"/models?id={made}&expected_count=1").json()["refused"]
    assert [found["id"] for found in refused] == [made]
    listed = api.get(f"/aliases?model_id={made}").json()["items"]
    assert [(found["alias"], found["model_id"]) for found in listed] == [("run@test", made)]
    assert lifted_by(api, capture, "run@test") == made
    assert api.delete("/models/run@test").status_code == 204
    assert "no alias" in problem(api.get("/models/run@test"), 404, "not_found")
    problem(api.delete("/models/run@test"), 404, "not_found")
    body = {"model": "run@test", "frames": frames_of(capture.keypoints[:1])}
    problem(api.post("/lift", json=body), 404, "not_found")
    actions = [found["action"] for found in api.get("/audit?target=run@test").json()["items"]]
    assert actions == ["alias.delete", "alias.set"]
    assert api.delete(f"/models/{made}").status_code == 204


def test_aliases_are_of_a_project(
    api: TestClient, alias: str, model: str, weights: bytes, capture: SyntheticCapture
) -> None:
    store: Store = api.app.state.store  # type: ignore[attr-defined]
    peer = api.app_state.pop("peer")
    try:
        _, token = access_keys.create(
            store, name="other", scopes=["read", "lift", "write"], project="aliases"
        )
        api.app.state.keyring.look()  # type: ignore[attr-defined]
        key = {"Authorization": f"Bearer {token}"}
        problem(api.get(f"/models/{alias}", headers=key), 404, "not_found")
        assert api.get("/aliases", headers=key).json()["items"] == []
        asked = {"model_id": model}
        problem(api.put(f"/models/{alias}", json=asked, headers=key), 404, "not_found")
        theirs = api.post("/models", content=weights, headers=key | BYTES).json()["id"]
        asked = {"model_id": theirs}
        assert api.put(f"/models/{alias}", json=asked, headers=key).status_code == 200
        body = {"model": alias, "frames": frames_of(capture.keypoints[:1]), "refine": "off"}
        assert api.post("/lift", json=body, headers=key).json()["model"] == theirs
        problem(api.delete(f"/models/{alias}", headers=key), 403, "forbidden")
    finally:
        api.app_state["peer"] = peer
    assert lifted_by(api, capture) == model


@pytest.mark.parametrize("name", ["Walk@production", "@production", "walk@", "a@b@c", "a b@c"])
def test_names_that_no_alias_may_have(api: TestClient, model: str, name: str) -> None:
    answer = api.put(f"/models/{name}", json={"model_id": model})
    assert answer.status_code in (404, 422)
    assert api.get("/aliases").json()["items"] == []
    problem(api.put(f"/models/{model}", json={"model_id": model}), 422, "invalid_input")
    problem(api.put("/models/a@b", json={"model_id": "mdl_none"}), 404, "not_found")
    problem(api.put("/models/a@b", json={}), 422, "invalid_input")


def test_aliases_are_listed_by_page(api: TestClient, model: str) -> None:
    names = [f"page@{number}" for number in range(5)]
    for name in reversed(names):
        api.put(f"/models/{name}", json={"model_id": model})
    found, cursor = [], ""
    while cursor is not None:
        page = api.get(f"/aliases?limit=2{cursor and f'&cursor={cursor}'}").json()
        found += [item["alias"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert found == names
    for name in names:
        assert api.delete(f"/models/{name}").status_code == 204
