"""What is stored can be looked at, with what a key has left of its quota."""

from typing import Any

import orjson
from starlette.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from store import access_keys
from store.database import Store
from store.quotas import Quotas
from tests.service.conftest import BYTES, make_dataset, problem
from tests.service.owner import OwnersClient


def kinds(storage: dict[str, Any]) -> dict[str, tuple[int, int]]:
    return {item["kind"]: (item["count"], item["stored_bytes"]) for item in storage["items"]}


def test_storage_names_what_takes_room(settings: Settings, weights: bytes, tmp_path: Any) -> None:
    own = settings.model_copy(
        update={"data_dir": tmp_path, "database_url": None, "store_url": None}
    )
    with OwnersClient(create_app(own)) as client:
        nothing = client.get("/storage").raise_for_status().json()
        assert (nothing["stored_bytes"], nothing["largest"]) == (0, [])
        assert {name for name, (count, _) in kinds(nothing).items() if count} == set()
        small, large = (make_dataset(client, frames=frames) for frames in (6, 60))
        model = client.post("/models?name=figure", content=weights, headers=BYTES).json()
        fit = client.post("/fits", json={"dataset_id": small["id"]}).raise_for_status().json()

        found = client.get("/storage").json()
        fits, size_of_fit = kinds(found)["fits"]
        assert (fits, size_of_fit > len(orjson.dumps(fit["config"]))) == (1, True)
        assert kinds(found)["datasets"][0] == 2
        sizes = {item["id"]: item["stored_bytes"] for item in found["largest"]}
        assert sizes.keys() == {small["id"], large["id"], model["id"], fit["id"]}
        assert list(sizes.values()) == sorted(sizes.values(), reverse=True)
        assert sizes[large["id"]] > sizes[small["id"]] > 6 * 2 * 16 * 2 * 4
        noted, size_of_audit = kinds(found)["audit"]
        assert noted == 4
        assert found["stored_bytes"] == sum(sizes.values()) + size_of_audit
        assert found["own_bytes"] == found["stored_bytes"]
        assert found["own"] == found["items"]
        assert found["quota_bytes"] is None
        assert len(client.get("/storage?limit=1").json()["largest"]) == 1
        problem(client.get("/storage?limit=0"), 422, "invalid_input", "/limit")


def test_a_key_sees_its_project_its_own_and_its_quota(api: TestClient) -> None:
    store: Store = api.app.state.store  # type: ignore[attr-defined]
    headers = []
    for name, quotas in (("first", Quotas(stored_bytes=100_000)), ("second", Quotas())):
        _, token = access_keys.create(
            store, name=name, project="room", scopes=["read", "write"], quotas=quotas
        )
        headers.append({"Authorization": f"Bearer {token}"})
    api.app.state.keyring.look()  # type: ignore[attr-defined]
    api.headers.update(headers[1])
    try:
        made = make_dataset(api)
    finally:
        del api.headers["Authorization"]
    found = [api.get("/storage", headers=each).json() for each in headers]
    mine, theirs = found
    assert mine["quota_bytes"] == 100_000
    assert theirs["quota_bytes"] is None
    assert mine["stored_bytes"] == theirs["stored_bytes"] == theirs["own_bytes"] > 0
    assert mine["own_bytes"] == 0
    assert [item["id"] for item in mine["largest"]] == [made["id"]]
