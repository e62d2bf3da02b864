"""Scripts of web pages: none may call the API, unless their origin is allowed."""

from typing import Any

import pytest
from pydantic import ValidationError
from starlette.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from tests.service.conftest import problem
from tests.service.owner import OwnersClient

PAGE = "https://lab.example"
ALLOW = "access-control-allow-origin"
ASKING = {
    "Origin": PAGE,
    "Access-Control-Request-Method": "PATCH",
    "Access-Control-Request-Headers": "Idempotency-Key, Content-Type",
}


def test_closed_by_default(api: TestClient) -> None:
    assert ALLOW not in api.get("/datasets", headers={"Origin": PAGE}).headers
    problem(api.options("/datasets", headers=ASKING), 401, "unauthorized")
    asked = api.options("/datasets", headers=ASKING | key_for_all(api))
    problem(asked, 405, "method_not_allowed")
    assert ALLOW not in asked.headers


def key_of_page(client: TestClient) -> dict[str, str]:
    return {"Authorization": f"Bearer {client.get('/page-key').json()['token']}"}


def key_for_all(client: TestClient) -> dict[str, str]:
    asked: dict[str, Any] = {"name": "page", "scopes": ["read", "lift", "write", "delete"]}
    return {"Authorization": f"Bearer {client.post('/keys', json=asked).json()['token']}"}


def test_a_foreign_page_can_post_nothing(api: TestClient, model: str, unchanged: None) -> None:
    """Browsers ask nobody before they send a form, or a POST without a body."""
    form = {"file": ("capture.npz", b"PK")}
    key = key_for_all(api)
    for origin in (PAGE, "null", "http://[", "http://127.0.0.1:81"):
        asking = key | {"Origin": origin}
        for path in ("/datasets", "/models", "/lift", f"/lift?model={model}", "/evaluations"):
            problem(api.post(path, files=form, headers=asking), 403, "origin_not_allowed")
        problem(api.post("/fits/fit_none/cancel", headers=asking), 403, "origin_not_allowed")
        problem(api.delete("/fits/fit_none", headers=asking), 403, "origin_not_allowed")
    own = api.post("/models", files=form, headers=key_of_page(api) | {"Origin": str(api.base_url)})
    problem(own, 400, "malformed_body")


@pytest.mark.parametrize("given", ["", PAGE, "*"])
def test_no_foreign_page_passes_for_the_owner(settings: Settings, given: str) -> None:
    """Not of an allowed origin either, and not with the key that the page has."""
    with OwnersClient(create_app(settings.model_copy(update={"cors_origins": given}))) as client:
        for origin in (PAGE, "null", "http://127.0.0.1:81"):
            for key in ({}, key_of_page(client)):
                for method, path in (
                    ("GET", "/datasets"),
                    ("GET", "/page-key"),
                    ("POST", "/keys"),
                ):
                    asked = client.request(method, path, headers=key | {"Origin": origin})
                    problem(asked, 401, "unauthorized")


@pytest.mark.parametrize(
    ("given", "open_to_all"), [(f"http://localhost:3000, {PAGE}", False), ("*", True)]
)
def test_allowed_origins_may_call(settings: Settings, given: str, open_to_all: bool) -> None:
    with OwnersClient(create_app(settings.model_copy(update={"cors_origins": given}))) as client:
        asked = client.options("/datasets", headers=ASKING)
        assert asked.status_code == 200
        assert "PATCH" in asked.headers["access-control-allow-methods"]
        assert "idempotency-key" in asked.headers["access-control-allow-headers"].lower()
        key = key_for_all(client)
        answer = client.get("/datasets", headers=key | {"Origin": PAGE})
        assert answer.headers[ALLOW] == ("*" if open_to_all else PAGE)
        assert "Location" in answer.headers["access-control-expose-headers"]
        large = key | {"Origin": PAGE, "Content-Type": "application/json"}
        refused = client.post("/lift", content=b"x" * (5 * 2**20), headers=large)
        problem(refused, 413, "body_too_large")
        assert ALLOW in refused.headers
        other = client.get("/datasets", headers={"Origin": "https://evil.example"})
        assert (ALLOW in other.headers) == open_to_all


def test_what_is_no_origin_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("lab.example", "https://lab.example/", "https://lab.example/page", "https://"):
        with pytest.raises(ValidationError, match="expected origins such as"):
            Settings(cors_origins=text)
    monkeypatch.setenv("FEWVIEW_CORS_ORIGINS", f"{PAGE},http://localhost:3000")
    settings = Settings()
    assert settings.allowed_origins == [PAGE, "http://localhost:3000"]
    monkeypatch.setenv("FEWVIEW_CORS_ORIGINS", settings.to_environment()["FEWVIEW_CORS_ORIGINS"])
    assert Settings() == settings
    monkeypatch.delenv("FEWVIEW_CORS_ORIGINS")
    assert Settings().allowed_origins == []


def test_a_fault_can_be_read_by_the_page_that_met_it(settings: Settings) -> None:
    app = create_app(settings.model_copy(update={"cors_origins": PAGE}))
    app.add_api_route("/faulty", lambda: 1 // 0)
    with OwnersClient(app, raise_server_exceptions=False) as client:
        for origin, readable in ((PAGE, True), ("https://evil.example", False)):
            answer = client.get("/faulty", headers=key_for_all(client) | {"Origin": origin})
            problem(answer, 500, "internal_error")
            assert (ALLOW in answer.headers) == readable
            assert "ZeroDivision" not in answer.text
    with OwnersClient(app) as client, pytest.raises(ZeroDivisionError):  # which the server logs
        client.get("/faulty")
