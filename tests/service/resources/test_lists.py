"""Lists: filtered and continued alike for all that is stored."""

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient

from tests.deployments import on_every_deployment
from tests.service.conftest import BYTES, make_dataset, problem

pytestmark = on_every_deployment

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


@pytest.mark.parametrize("kind", KINDS)
def test_words_are_searched_in_names_and_tags(
    api: TestClient, make: Callable[[str, str], dict[str, Any]], kind: str
) -> None:
    walk, run, odd = (make(kind, name)["id"] for name in ("Quern: Walk 3", "quern run", "100%_\\"))
    assert api.patch(f"/{kind}/{run}", json={"tags": ["Xylem day", "Zq7"]}).status_code == 200
    for search, expected in (
        ("quern", [run, walk]),
        ("QUERN 3", [walk]),
        ("3 quern walk", [walk]),
        ("yle", [run]),
        ("zq7 RUN", [run]),
        ("walk zq7", []),
        ("%_\\", [odd]),
        ("quern%", []),
        ("qu_rn", []),
        ("'; drop table fits --", []),
    ):
        assert identifiers(api, kind, search=search) == expected, search
    assert identifiers(api, kind, search="quern", tag="Zq7") == [run]
    found = api.delete(f"/{kind}", params={"search": "quern", "dry_run": True}).json()
    assert found["found"] == 2
    for search in ("", "a" * 201, "a\0b", " ".join("abcdefghi")):
        for method in ("GET", "DELETE"):
            answer = api.request(method, f"/{kind}", params={"search": search})
            problem(answer, 422, "invalid_input", "/search")


def test_fits_are_listed_by_the_model_that_they_begin_with(api: TestClient, model: str) -> None:
    dataset = make_dataset(api, frames=1)["id"]
    begun, others = (
        api.post("/fits", json={"dataset_id": dataset, **body}).json()["id"]
        for body in ({"from_model": model}, {})
    )
    for each in (begun, others):
        assert api.post(f"/fits/{each}/cancel").is_success
    assert identifiers(api, "fits", from_model=model) == [begun]
    assert identifiers(api, "fits", from_model="mdl_none") == []


def test_moments_have_a_zone_or_are_utc(api: TestClient) -> None:
    made = make_dataset(api, frames=1, name="zones")
    moment = datetime.fromisoformat(made["created_at"]) + timedelta(minutes=1)
    offset = (moment + timedelta(hours=2)).replace(tzinfo=None).isoformat() + "+02:00"
    naive = moment.replace(tzinfo=None).isoformat()
    for text in (moment.isoformat(), offset, naive, "9999-12-31T23:59:59.999999-12:00"):
        assert identifiers(api, "datasets", name="zones", created_before=text) == [made["id"]]
        assert identifiers(api, "datasets", name="zones", created_after=text) == []
    day = moment + timedelta(days=1)
    for text in (f"{day:%Y-%m-%d}", f"{day:%Y-%m-%dT%H:%MZ}", f"{day:%Y-%m-%dT%H:%M:%S.123456789}"):
        assert identifiers(api, "datasets", name="zones", created_before=text) == [made["id"]]
    assert identifiers(api, "datasets", name="zones", created_after=f"{moment:%Y-01-01}")


@pytest.mark.usefixtures("unchanged")
@pytest.mark.parametrize("kind", KINDS)
def test_a_moment_is_iso_8601_alone(api: TestClient, kind: str) -> None:
    for text in (
        "yesterday", "", " ", "2026", "20260131", "1767225600", "1767225600000", "1e9", "-1", "0.5",
        "inf", "nan", "+2026", "\u0662\u0660\u0662\u0666", "2026-01", "2026-W05-1", "2026-02-30",
        "2026-13-01T00:00:00Z", "2026-01-31T24:30Z", "2026-01-31 10:00", "2026-01-31T10:00+99:00",
        "2026-01-31T1000", "2026-01-31T10:00:00Z\n", "0000-01-01", "2026-01-31T10:00:00 02:00",
    ):  # fmt: skip
        for name in ("created_after", "created_before"):
            for method in ("GET", "DELETE"):
                answer = api.request(method, f"/{kind}", params={name: text})
                message = problem(answer, 422, "invalid_input", f"/{name}")
                assert "ISO 8601" in message, text
                assert "2026-01-31T09:30:00Z" in message, text


def test_names_are_not_empty(api: TestClient) -> None:
    problem(api.get("/models", params={"name": ""}), 422, "invalid_input", "/name")


def test_lists_of_models_show_no_training_curves(api: TestClient, model: str) -> None:
    shown = api.get(f"/models/{model}").json()
    assert shown.pop("training_curve")
    assert shown in api.get("/models?limit=200").json()["items"]


@pytest.mark.parametrize("kind", KINDS)
def test_tags_and_metadata_filter(
    api: TestClient, make: Callable[[str, str], dict[str, Any]], kind: str
) -> None:
    labels: list[dict[str, Any]] = [
        {
            "tags": ["a", "b c"],
            "metadata": {"subject": "M7", "day": 2, "ok": True, "x.y": "ä", "big": 1e20},
        },
        {
            "tags": ["a"],
            "metadata": {"subject": "M7", "day": "2", "ok": 1, "deep": {"day": 2}, "big": 1e20},
        },
        {"tags": ["A", 'a"b'], "metadata": {"subject": "m7", "day": 2.5, "ok": False}},
        {},
    ]
    made = [make(kind, "labelled")["id"] for _ in labels]
    for identifier, message in zip(made, labels, strict=True):
        assert api.patch(f"/{kind}/{identifier}", json=message).status_code == 200
    first, second, third, _ = made

    for query, expected in (
        ({"tag": "a"}, [second, first]),
        ({"tag": ["a", "b c"]}, [first]),
        ({"tag": ["b c", "A"]}, []),
        ({"tag": 'a"b'}, [third]),
        ({"metadata.subject": "M7"}, [second, first]),
        ({"metadata.day": "2"}, [second, first]),
        ({"metadata.day": "2.5"}, [third]),
        ({"metadata.day": "25e-1"}, [third]),
        ({"metadata.big": "1e20"}, [second, first]),
        ({"metadata.big": "100000000000000000000"}, [second, first]),
        ({"metadata.big": "1e999"}, []),
        ({"metadata.day": "99999999999999999999"}, []),
        ({"metadata.day": "18446744073709551615"}, []),
        ({"metadata.ok": "true"}, [first]),
        ({"metadata.ok": "false"}, [third]),
        ({"metadata.ok": "1"}, [second]),
        ({"metadata.x.y": "ä"}, [first]),
        ({"metadata.deep.day": "2"}, []),
        ({"metadata.subject": "M7", "tag": "b c"}, [first]),
        ({"id": [third, first, "none"]}, [third, first]),
        ({"id": [third, first], "tag": "A"}, [third]),
    ):
        assert identifiers(api, kind, name="labelled", **query) == expected, query


def test_filters_are_bounded(api: TestClient) -> None:
    for query, pointer in (
        ({"tag": [f"t{n}" for n in range(9)]}, "/tag"),
        ({"tag": ""}, "/tag/0"),
        ({"id": ["x"] * 201}, "/id"),
        ({f"metadata.{n}": "1" for n in range(9)}, "/metadata"),
        ({"metadata.a": "1" * 1001}, "/metadata.a"),
        ({"metadata": "a"}, "/metadata"),
        ({"meta.a": "1"}, "/meta.a"),
        ({"name": "a\0"}, "/name"),
        ({"tag": "a\0"}, "/tag"),
        ({"metadata.a": "\0"}, "/metadata.a"),
        ({"metadata.a\0": "1"}, "/metadata.a\0"),
    ):
        problem(api.get("/datasets", params=query), 422, "invalid_input", pointer)
    made = make_dataset(api, frames=1)["id"]
    other = api.get(f"/datasets/{made}", params={"metadata.a": "1"})
    problem(other, 422, "invalid_input", "/metadata.a")


def deleted(api: TestClient, kind: str, **query: Any) -> dict[str, Any]:
    """Delete as many as are found, and return the answer without how many these are."""
    count = api.delete(f"/{kind}", params=query | {"dry_run": True}).json()["found"]
    response = api.delete(f"/{kind}", params=query | {"expected_count": count})
    assert response.status_code == 200, response.text
    found: dict[str, Any] = response.json()
    assert found.pop("found") == count
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_many_are_deleted_at_once(
    api: TestClient, make: Callable[[str, str], dict[str, Any]], kind: str
) -> None:
    made = [make(kind, f"doomed {kind}")["id"] for _ in range(5)]
    kept = make(kind, "kept")["id"]
    some = deleted(api, kind, id=[made[0], made[1], made[0]])
    assert some == {"deleted": [made[1], made[0]], "refused": [], "next_cursor": None}
    again = deleted(api, kind, id=[made[0], kept], name=f"doomed {kind}")
    assert again["deleted"] == []
    assert [(item["id"], item["code"]) for item in again["refused"]] == [
        (made[0], "not_found"),
        (kept, "not_found"),
    ]
    page = deleted(api, kind, name=f"doomed {kind}", limit=2)
    assert page["deleted"] == [made[4], made[3]]
    rest = deleted(api, kind, name=f"doomed {kind}", cursor=page["next_cursor"])
    assert rest == {"deleted": [made[2]], "refused": [], "next_cursor": None}
    assert identifiers(api, kind, name=f"doomed {kind}") == []
    assert api.get(f"/{kind}/{kept}").status_code == 200


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_deleted_but_as_many_as_expected(
    api: TestClient, make: Callable[[str, str], dict[str, Any]], kind: str
) -> None:
    name = f"counted {kind}"
    made = [make(kind, name)["id"] for _ in range(3)][::-1]
    nothing: dict[str, Any] = {"deleted": [], "refused": [], "next_cursor": None}

    def asked(**query: Any) -> httpx2.Response:
        return api.delete(f"/{kind}", params={"name": name} | query)

    # Pages do not make the count smaller, and what is not found is none of them.
    dry: list[dict[str, Any]] = [{}, {"limit": 1}, {"id": [*made, "none"]}, {"expected_count": 7}]
    for query in dry:
        assert asked(dry_run=True, **query).json() == nothing | {"found": 3}
    assert asked(dry_run=True, cursor=made[0]).json()["found"] == 2
    assert asked(dry_run=True, name="nobody").json()["found"] == 0
    uncounted: list[dict[str, Any]] = [{}, {"limit": 1}, {"id": made}, {"dry_run": False}]
    for query in uncounted:
        message = problem(asked(**query), 422, "invalid_input", "/expected_count")
        assert "dry_run=true" in message
    for wrong in (-1, "some", "", 2.5):
        problem(asked(expected_count=wrong), 422, "invalid_input", "/expected_count")
    miscounted: list[dict[str, Any]] = [
        {"expected_count": 2},
        {"expected_count": 4},
        {"expected_count": 0},
        {"expected_count": 1, "limit": 1},
        {"expected_count": 4, "id": [*made, "none"]},
        {"expected_count": 10**30},
    ]
    for query in miscounted:
        assert "finds 3" in problem(asked(**query), 409, "conflict")
    assert identifiers(api, kind, name=name) == made

    page = asked(expected_count=3, limit=2).json()
    assert page == nothing | {"deleted": made[:2], "next_cursor": made[1], "found": 3}
    last = asked(expected_count=1, cursor=page["next_cursor"]).json()
    assert last == nothing | {"deleted": made[2:], "found": 1}
    assert "finds 0" in problem(asked(expected_count=3), 409, "conflict")
    assert asked(expected_count=0).json() == nothing | {"found": 0}


@pytest.mark.usefixtures("unchanged")
def test_nothing_is_deleted_without_a_filter(api: TestClient) -> None:
    for kind in KINDS:
        for query in ({}, {"limit": 200}, {"dry_run": True}, {"expected_count": 0}):
            problem(api.delete(f"/{kind}", params=query), 422, "invalid_input", "/id")
        problem(api.delete(f"/{kind}?nam=x"), 422, "invalid_input", "/nam")


def test_what_is_in_use_is_not_deleted(api: TestClient) -> None:
    free, used = (make_dataset(api, frames=1, tags=["bulk"])["id"] for _ in range(2))
    fit = api.post("/fits", json={"dataset_id": used, "tags": ["bulk"]}).json()["id"]
    for kind, gone, stays, word in (
        ("datasets", [free], used, "in use"),
        ("fits", [], fit, "cancel it first"),
    ):
        answer = deleted(api, kind, tag="bulk")
        assert answer["deleted"] == gone
        (refusal,) = answer["refused"]
        assert (refusal["id"], refusal["code"]) == (stays, "conflict")
        assert word in refusal["detail"]
    api.post(f"/fits/{fit}/cancel")
    assert deleted(api, "fits", tag="bulk", status="cancelled")["deleted"] == [fit]
    assert deleted(api, "datasets", tag="bulk")["deleted"] == [used]
