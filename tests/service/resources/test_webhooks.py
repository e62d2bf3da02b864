"""Webhooks over HTTP: made with a permission alone, their secret shown once, of a project."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from store import access_keys
from store.access_keys import Scope
from store.database import Store
from store.webhooks import EVENTS
from tests.service.conftest import make_dataset, problem

URL = "https://lab.example/fewview?a=b"


def made(api: TestClient, **asked: Any) -> dict[str, Any]:
    answer = api.post("/webhooks", json={"url": URL, **asked})
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    found: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/webhooks/{found['id']}"
    return found


def test_a_webhook_is_made_listed_and_deleted_and_its_secret_shown_once(api: TestClient) -> None:
    webhook = made(api, events=["fit.cancelled"])
    secret = webhook.pop("secret")
    assert secret.startswith("whsec_")
    url = f"/webhooks/{webhook['id']}"
    for answer in (api.get(url), api.get("/webhooks")):
        assert secret not in answer.text
    assert api.get(url).json() == webhook
    assert webhook in api.get("/webhooks?limit=1").json()["items"]
    assert made(api)["events"] == list(EVENTS)

    fit = api.post("/fits", json={"dataset_id": make_dataset(api)["id"]}).json()["id"]
    assert api.get(f"{url}/deliveries").json()["items"] == []
    api.post(f"/fits/{fit}/cancel")
    (waiting,) = api.get(f"{url}/deliveries").json()["items"]  # there is no worker
    assert (waiting["event"], waiting["attempts"]) == ("fit.cancelled", 0)
    assert waiting["next_attempt_at"] is not None

    for item in api.get("/webhooks").json()["items"]:
        assert api.delete(f"/webhooks/{item['id']}").status_code == 204
    for answer in (api.get(url), api.delete(url), api.get(f"{url}/deliveries")):
        problem(answer, 404, "not_found")
    noted = api.get(f"/audit?target={webhook['id']}").json()["items"]
    assert [entry["action"] for entry in noted] == ["webhook.delete", "webhook.create"]
    assert secret not in str(noted)


def test_webhooks_need_a_permission_and_are_of_a_project(api: TestClient) -> None:
    store: Store = api.app.state.store  # type: ignore[attr-defined]

    def key(*scopes: Scope, project: str = "default") -> dict[str, str]:
        _, token = access_keys.create(store, name="w", scopes=scopes, project=project)
        api.app.state.keyring.look()  # type: ignore[attr-defined]
        return {"Authorization": f"Bearer {token}"}

    webhook = made(api)["id"]
    every_other = key("read", "lift", "write", "delete", "admin")
    theirs = key("webhook", project="theirs")
    peer = api.app_state.pop("peer")
    try:
        for method, url in (("POST", ""), ("GET", ""), ("DELETE", f"/{webhook}")):
            answer = api.request(method, f"/webhooks{url}", headers=every_other)
            problem(answer, 403, "forbidden")
        assert api.get("/webhooks", headers=theirs).json()["items"] == []
        for method in ("GET", "DELETE"):
            answer = api.request(method, f"/webhooks/{webhook}", headers=theirs)
            problem(answer, 404, "not_found")
        assert api.post("/webhooks", json={"url": URL}, headers=theirs).status_code == 201
    finally:
        api.app_state["peer"] = peer
    assert api.delete(f"/webhooks/{webhook}").status_code == 204


@pytest.mark.parametrize(
    "url",
    [
        "http://lab.example/",
        "ftp://lab.example/",
        "https://",
        "lab.example",
        "https://127.0.0.1/",
        "https://localhost/",
        "https://[::1]:8000/",
        "https://169.254.169.254/latest",
        "https://user:pass@lab.example/",
        "https://lab.example:99999/",
        "https://lab.example/a b",
        "https://lab.example/\r\nX: y",
        "https://[half/",
        "https://lab.example/" + "x" * 2000,
        7,
    ],
)
def test_urls_that_nothing_would_be_sent_to_are_refused(api: TestClient, url: Any) -> None:
    before = api.get("/webhooks").json()
    problem(api.post("/webhooks", json={"url": url}), 422, "invalid_input", "/url")
    assert api.get("/webhooks").json() == before


@pytest.mark.parametrize("events", [[], ["fit.started"], "fit.failed", None])
def test_events_that_there_are_not(api: TestClient, events: Any) -> None:
    answer = api.post("/webhooks", json={"url": URL, "events": events})
    problem(answer, 422, "invalid_input")
    assert answer.json()["errors"][0]["pointer"].startswith("/events")
