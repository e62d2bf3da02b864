"""Keys: every route of the OpenAPI document, for whoever may use it and for whoever may not."""

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import orjson
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from models.capture.synthetic import SyntheticCapture
from store import access_keys
from store.access_keys import SCOPES
from store.database import Store
from store.quotas import Quotas
from tests.service.conftest import CONFIG, JSON, frames_of, problem
from tests.waiting import wait_for

# What a route needs, by the begin of its path or else its method.
NEEDS = {
    "/keys": "admin",
    "/audit": "admin",
    "/webhooks": "webhook",
    "/lift/streams": "read",
    "/lift": "lift",
    "/evaluations": "read",
}
OF_METHODS = {"get": "read", "post": "write", "put": "write", "patch": "write", "delete": "delete"}
WITHOUT_DOCUMENT = [("get", "/docs"), ("get", "/openapi.json"), ("get", "/docs/assets/x.js")]
FRAMES = {"keypoints": [[[[1, 2], [3, 4], [5, 6], [7, 8]]] * 2] * 3}


def needed(method: str, path: str) -> set[str]:
    found = [
        scope for begin, scope in NEEDS.items() if path == begin or path.startswith(f"{begin}/")
    ]
    if found:
        return {found[0]}
    # Answers that have what was stored before, or count it.
    of_one = path.count("/") > 1
    shows = of_one if method in ("post", "put", "patch") else method == "delete" and not of_one
    return {OF_METHODS[method], "read"} if shows else {OF_METHODS[method]}


@pytest.fixture
def stranger(api: TestClient) -> Iterator[TestClient]:
    """Return the client, of whom nothing is known but the key; ask for others' fixtures first."""
    peer = api.app_state.pop("peer")
    try:
        yield api
    finally:
        api.app_state["peer"] = peer


MakeKey = Callable[..., dict[str, str]]


@pytest.fixture
def key(api: TestClient) -> MakeKey:
    """Return what makes a key and returns the header that it is sent in."""

    def make(*scopes: access_keys.Scope, revoked: bool = False, **more: Any) -> dict[str, str]:
        store: Store = api.app.state.store  # type: ignore[attr-defined]
        record, token = access_keys.create(store, name="test", scopes=scopes or SCOPES, **more)
        if revoked:
            access_keys.revoke(store, record.id)
        api.app.state.keyring.look()  # type: ignore[attr-defined]
        return bearer(token)

    return make


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def ask(api: TestClient, method: str, path: str, headers: dict[str, str]) -> Any:
    path = path.replace("{", "").replace("}", "")  # there is no such thing
    return api.request(method, path, headers=headers)


def test_the_page_itself_needs_no_key(stranger: TestClient) -> None:
    assert stranger.get("/").status_code == 200
    assert stranger.head("/").status_code == 200
    assert stranger.get("/page/none.js").status_code == 404
    for method, path in (("post", "/"), ("get", "/page"), ("get", "/fits"), ("get", "/pages")):
        assert stranger.request(method, path).status_code == 401, path


def test_every_route_is_closed_to_who_has_no_key_in_force(
    stranger: TestClient, key: MakeKey
) -> None:
    soon = key(expires_at=time.time() + 0.2)
    all_operations = operations_for(stranger, key)
    revoked = key(revoked=True)
    time.sleep(0.2)
    kinds: tuple[dict[str, str], ...] = (
        {},
        bearer("fewview_" + "x" * 43),
        bearer("not a token"),
        {"Authorization": "Basic Zm9vOmJhcg=="},
        {"Authorization": "Bearer"},
        soon,
        revoked,
    )
    for headers in kinds:
        for method, path in [*all_operations, ("get", "/nothing"), ("post", "/lift/stream/x")]:
            answer = ask(stranger, method, path, headers)
            problem(answer, 401, "unauthorized")
            assert answer.headers["www-authenticate"].startswith("Bearer"), (method, path)


def operations_for(api: TestClient, key: MakeKey) -> list[tuple[str, str]]:
    paths = api.get("/openapi.json", headers=key("read")).json()["paths"]
    known = [(m, path) for path, item in paths.items() for m in item if m in OF_METHODS]
    assert len(known) > 40
    return known + WITHOUT_DOCUMENT


def test_every_route_needs_its_scope(stranger: TestClient, key: MakeKey) -> None:
    everything = operations_for(stranger, key)
    alone: list[tuple[access_keys.Scope, ...]] = [(scope,) for scope in SCOPES]
    for scopes in (*alone, ("read", "write"), ("read", "delete")):
        headers = key(*scopes)
        for method, path in everything:
            answer = ask(stranger, method, path, headers)
            missing = needed(method, path) - {*scopes}
            if missing:
                detail = problem(answer, 403, "forbidden")
                assert any(f"scope {one}" in detail for one in missing), (scopes, method, path)
            else:
                assert answer.status_code not in (401, 403), (scopes, method, path)
                assert answer.status_code < 500, (scopes, method, path, answer.text)


def test_a_stream_is_opened_with_a_key_alone(
    model: str, stranger: TestClient, key: MakeKey
) -> None:
    def opens(headers: dict[str, str], *subprotocols: str) -> str | None:
        with stranger.websocket_connect(
            "/lift/stream", headers=headers, subprotocols=list(subprotocols)
        ) as stream:
            stream.send_text(orjson.dumps({"model": model}).decode())
            assert stream.receive_json()["type"] == "ready"
            return stream.accepted_subprotocol

    headers = key("lift")
    token = headers["Authorization"].removeprefix("Bearer ")
    assert opens(headers) is None
    assert opens({}, "fewview", f"bearer.{token}") == "fewview"
    for refused, status in (({}, 401), (key("read"), 403), (key("lift", revoked=True), 401)):
        with pytest.raises(WebSocketDenialResponse) as denied:
            opens(refused)
        assert denied.value.status_code == status
    with pytest.raises(WebSocketDenialResponse):
        opens({}, "fewview", "bearer.fewview_unknown")


class Things(NamedTuple):
    """What is in the default project, by the parameters of paths."""

    dataset_id: str
    fit_id: str
    lift_id: str
    model_id: str
    stream_id: str


@pytest.fixture
def things(api: TestClient, model: str, capture: SyntheticCapture) -> Iterator[Things]:
    body = {"keypoints": frames_of(capture.keypoints[:8])}
    dataset = api.post("/datasets", content=orjson.dumps(body), headers=JSON).json()["id"]
    fit = api.post("/fits", json={"dataset_id": dataset, "config": CONFIG}).json()["id"]
    lift = api.post("/lifts", json={"dataset_id": dataset, "model_id": model}).json()["id"]
    for kind, identifier in (("fits", fit), ("lifts", lift)):
        api.post(f"/{kind}/{identifier}/cancel")
    with api.websocket_connect("/lift/stream") as stream:
        stream.send_text(orjson.dumps({"model": model}).decode())
        (open_stream,) = wait_for(lambda: api.get("/lift/streams").json()["items"], "the stream")
        yield Things(dataset, fit, lift, model, open_stream["id"])


def test_a_stream_is_watched_with_a_key_that_reads(
    things: Things, stranger: TestClient, key: MakeKey
) -> None:
    watch = f"/lift/streams/{things.stream_id}/watch"
    with stranger.websocket_connect(watch, headers=key("read")) as watched:
        assert watched.receive_json()["id"] == things.stream_id
    for refused, status in (({}, 401), (key("lift"), 403), (key("read", revoked=True), 401)):
        with (
            pytest.raises(WebSocketDenialResponse) as denied,
            stranger.websocket_connect(watch, headers=refused),
        ):
            pass
        assert denied.value.status_code == status


BODIES: dict[tuple[str, str], dict[str, Any]] = {
    ("post", "/datasets/{dataset_id}/frames"): {"json": FRAMES},
    ("patch", "/datasets/{dataset_id}/corrections"): {"json": {"correct": []}},
    ("patch", ""): {"json": {"name": "mine"}},
    ("put", ""): {"json": {"model_id": "mdl_none"}},
}


def test_another_project_sees_nothing(things: Things, stranger: TestClient, key: MakeKey) -> None:
    other = key(project="other")
    for method, path in operations_for(stranger, key):
        if "{" not in path or "key_id" in path or "webhook_id" in path:
            continue
        url = path.format(**things._asdict())
        body = BODIES.get((method, path)) or BODIES.get((method, ""), {})
        answer = stranger.request(method, url, headers=other, **body)
        problem(answer, 404, "not_found")
    assert stranger.get("/lift/streams", headers=other).json()["items"] == []
    watch = f"/lift/streams/{things.stream_id}/watch"
    with stranger.websocket_connect(watch, headers=other) as watched:
        assert watched.receive_json()["code"] == "not_found"
    for kind in ("datasets", "fits", "lifts", "models"):
        assert stranger.get(f"/{kind}", headers=other).json()["items"] == []
        found = stranger.delete(
            f"/{kind}?id={things.dataset_id}&dry_run=true", headers=other
        ).json()["found"]
        assert found == 0
    assert stranger.get(f"/datasets/{things.dataset_id}", headers=key("read")).status_code == 200


def test_another_project_uses_nothing(
    things: Things, stranger: TestClient, key: MakeKey, capture: SyntheticCapture
) -> None:
    other = key(project="other")
    frames = {"model": things.model_id, "frames": frames_of(capture.keypoints[:1])}
    assert stranger.post("/lift", json=frames, headers=key("lift")).status_code == 200  # warm
    problem(stranger.post("/lift", json=frames, headers=other), 404, "not_found")
    of_default = {"dataset_id": things.dataset_id}
    mine = {"dataset_id": stranger.post("/datasets", json=FRAMES, headers=other).json()["id"]}
    for url, body in (
        ("/fits", of_default),
        ("/fits", mine | {"from_model": things.model_id}),
        ("/lifts", of_default | {"model_id": things.model_id}),
        ("/lifts", mine | {"model_id": things.model_id}),
        ("/evaluations", {"fit_id": things.fit_id, "truth": [[[0, 0, 0]] * 4]}),
    ):
        problem(stranger.post(url, json=body, headers=other), 404, "not_found")
    with stranger.websocket_connect("/lift/stream", headers=other) as stream:
        stream.send_text(orjson.dumps({"model": things.model_id}).decode())
        assert stream.receive_json()["code"] == "not_found"


def test_idempotency_keys_are_of_a_project(stranger: TestClient, key: MakeKey) -> None:
    twice = {"Idempotency-Key": "the same"}
    first, second = key(project="one"), key(project="two")
    ids = [
        stranger.post("/datasets", json=FRAMES, headers=headers | twice).json()["id"]
        for headers in (first, second, first, second)
    ]
    assert ids[:2] == ids[2:]
    assert ids[0] != ids[1]


def test_keys_are_made_and_revoked_over_http(stranger: TestClient, key: MakeKey) -> None:
    admin = key("admin")
    asked = {"name": "laptop", "scopes": ["lift", "read"], "project": "gait"}
    answer = stranger.post("/keys", json=asked, headers=admin)
    assert answer.status_code == 201
    made = answer.json()
    assert made["scopes"] == ["read", "lift"]
    assert answer.headers["cache-control"] == "no-store"
    new = bearer(made["token"])
    assert stranger.get("/datasets", headers=new).json()["items"] == []
    described = stranger.get(answer.headers["location"], headers=admin).json()
    assert described == {name: value for name, value in made.items() if name != "token"}
    listed = stranger.get("/keys", headers=admin)
    assert listed.json()["items"][0] == described
    assert made["token"] not in listed.text
    assert stranger.delete(f"/keys/{made['id']}", headers=admin).status_code == 204
    problem(stranger.get("/datasets", headers=new), 401, "unauthorized")
    assert stranger.get(f"/keys/{made['id']}", headers=admin).json()["revoked_at"] is not None
    problem(stranger.delete("/keys/key_none", headers=admin), 404, "not_found")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("scopes", []),
        ("scopes", ["everything"]),
        ("project", "Not a word"),
        ("expires_at", "2020-01-01"),
        ("quotas", {"requests_per_second": 0}),
        ("quotas", {"queued_jobs": False}),
        ("name", ""),
    ],
)
def test_keys_that_cannot_be(api: TestClient, field: str, value: Any) -> None:
    asked = {"name": "laptop", "scopes": ["lift"], field: value}
    answer = api.post("/keys", json=asked)
    problem(answer, 422, "invalid_input")
    assert answer.json()["errors"][0]["pointer"].startswith(f"/{field}")


def test_a_key_takes_no_more_than_its_quotas(
    things: Things, stranger: TestClient, key: MakeKey, capture: SyntheticCapture
) -> None:
    few = key(project="few", quotas=Quotas(requests_per_second=2))
    answers = [stranger.get("/datasets", headers=few) for _ in range(8)]
    refused = [answer for answer in answers if answer.status_code != 200]
    assert answers[0].status_code == 200
    assert refused
    problem(refused[0], 429, "quota_exceeded")
    assert int(refused[0].headers["retry-after"]) >= 1
    assert refused[0].headers["ratelimit-policy"] == '"requests";q=2;w=1'

    slow = key(quotas=Quotas(lifted_frames_per_second=5))
    frames = {"model": things.model_id, "frames": frames_of(capture.keypoints[:6])}
    assert "5 at most" in problem(
        stranger.post("/lift", json=frames, headers=slow), 429, "quota_exceeded"
    )
    frames["frames"] = frames_of(capture.keypoints[:4])
    assert stranger.post("/lift", json=frames, headers=slow).status_code == 200
    with stranger.websocket_connect("/lift/stream", headers=slow) as stream:
        stream.send_text(orjson.dumps({"model": things.model_id}).decode())
        assert stream.receive_json()["type"] == "ready"
        message = []
        for sequence in range(8):
            frame = {"sequence": sequence, "keypoints": frames["frames"][0]}
            stream.send_text(orjson.dumps(frame).decode())
            message.append(stream.receive_json())
    assert "quota_exceeded" in [answer.get("code") for answer in message]

    small = key(project="small", quotas=Quotas(stored_bytes=8000, queued_jobs=1))
    one = stranger.post("/datasets", json=FRAMES, headers=small)
    assert one.status_code == 201
    fit = {"dataset_id": one.json()["id"], "config": CONFIG}
    queued = stranger.post("/fits", json=fit, headers=small)
    assert queued.status_code == 202
    problem(stranger.post("/fits", json=fit, headers=small), 429, "quota_exceeded")
    stranger.post(f"/fits/{queued.json()['id']}/cancel", headers=small)
    hurried = key(quotas=Quotas(queued_jobs=1))
    lift = {"model_id": things.model_id, "dataset_id": things.dataset_id}
    waiting = stranger.post("/lifts", json=lift, headers=hurried)
    assert waiting.status_code == 202
    problem(stranger.post("/lifts", json=lift, headers=hurried), 429, "quota_exceeded")
    stranger.post(f"/lifts/{waiting.json()['id']}/cancel", headers=hurried)
    large = {"keypoints": FRAMES["keypoints"] * 40}
    problem(stranger.post("/datasets", json=large, headers=small), 429, "quota_exceeded")
    more = f"/datasets/{one.json()['id']}/frames"
    problem(stranger.post(more, json=large, headers=small), 429, "quota_exceeded")
    where, metadata = f"/datasets/{one.json()['id']}", {"metadata": {"log": "x" * 8000}}
    assert stranger.get(where, headers=small).json()["frames"] == 3
    full = stranger.patch(where, json=metadata, headers=small)
    assert "1 datasets with" in problem(full, 429, "quota_exceeded")


def test_changes_are_in_the_audit(stranger: TestClient, key: MakeKey) -> None:
    mine, admin = key("read", "write", "delete", project="noted"), key("admin")
    named = mine | {"X-Request-Id": "of-this-test"}
    dataset = stranger.post("/datasets", json=FRAMES, headers=named).json()["id"]
    later = stranger.post(f"/datasets/{dataset}/frames", json=FRAMES, headers=mine)
    assert later.status_code == 200
    stranger.patch(f"/datasets/{dataset}", json={"name": "x"}, headers=mine)
    fit = {"dataset_id": dataset, "config": CONFIG}
    fit_id = stranger.post("/fits", json=fit, headers=mine).json()["id"]
    stranger.post(f"/fits/{fit_id}/cancel", headers=mine)
    stranger.delete(f"/fits/{fit_id}", headers=mine)
    stranger.delete(f"/datasets/{dataset}", headers=mine)
    stranger.get("/datasets", headers=mine)  # which changes nothing

    def noted(target: str) -> list[dict[str, Any]]:
        found = stranger.get(f"/audit?target={target}", headers=admin).json()["items"]
        return list(reversed(found))

    of_dataset = noted(dataset)
    assert [entry["action"] for entry in of_dataset] == [
        "dataset.create",
        "dataset.append",
        "dataset.change",
        "dataset.delete",
    ]
    assert [entry["action"] for entry in noted(fit_id)] == [
        "fit.create",
        "fit.cancel",
        "fit.delete",
    ]
    assert of_dataset[0]["request_id"] == "of-this-test"
    assert {entry["project"] for entry in of_dataset} == {"noted"}
    by = of_dataset[0]["key_id"]
    assert len(stranger.get(f"/audit?key_id={by}&limit=3", headers=admin).json()["items"]) == 3


def test_a_refused_change_is_not_in_the_audit(api: TestClient) -> None:
    before = api.get("/audit").json()["items"][:1]
    problem(api.post("/fits", json={"dataset_id": "ds_none"}), 404, "not_found")
    problem(api.delete("/models/mdl_none"), 404, "not_found")
    assert api.get("/audit").json()["items"][:1] == before


def test_what_comes_through_a_proxy_is_not_the_owners(api: TestClient) -> None:
    for header in ("X-Forwarded-For", "Forwarded"):
        problem(api.get("/datasets", headers={header: "for=192.0.2.1"}), 401, "unauthorized")
    assert api.get("/datasets").status_code == 200
