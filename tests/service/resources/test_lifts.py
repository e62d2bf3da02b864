"""Lifts of stored datasets: queued, followed, cancelled, and their results."""

import io
import time
from typing import Any

import numpy as np
import orjson
import pytest
from safetensors.numpy import load
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from models.settings.uncertainty import ARRAYS
from service.settings import Settings
from store import lift_chunks
from store.database import Store
from tests.service.conftest import (
    BYTES,
    Live,
    assert_can_be_resumed,
    job_events,
    make_dataset,
    problem,
    to_safetensors,
)
from tests.waiting import wait_for


def post(api: TestClient, model: str, dataset: str, **more: Any) -> dict[str, Any]:
    response = api.post("/lifts", json={"model_id": model, "dataset_id": dataset, **more})
    assert response.status_code == 202, response.text
    made: dict[str, Any] = response.json()
    assert response.headers["Location"] == f"/lifts/{made['id']}"
    return made


def test_a_lift_is_queued_listed_cancelled_and_deleted(api: TestClient, model: str) -> None:
    dataset = make_dataset(api)
    lift = post(api, model, dataset["id"], name="all", refine="off")
    assert (lift["status"], lift["name"], lift["refine"]) == ("queued", "all", "off")
    assert lift["frames"] == dataset["frames"]
    done = {"frames_done": 0, "chunks_done": 0, "chunks": 1, "seconds_left": None}
    assert lift["progress"] == done
    url = f"/lifts/{lift['id']}"
    assert api.get(url).json() == lift
    for query in (f"job_id={lift['job_id']}", f"dataset_id={dataset['id']}&status=queued"):
        assert api.get(f"/lifts?{query}").json()["items"] == [lift]
    for query in (f"dataset_id={dataset['id']}&status=running", "model_id=mdl_x"):
        assert api.get(f"/lifts?{query}").json()["items"] == []
    problem(api.get(f"{url}/result"), 409, "conflict")
    problem(api.delete(url), 409, "conflict")
    assert lift["id"] in problem(api.delete(f"/datasets/{dataset['id']}"), 409, "conflict")
    assert lift["id"] in problem(api.delete(f"/models/{model}"), 409, "conflict")

    cancelled = api.post(f"{url}/cancel")
    assert cancelled.status_code == 202
    assert cancelled.json()["status"] == "cancelled"
    assert api.post(f"{url}/cancel").json() == cancelled.json()
    problem(api.get(f"{url}/result"), 409, "conflict")
    assert api.delete(url).status_code == 204
    for response in (
        api.get(url),
        api.delete(url),
        api.post(f"{url}/cancel"),
        api.get(f"{url}/events"),
        api.get(f"{url}/result"),
    ):
        problem(response, 404, "not_found")
    assert api.delete(f"/datasets/{dataset['id']}").status_code == 204


def test_a_repeated_request_makes_one_lift(api: TestClient, model: str) -> None:
    body = {"model_id": model, "dataset_id": make_dataset(api)["id"]}
    key = {"Idempotency-Key": "lift"}
    first = api.post("/lifts", json=body, headers=key)
    assert api.post("/lifts", json=body, headers=key).json() == first.json()
    other = api.post("/lifts", json=body | {"refine": "off"}, headers=key)
    problem(other, 422, "idempotency_key_reused")
    api.post(f"/lifts/{first.json()['id']}/cancel")


@pytest.mark.parametrize(
    ("changed", "pointer"),
    [
        ({"model_id": 3}, "/model_id"),
        ({"model_id": "m" * 201}, "/model_id"),
        ({"dataset_id": None}, "/dataset_id"),
        ({"name": ""}, "/name"),
        ({"refine": "some"}, "/refine"),
        ({"uncertainty": "some"}, "/uncertainty"),
        ({"views": "all"}, "/views"),
        ({"views": []}, "/views"),
        ({"views": [0]}, "/views"),
        ({"views": [0, 0]}, "/views"),
        ({"views": [0, -1]}, "/views/1"),
        ({"views": [0, 9]}, "/views"),
        ({"views": [0] * 65}, "/views"),
        ({"frames": []}, "/frames"),
    ],
)
def test_what_is_wrong_with_a_request_is_named(
    api: TestClient, model: str, changed: dict[str, Any], pointer: str
) -> None:
    body = {"model_id": model, "dataset_id": make_dataset(api)["id"]} | changed
    problem(api.post("/lifts", json=body), 422, "invalid_input", pointer)
    assert api.get("/lifts?status=queued").json()["items"] == []


def test_what_is_not_there_cannot_be_lifted(api: TestClient, model: str) -> None:
    dataset = make_dataset(api)["id"]
    for body in (
        {"model_id": model, "dataset_id": "ds_x"},
        {"model_id": "mdl_x", "dataset_id": dataset},
        {"model_id": "mdl_x", "dataset_id": dataset, "views": [0, 1]},
    ):
        problem(api.post("/lifts", json=body), 404, "not_found")
    few = to_safetensors(keypoints=np.ones((3, 2, 5, 2), np.float32))
    other = api.post("/datasets", content=few, headers=BYTES).json()["id"]
    response = api.post("/lifts", json={"model_id": model, "dataset_id": other})
    problem(response, 422, "invalid_input", "/dataset_id")
    problem(api.post("/lifts", content=few, headers=BYTES), 415, "unsupported_media_type")
    problem(api.get("/lifts?cursor=fit_x"), 422, "invalid_input", "/cursor")


def test_too_many_waiting_lifts_are_refused(api: TestClient, model: str) -> None:
    body = {"model_id": model, "dataset_id": make_dataset(api)["id"]}
    waiting = []
    while (response := api.post("/lifts", json=body)).status_code == 202:
        waiting.append(response.json()["id"])
    problem(response, 429, "too_many_lifts")
    assert response.headers["Retry-After"]
    assert len(waiting) == 5
    cursor, seen = "", []
    while cursor is not None:
        page = api.get(f"/lifts?status=queued&limit=2{cursor and f'&cursor={cursor}'}").json()
        seen += [item["id"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert seen == sorted(waiting, reverse=True)
    for lift in waiting:
        assert api.post(f"/lifts/{lift}/cancel").status_code == 202


def test_a_failed_lift_gives_the_reason(api: TestClient, model: str, settings: Settings) -> None:
    lift = post(api, model, make_dataset(api)["id"])
    store = Store(settings)
    helper = lift_chunks.join(lift["id"], lease_seconds=60)
    lift_chunks.fail(store, helper, "dataset_not_found", "gone")
    store.close()
    found = api.get(f"/lifts/{lift['id']}").json()
    assert (found["status"], found["error"]["code"]) == ("failed", "dataset_not_found")
    problem(api.get(f"/lifts/{lift['id']}/result"), 409, "conflict")
    problem(api.post(f"/lifts/{lift['id']}/cancel"), 409, "conflict")


@pytest.fixture(scope="module")
def lifted(live: Live, fitted: dict[str, Any]) -> dict[str, Any]:
    """Lift what was fitted, by the worker; follow it to its end."""
    body = {"model_id": fitted["model_id"], "dataset_id": fitted["dataset_id"]}
    made = live.http.post("/lifts", json=body)
    assert made.status_code == 202, made.text
    heard = list(job_events(live, f"/lifts/{made.json()['id']}"))
    assert [name for name, _, _ in heard] == ["progress"] * (len(heard) - 1) + ["end"]
    numbers = [number for _, number, _ in heard]
    assert numbers == sorted(set(numbers))
    lift: dict[str, Any] = heard[-1][2]
    assert lift == live.get(f"/lifts/{lift['id']}")
    assert lift["status"] == "succeeded", lift["error"]
    assert lift["progress"]["frames_done"] == lift["frames"] == 60
    assert lift["progress"]["chunks_done"] == lift["progress"]["chunks"] == 4
    assert list(job_events(live, f"/lifts/{lift['id']}", after=numbers[-2])) == heard[-1:]
    return lift


def test_the_result_is_what_lift_answers_in_every_format(
    live: Live, lifted: dict[str, Any], capture: SyntheticCapture
) -> None:
    url = f"/lifts/{lifted['id']}/result"
    frames = to_safetensors(frames=capture.keypoints, confidence=capture.confidence)
    here = f"/lift?model={lifted['model_id']}"
    at_once = load(
        live.http.post(f"{here}&format=safetensors", content=frames, headers=BYTES).content
    )
    octets = live.http.get(url, headers={"Accept": "application/octet-stream"})
    assert octets.headers["content-disposition"].endswith('.safetensors"')
    npz = live.http.get(url, headers={"Accept": "application/x-npz"})
    for found in (load(octets.content), dict(np.load(io.BytesIO(npz.content)))):
        assert found.keys() == at_once.keys()
        for name, array in at_once.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_allclose(found[name], array, rtol=1e-4, atol=1e-4)

    lines = live.http.get(url)
    assert lines.headers["content-type"] == "application/x-ndjson"
    assert lines.content == live.http.get(f"{url}?format=jsonl").content
    texts = lines.text.splitlines()
    wanted = live.http.post(here, content=frames, headers=BYTES).json()["frames"]
    assert len(texts) == len(wanted)
    for text, frame in zip(texts, wanted, strict=True):
        assert_same(orjson.loads(text), frame)
    problem(live.http.get(url, headers={"Accept": "application/json"}), 406, "not_acceptable")
    problem(live.http.get(f"{url}?format=json"), 422, "invalid_input", "/format")


def test_a_result_has_as_much_of_its_uncertainty_as_was_asked_for(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture, lifted: dict[str, Any]
) -> None:
    assert lifted["uncertainty"] == "sd"
    frames = to_safetensors(frames=capture.keypoints, confidence=capture.confidence)
    here = f"/lift?model={fitted['model_id']}&format=safetensors"
    for kind in ("off", "full"):
        body = {name: fitted[name] for name in ("model_id", "dataset_id")} | {"uncertainty": kind}
        lift = live.http.post("/lifts", json=body).json()
        assert lift["uncertainty"] == kind
        url = f"/lifts/{lift['id']}"
        list(job_events(live, url))  # until it has ended
        found = load(live.http.get(f"{url}/result?format=safetensors").content)
        query = f"{here}&uncertainty={kind}"
        at_once = load(live.http.post(query, content=frames, headers=BYTES).content)
        assert found.keys() == at_once.keys()
        for name in found.keys() & ARRAYS["full"].keys():
            assert np.isfinite(found[name]).any()
            np.testing.assert_allclose(found[name], at_once[name], rtol=1e-3, atol=1e-5)
        [first, *_] = live.http.get(f"{url}/result").text.splitlines()
        assert ("points3d_modes" in orjson.loads(first)) == (kind == "full")
        assert live.http.delete(url).status_code == 204


@pytest.mark.parametrize("wanted", ["jsonl", "npz", "safetensors"])
def test_results_can_be_resumed(live: Live, lifted: dict[str, Any], wanted: str) -> None:
    assert_can_be_resumed(live, f"/lifts/{lifted['id']}/result?format={wanted}")


def assert_same(found: Any, wanted: Any) -> None:
    if isinstance(wanted, dict):
        assert list(found) == list(wanted)
        for name, value in wanted.items():
            assert_same(found[name], value)
    elif isinstance(wanted, list):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other)
    elif isinstance(wanted, float):
        assert found == pytest.approx(wanted, rel=1e-3, abs=1e-3)
    else:
        assert found == wanted


def test_a_deleted_lift_leaves_nothing(
    live: Live, fitted: dict[str, Any], lifted: dict[str, Any]
) -> None:
    body = {"model_id": fitted["model_id"], "dataset_id": fitted["dataset_id"], "refine": "off"}
    lift = live.http.post("/lifts", json=body).json()
    wait_for(lambda: live.get(f"/lifts/{lift['id']}")["status"] == "succeeded", "the lift")
    folder = live.data_dir / "objects" / "lifts" / lift["id"]
    assert len(list(folder.iterdir())) == 2 * lift["progress"]["chunks"]
    assert live.http.delete(f"/lifts/{lift['id']}").status_code == 204
    assert not list(folder.glob("*"))
    time.sleep(0.5)
    items = live.get(f"/lifts?dataset_id={fitted['dataset_id']}")["items"]
    assert [item["id"] for item in items] == [lifted["id"]]
