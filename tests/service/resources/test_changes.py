"""PATCH: names, tags, metadata, and what is known of a dataset."""

import io
import json
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from store import lookup
from store.database import Store
from store.records import DatasetRecord, FitRecord, LiftRecord, ModelRecord
from tests.deployments import on_every_deployment
from tests.service.conftest import BYTES, JSON, make_dataset, problem

pytestmark = on_every_deployment

KINDS: dict[str, Any] = {
    kind.noun: kind for kind in (DatasetRecord, FitRecord, LiftRecord, ModelRecord)
}


@pytest.fixture
def urls(api: TestClient, model: str, weights: bytes) -> list[str]:
    """Return a dataset, a fit, a lift and a model, the jobs cancelled."""
    dataset = make_dataset(api, frames=1, metadata={"subject": "M7", "day": None})["id"]
    made = [f"/datasets/{dataset}"]
    for kind, body in (("fits", {}), ("lifts", {"model_id": model})):
        job = api.post(f"/{kind}", json={"dataset_id": dataset, **body})
        made.append(job.headers["Location"])
        api.post(f"{made[-1]}/cancel")
    made.append(api.post("/models", content=weights, headers=BYTES).headers["Location"])
    return made


def test_a_name_changes_and_nothing_else(api: TestClient, urls: list[str]) -> None:
    for url in urls:
        before = api.get(url).json()
        for name in ("an ä", "b" * 200):
            changed = api.patch(url, json={"name": name})
            assert changed.status_code == 200, changed.text
            assert changed.json() == before | {"name": name} == api.get(url).json()
        for nothing in ({}, {"name": None}):
            assert api.patch(url, json=nothing).json()["name"] == "b" * 200


def test_what_cannot_be_changed_is_refused(api: TestClient, urls: list[str]) -> None:
    for url in urls:
        before = api.get(url).json()
        for body, pointer in (
            ({"name": ""}, "/name"),
            ({"name": "n" * 201}, "/name"),
            ({"name": 5}, "/name"),
            ({"nam": "x"}, "/nam"),
            ({"tags": ["a"] * 33}, "/tags"),
            ({"tags": ["t" * 65]}, "/tags/0"),
            ({"tags": ["a", " b"]}, "/tags/1"),
            ({"tags": ["a\nb"]}, "/tags/0"),
            ({"tags": "a"}, "/tags"),
            ({"metadata": {"text": "x" * 70_000}}, "/metadata"),
            ({"name": "new", "status": "running"}, "/status"),
            ([], ""),
        ):
            problem(api.patch(url, json=body), 422, "invalid_input", pointer)
        problem(api.patch(url, content=b"{", headers=JSON), 400, "malformed_body")
        problem(api.patch(url, content=b"x", headers=BYTES), 415, "unsupported_media_type")
        problem(api.patch(f"{url}x", json={"name": "x"}), 404, "not_found")
        assert api.get(url).json() == before


def test_tags_and_metadata_are_replaced(api: TestClient, urls: list[str]) -> None:
    for url in urls:
        fields = {"tags": ["pilot", "left hand"], "metadata": {"day": None, "b": {"c": [1]}}}
        changed = api.patch(url, json=fields | {"tags": ["pilot", "left hand", "pilot"]}).json()
        assert {key: changed[key] for key in fields} == fields
        assert api.patch(url, json={"name": "n"}).json() == changed | {"name": "n"}
        assert api.patch(url, json={"tags": ["ä"], "metadata": None}).json()["tags"] == ["ä"]
        emptied = api.patch(url, json={"tags": [], "metadata": {}}).json()
        assert emptied == api.get(url).json() == changed | {"name": "n", "tags": [], "metadata": {}}


def test_new_things_can_have_them(api: TestClient, model: str, weights: bytes) -> None:
    fields: dict[str, Any] = {"tags": ["pilot"], "metadata": {"subject": "M7"}}
    dataset = make_dataset(api, frames=1, **fields)
    fit = api.post("/fits", json={"dataset_id": dataset["id"], **fields})
    lift = api.post("/lifts", json={"dataset_id": dataset["id"], "model_id": model, **fields})
    form = {key: json.dumps(value) for key, value in fields.items()}
    copy = api.post("/models", data=form, files={"file": ("w", weights)})
    assert api.delete(copy.headers["Location"]).status_code == 204
    for made in (dataset, fit.json(), lift.json(), copy.json()):
        assert {key: made[key] for key in fields} == fields
    for job in (fit, lift):
        assert api.post(f"{job.headers['Location']}/cancel").json()["tags"] == ["pilot"]
    wrong = api.post("/fits", json={"dataset_id": dataset["id"], "tags": [""]})
    problem(wrong, 422, "invalid_input", "/tags/0")


def test_followers_of_a_job_see_its_new_name(api: TestClient, urls: list[str]) -> None:
    for url in urls[1:3]:
        seen = int(api.get(f"{url}/events").text.partition("id: ")[2].split()[0])
        api.patch(url, json={"name": "renamed"})
        after = api.get(f"{url}/events").text
        assert f"id: {seen + 1}" in after
        assert '"renamed"' in after


def test_a_stale_tag_changes_nothing(api: TestClient, urls: list[str]) -> None:
    for url in urls:
        tag = api.get(url).headers["etag"]
        assert api.get(url, headers={"If-None-Match": tag}).status_code == 304
        assert api.get(url, headers={"If-None-Match": '"other"'}).status_code == 200
        changed = api.patch(url, json={"name": "first"}, headers={"If-Match": tag})
        assert changed.headers["etag"] == api.get(url).headers["etag"] != tag
        stale = api.patch(url, json={"name": "second"}, headers={"If-Match": f'"x", {tag}'})
        problem(stale, 412, "precondition_failed")
        assert api.get(url).json()["name"] == "first"
        for fresh in (changed.headers["etag"], "*"):
            kept = api.patch(url, json={"name": "third"}, headers={"If-Match": fresh})
            assert kept.status_code == 200, kept.text


def test_what_is_known_of_a_dataset_can_be_given_later(api: TestClient) -> None:
    facts: dict[str, Any] = {
        "skeleton": {"keypoint_names": [f"k{k}" for k in range(16)], "edges": [[0, 1], [1, 15]]},
        "view_names": ["left", "right"],
        "image_sizes": [[2000, 2000], None],
        "fps": 50.0,
    }
    at_once = make_dataset(api, frames=40, **facts)
    later = make_dataset(api, frames=40)
    url = f"/datasets/{later['id']}"
    changed = api.patch(url, json=facts | {"name": "n"}).json()
    own = {"id", "created_at", "name"}
    assert {k: v for k, v in changed.items() if k not in own} == {
        k: v for k, v in at_once.items() if k not in own
    }
    assert changed == api.get(url).json()
    with np.load(io.BytesIO(api.get(f"{url}/capture").content)) as file:
        assert file["edges"].tolist() == facts["skeleton"]["edges"]
        assert file["fps"] == 50
    removed = api.patch(url, json=dict.fromkeys(facts)).json()
    assert removed == later | {"name": "n"}


def test_what_a_dataset_cannot_be_is_refused(api: TestClient) -> None:
    times = [k / 50 for k in range(6)]
    url = f"/datasets/{make_dataset(api, times=times)['id']}"
    before = api.get(url).json()
    for body, pointer in (
        ({"fps": 0}, "/fps"),
        ({"fps": 30}, "/fps"),
        ({"image_sizes": [[640, 480]]}, "/image_sizes"),
        ({"image_sizes": [[0, 480], None]}, "/image_sizes/0/0"),
        ({"view_names": ["one"]}, "/view_names"),
        ({"skeleton": {"keypoint_names": ["a"]}}, "/skeleton/keypoint_names"),
        ({"skeleton": {"keypoint_names": ["a"] * 16}}, "/skeleton/keypoint_names"),
        ({"skeleton": {"edges": [[0, 1], [3, 16]]}}, "/skeleton/edges/1"),
        ({"skeleton": {"edge": []}}, "/skeleton/edge"),
    ):
        problem(api.patch(url, json=body), 422, "invalid_input", pointer)
    assert api.get(url).json() == before


def test_nothing_is_changed_that_has_changed_since_it_was_read(
    api: TestClient, urls: list[str]
) -> None:
    """By any operation on a record that has an ETag: those of the OpenAPI document."""
    paths = api.get("/openapi.json").json()["paths"]
    of_kind = dict(zip(("dataset_id", "fit_id", "lift_id", "model_id"), urls, strict=True))
    stale = {"If-Match": '"of yesterday"'}
    alias = f"/models/new@{urls[3][-6:]}"
    seen = 0
    for path, operations in paths.items():
        kind = next((name for name in of_kind if f"{{{name}}}" in path), None)
        for method in operations.keys() & {"post", "put", "patch", "delete"}:
            if kind is None:
                continue
            url = path.replace(f"/{kind[:-3]}s/{{{kind}}}", of_kind[kind])
            before = api.get(of_kind[kind]).json()
            body: dict[str, Any] = {"keypoints": [[[[1, 2]] * 16] * 2]}
            if path.endswith("/corrections"):
                body = {"correct": [{"frame": 0, "view": 0, "keypoint": 0, "position": None}]}
            elif method == "patch":
                body = {"name": "new"}
            elif method == "put":
                url, body = alias, {"model_id": urls[3][8:]}
            given: dict[str, Any] = {} if method == "delete" else {"json": body}
            refused = api.request(method, url, headers=stale, **given)
            problem(refused, 412, "precondition_failed")
            assert api.get(of_kind[kind]).json() == before
            parameters = [each["name"] for each in operations[method]["parameters"]]
            assert "if-match" in parameters
            assert "412" in operations[method]["responses"]
            seen += 1
    assert seen >= 12
    assert api.get(alias).status_code == 404
    for url in (*urls[1:], urls[0]):
        tag = {"If-Match": api.get(url).headers["etag"]}
        assert api.delete(url, headers=tag).status_code == 204
        problem(api.delete(url, headers=tag), 404, "not_found")


def test_what_changes_while_a_request_waits_for_the_records_is_compared(
    api: TestClient, urls: list[str], model: str
) -> None:
    """Who asked first holds the record; who comes with the tag of before then waits for it."""
    store: Store = api.app.state.store  # type: ignore[attr-defined]
    alias = f"/models/race@{urls[3][-6:]}"
    assert api.put(alias, json={"model_id": urls[3][8:]}).status_code == 200
    frames = {"keypoints": [[[[1, 2]] * 16] * 2]}
    races: list[tuple[str, str, Any, str]] = [("DELETE", url, None, url) for url in urls]
    races += [("PATCH", url, {"name": "late"}, url) for url in urls]
    races += [("POST", f"{url}/cancel", None, url) for url in urls[1:3]]
    races += [("POST", f"{urls[0]}/frames", frames, urls[0]), ("DELETE", alias, None, urls[3])]
    races += [("PUT", alias, {"model_id": model}, urls[3])]
    for number, (method, url, body, changed) in enumerate(races):
        kind, identifier = KINDS[changed.split("/")[1][:-1]], changed.split("/")[2]
        tag = {"If-Match": api.get(changed).headers["etag"]}
        with ThreadPoolExecutor(1) as one, store.writing() as session:
            record = lookup.lock(session, kind, identifier)
            late = one.submit(api.request, method, url, json=body, headers=tag)
            time.sleep(0.1)  # it comes as far as the lock; if it did not, it would be refused too
            lookup.put(session, record, {"name": f"first {number}"})
            session.commit()
            problem(late.result(), 412, "precondition_failed")
        assert api.get(changed).json()["name"] == f"first {number}"
    assert api.get(f"{urls[0]}").json()["frames"] == 1
    assert api.get(alias).json()["id"] == urls[3][8:]
    for url in (*urls, alias):
        too_long = {"If-Match": f'"{"x" * 1000}"'}
        problem(api.delete(url, headers=too_long), 422, "invalid_input", "/if-match")
    assert api.delete(alias, headers={"If-Match": tag["If-Match"]}).status_code == 412
    fresh = {"If-Match": api.get(alias).headers["etag"]}
    assert api.put(alias, json={"model_id": model}, headers=fresh).status_code == 200
    assert api.delete(alias, headers={"If-Match": "*"}).status_code == 204
