"""Lists: filtered and continued alike for all that is stored."""

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import pytest
from starlette.testclient import TestClient

from tests.service.conftest import BYTES, make_dataset, problem

KINDS = ("datasets", "fits", "models", "lifts")


@pytest.fixture
def make(api: TestClient, model: str, weights: bytes) -> Callable[[str, str], dict[str, Any]]:
    """Make something of a kind with this name; fits and lifts are cancelled at once."""
    bodies = {"fits": {}, "lifts": {"model_id": model}}

    def make(kind: str, name: str) -> dict[str, Any]:
        if kind == "datasets":
            return make_dataset(api, frames=1, name=name)
        if kind == "models":
            made = api.post("/models", params={"name": name}, content=weights, headers=BYTES)
        else:
            dataset = make_dataset(api, frames=1)["id"]
            made = api.post(f"/{kind}", json={"dataset_id": dataset, "name": name} | bodies[kind])
            made = api.post(f"{made.headers['Location']}/cancel")
        assert made.is_success, made.text
        found: dict[str, Any] = made.json()
        return found

    return make


def identifiers(api: TestClient, kind: str, **query: Any) -> list[str]:
    response = api.get(f"/{kind}", params=query)
    assert response.status_code == 200, response.text
    return [item["id"] for item in response.json()["items"]]


@pytest.mark.parametrize("kind", KINDS)
def test_filters_and_the_cursor_work_together(
    api: TestClient, make: Callable[[str, str], dict[str, Any]], kind: str
) -> None:
    made = [make(kind, name) for name in ("a & b", "other", "a & b", "a & b", "a & b")]
    a0, other, a1, a2, a3 = (item["id"] for item in made)
    times = [item["created_at"] for item in made]

    assert identifiers(api, kind, name="a & b") == [a3, a2, a1, a0]
    assert identifiers(api, kind, name="a") == []
    # A moment is written as the resource has it, and excludes what was made then.
    between = {"created_after": times[0], "created_before": times[3]}
    assert identifiers(api, kind, **between) == [a1, other]
    assert identifiers(api, kind, **between, name="a & b") == [a1]

    since = {"name": "a & b", "created_after": times[0]}
    page = api.get(f"/{kind}", params={**since, "limit": 2}).json()
    assert [item["id"] for item in page["items"]] == [a3, a2]
    rest = api.get(f"/{kind}", params={**since, "limit": 2, "cursor": page["next_cursor"]}).json()
    assert [item["id"] for item in rest["items"]] == [a1]
    assert rest["next_cursor"] is None

    if kind in ("fits", "lifts"):
        assert identifiers(api, kind, name="a & b", status="cancelled") == [a3, a2, a1, a0]
        assert identifiers(api, kind, name="a & b", status="running") == []


def test_moments_have_a_zone_or_are_utc(api: TestClient) -> None:
    made = make_dataset(api, frames=1, name="zones")
    moment = datetime.fromisoformat(made["created_at"]) + timedelta(minutes=1)
    offset = (moment + timedelta(hours=2)).replace(tzinfo=None).isoformat() + "+02:00"
    naive = moment.replace(tzinfo=None).isoformat()
    for text in (moment.isoformat(), offset, naive, "9999-12-31T23:59:59.999999-12:00"):
        assert identifiers(api, "datasets", name="zones", created_before=text) == [made["id"]]
        assert identifiers(api, "datasets", name="zones", created_after=text) == []
    for text in ("yesterday", "2026-13-01T00:00:00Z", ""):
        for name in ("created_after", "created_before"):
            refused = api.get("/datasets", params={name: text})
            problem(refused, 422, "invalid_input", f"/{name}")
    problem(api.get("/models", params={"name": ""}), 422, "invalid_input", "/name")


def test_lists_of_models_show_no_training_curves(api: TestClient, model: str) -> None:
    shown = api.get(f"/models/{model}").json()
    assert shown.pop("training_curve")
    assert shown in api.get("/models?limit=200").json()["items"]
