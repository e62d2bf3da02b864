"""The page as it is served: for ever under names of its content, from this service alone."""

import gzip
import re
from pathlib import Path

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from service.page.serving import BUILT, serve_page
from tests.service.conftest import problem

MOST_BYTES = 300_000  # gzipped, all that the page is made of


@pytest.fixture(scope="module")
def index(api: TestClient) -> str:
    if not (BUILT / "index.html").exists():
        pytest.skip("the page was not built: `make page`, which needs npm's registry")
    response = api.get("/")
    assert (response.status_code, response.headers["cache-control"]) == (200, "no-cache")
    assert response.headers["content-type"].startswith("text/html")
    policy = response.headers["content-security-policy"]
    assert policy.startswith("default-src 'self';")
    assert "unsafe" not in policy
    assert "http" not in policy
    return response.text


def test_all_that_the_page_names_is_served_for_ever(api: TestClient, index: str) -> None:
    names = [name for name in re.findall(r'(?:src|href)="([^"]+)"', index) if name != "#/"]
    assert {Path(name).suffix for name in names} == {".svg", ".css", ".js"}
    for name in names:
        assert not name.startswith(("/", "http")), "a proxy may give the service a prefix"
        file = api.get(f"/{name}")
        assert file.status_code == 200
        assert file.headers["cache-control"] == "public, max-age=31536000, immutable"
        assert re.search(r"-[A-Za-z0-9]{8}\.\w+$", name), f"{name} has no digest of its content"
    problem(api.get("/page/none.js"), 404, "not_found")
    problem(api.get("/page/../app.py"), 404, "not_found")
    problem(api.post("/"), 405, "method_not_allowed")


def test_the_page_is_small(index: str) -> None:
    files = [file.read_bytes() for file in (BUILT / "page").iterdir()]
    assert sum(len(gzip.compress(file)) for file in [index.encode(), *files]) < MOST_BYTES


def test_without_a_built_page_it_says_how_to_build_it(tmp_path: Path) -> None:
    app = FastAPI()
    serve_page(app, tmp_path / "nothing")
    with TestClient(app) as client:
        response = client.get("/")
        assert response.status_code == 200
        assert "make page" in response.text
        assert client.get("/page/main.js").status_code == 404


def test_the_page_is_not_shown_within_others(api: TestClient) -> None:
    assert "frame-ancestors 'none'" in api.get("/").headers["content-security-policy"]
