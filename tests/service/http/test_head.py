"""HEAD gives the headers of GET, and no body is made for it."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from tests.service.conftest import Live, make_dataset


def headers_of(response: Any) -> dict[str, str]:
    return {
        name: text
        for name, text in response.headers.items()
        if name not in ("date", "x-request-id")
    }


def test_headers_are_those_of_get(api: TestClient, model: str) -> None:
    dataset = f"/datasets/{make_dataset(api, frames=1)['id']}"
    for url in (
        "/datasets",
        dataset,
        f"/models/{model}",
        f"/models/{model}/cameras",
        f"/models/{model}/weights",
        "/health/live",
        "/version",
        "/openapi.json",
        "/docs",
        "/fits/fit_none",
        "/datasets?limt=1",
        "/lift",
    ):
        shown, head = api.get(url), api.head(url)
        assert head.status_code == shown.status_code, url
        assert head.content == b""
        assert headers_of(head) == headers_of(shown), url
    assert int(api.head(f"/models/{model}/weights").headers["content-length"]) > 1000


def test_only_get_has_ranges(api: TestClient, model: str) -> None:
    url = f"/models/{model}/weights"
    head = api.head(url, headers={"Range": "bytes=0-9"})
    assert head.status_code == 200
    same = api.head(url, headers={"If-None-Match": head.headers["etag"]})
    assert same.status_code == 304


def test_it_works_where_there_is_no_get(api: TestClient) -> None:
    assert api.head("/nothing").status_code == 404


def test_a_served_fewview_answers_at_once(live: Live, fitted: dict[str, Any]) -> None:
    fit, model = f"/fits/{fitted['id']}", f"/models/{fitted['model_id']}"
    for url in (f"{model}/weights", f"{fit}/reconstruction?format=npz", fit):
        shown, head = live.http.get(url), live.http.head(url)
        assert (head.status_code, head.content) == (200, b"")
        for name in ("content-length", "content-type"):
            assert head.headers[name] == shown.headers[name]


@pytest.mark.parametrize("revision", ["0", "1000000"])
def test_a_stream_of_events_is_not_waited_for(live: Live, revision: str) -> None:
    dataset = make_dataset(live.http)["id"]
    fit = live.fit(dataset, steps=1_000_000)["id"]
    try:
        head = live.http.head(f"/fits/{fit}/events", headers={"Last-Event-ID": revision}, timeout=5)
        assert head.status_code == 200
        assert head.headers["content-type"].startswith("text/event-stream")
        assert live.http.get("/version").status_code == 200  # on the same connection
    finally:
        live.http.post(f"/fits/{fit}/cancel")
