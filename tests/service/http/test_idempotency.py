"""A request that is sent twice makes one thing."""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select
from starlette.testclient import TestClient

from service.settings import Settings
from store.database import Store
from store.objects import Objects
from store.records import IdempotencyKey
from tests.client.readers import files
from tests.deployments import on_every_deployment
from tests.service.conftest import BYTES, make_dataset, problem, to_npz

pytestmark = on_every_deployment

FRAMES = np.random.default_rng(0).uniform(0, 900, (3, 2, 16, 2)).astype(np.float32)


def keyed(key: str) -> dict[str, str]:
    return {**BYTES, "Idempotency-Key": key}


def objects(settings: Settings) -> int:
    return len(list(Objects(settings.resolved_store_url).list()))


def test_datasets(api: TestClient, settings: Settings) -> None:
    first = api.post("/datasets", content=to_npz(keypoints=FRAMES), headers=keyed("d1"))
    assert first.status_code == 201
    stored = objects(settings)
    again = api.post("/datasets", content=to_npz(keypoints=FRAMES), headers=keyed("d1"))
    assert (again.status_code, again.json()) == (201, first.json())
    assert again.headers["location"] == first.headers["location"]
    for url, data in (("/datasets", FRAMES + 1), ("/datasets?name=other", FRAMES)):
        other = api.post(url, content=to_npz(keypoints=data), headers=keyed("d1"))
        problem(other, 422, "idempotency_key_reused")
    assert objects(settings) == stored
    fresh = api.post("/datasets", content=to_npz(keypoints=FRAMES), headers=keyed("d2"))
    assert fresh.json()["id"] != first.json()["id"]


def test_a_request_is_the_same_after_an_upgrade(api: TestClient, settings: Settings) -> None:
    """Older versions noted a digest of the body, and the query."""
    data = to_npz(keypoints=FRAMES)
    made = api.post("/datasets?name=old", content=data, headers=keyed("older"))
    store = Store(settings)
    with store.writing() as session:
        found = select(IdempotencyKey).where(IdempotencyKey.key == "older")
        noted = f"{hashlib.sha256(data).hexdigest()}?name=old"
        session.scalars(found).one().fingerprint = noted
    store.close()
    again = api.post("/datasets?name=old", content=data, headers=keyed("older"))
    assert (again.status_code, again.json()) == (201, made.json())
    other = api.post("/datasets?name=new", content=data, headers=keyed("older"))
    problem(other, 422, "idempotency_key_reused")


def test_requests_that_differ_anywhere_are_not_the_same(api: TestClient, tmp_path: Path) -> None:
    """However late they differ, and whichever part of them it is in."""
    data, long = to_npz(keypoints=FRAMES), "n" * 140
    values = files.walk(5).reshape(5, -1)
    table = files.dlc_csv(tmp_path / "table", files.columns(files.NAMES), values).read_bytes()

    def form(file: str, content: bytes, **fields: str) -> dict[str, Any]:
        return {"files": [("files", (file, content))], "data": fields}

    pairs: list[tuple[str, dict[str, Any], str, dict[str, Any]]] = [
        (f"?name={long}a", {"content": data}, f"?name={long}b", {"content": data}),
        ("", form("left.csv", table), "", form("right.csv", table)),
        ("", form("a", data, name=f"{long}a"), "", form("a", data, name=f"{long}b")),
        # What is a field of the first stands at the end of the second's file.
        ("", form("a", data, name="b"), "", form("a", data + b"\0name\0b")),
    ]
    for number, (query, first, other_query, second) in enumerate(pairs):
        key = {"Idempotency-Key": f"differ-{number}"}
        headers = BYTES | key if "content" in first else key
        made = api.post(f"/datasets{query}", headers=headers, **first)
        assert made.status_code == 201, made.text
        again = api.post(f"/datasets{query}", headers=headers, **first)
        assert (again.status_code, again.json()) == (201, made.json())
        other = api.post(f"/datasets{other_query}", headers=headers, **second)
        problem(other, 422, "idempotency_key_reused")


def test_frames(api: TestClient, settings: Settings) -> None:
    dataset = make_dataset(api, frames=1)
    url = f"/datasets/{dataset['id']}/frames"
    full = np.repeat(FRAMES[:1], 400, 0)
    for key, data in (("f1", FRAMES), ("f2", full), ("f3", np.repeat(FRAMES[:1], 96, 0))):
        first = api.post(url, content=to_npz(keypoints=data), headers=keyed(key))
        assert first.status_code == 200
        stored = objects(settings)
        # The last of them fills the dataset: to repeat it is no attempt to overfill it.
        again = api.post(url, content=to_npz(keypoints=data), headers=keyed(key))
        assert (again.status_code, again.json()) == (200, first.json())
        other = api.post(url, content=to_npz(keypoints=data + 1), headers=keyed(key))
        problem(other, 422, "idempotency_key_reused")
        assert objects(settings) == stored
    assert first.json()["frames"] == 500
    elsewhere = make_dataset(api, frames=1)  # keys are unique within one resource
    response = api.post(
        f"/datasets/{elsewhere['id']}/frames", content=to_npz(keypoints=FRAMES), headers=keyed("f1")
    )
    assert response.json()["frames"] == 4


def test_fits(api: TestClient) -> None:
    dataset = make_dataset(api)["id"]

    def post(**config: Any) -> Any:
        body = {"dataset_id": dataset, "config": config}
        return api.post("/fits", json=body, headers={"Idempotency-Key": "k"})

    first = post(seed=1)
    assert (post(seed=1).status_code, post(seed=1).json()) == (202, first.json())
    problem(post(seed=2), 422, "idempotency_key_reused")
    assert len(api.get(f"/fits?dataset_id={dataset}").json()["items"]) == 1
    api.post(f"/fits/{first.json()['id']}/cancel")
    assert post(seed=1).json()["status"] == "cancelled"


def test_models(api: TestClient, settings: Settings, weights: bytes) -> None:
    first = api.post("/models", content=weights, headers=keyed("m"))
    stored = objects(settings)
    assert api.post("/models", content=weights, headers=keyed("m")).json() == first.json()
    renamed = api.post("/models?name=other", content=weights, headers=keyed("m"))
    problem(renamed, 422, "idempotency_key_reused")
    assert objects(settings) == stored


def test_requests_at_the_same_time_make_one_thing(api: TestClient, settings: Settings) -> None:
    data, before = to_npz(keypoints=FRAMES), objects(settings)

    def post(_: int) -> Any:
        return api.post("/datasets", content=data, headers=keyed("race")).json()["id"]

    with ThreadPoolExecutor(6) as pool:
        assert len(set(pool.map(post, range(12)))) == 1
    assert objects(settings) == before + 1


@pytest.mark.usefixtures("unchanged")
def test_keys_have_a_length(api: TestClient) -> None:
    for key in ("", "k" * 201):
        response = api.post("/datasets", content=to_npz(keypoints=FRAMES), headers=keyed(key))
        problem(response, 422, "invalid_input", "/Idempotency-Key")
