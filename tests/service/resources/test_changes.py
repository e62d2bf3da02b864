"""PATCH: names, and the metadata of datasets."""

import pytest
from starlette.testclient import TestClient

from tests.service.conftest import BYTES, JSON, make_dataset, problem


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
            ({"name": "new", "status": "running"}, "/status"),
            ([], ""),
        ):
            problem(api.patch(url, json=body), 422, "invalid_input", pointer)
        problem(api.patch(url, content=b"{", headers=JSON), 400, "malformed_body")
        problem(api.patch(url, content=b"x", headers=BYTES), 415, "unsupported_media_type")
        problem(api.patch(f"{url}x", json={"name": "x"}), 404, "not_found")
        assert api.get(url).json() == before
    problem(api.patch(urls[1], json={"metadata": {}}), 422, "invalid_input", "/metadata")


def test_metadata_of_a_dataset(api: TestClient, urls: list[str]) -> None:
    url = urls[0]
    changed = api.patch(url, json={"metadata": {"day": None, "b": {"c": [1]}}}).json()
    assert changed["metadata"] == {"day": None, "b": {"c": [1]}}
    assert api.patch(url, json={"name": "n"}).json() == changed | {"name": "n"}
    assert api.patch(url, json={"metadata": {}}).json()["metadata"] == {}
    large = api.patch(url, json={"metadata": {"text": "x" * 70_000}})
    problem(large, 422, "invalid_input", "/metadata")


def test_followers_of_a_job_see_its_new_name(api: TestClient, urls: list[str]) -> None:
    for url in urls[1:3]:
        seen = int(api.get(f"{url}/events").text.partition("id: ")[2].split()[0])
        api.patch(url, json={"name": "renamed"})
        after = api.get(f"{url}/events").text
        assert f"id: {seen + 1}" in after
        assert '"renamed"' in after
