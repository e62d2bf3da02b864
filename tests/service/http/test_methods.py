"""Methods that a path does not have."""

import re

from starlette.testclient import TestClient

from tests.service.conftest import problem


def test_a_wrong_method_is_answered_with_all_that_are_right(api: TestClient) -> None:
    """Of every path, whichever of its routes have them; and what is named is answered."""
    paths = api.get("/openapi.json").json()["paths"]
    of_paths = {re.sub(r"\{\w+\}", "none", path): set(known) for path, known in paths.items()}
    static = ("/openapi.json", "/docs", "/docs/assets/swagger-ui.css")
    for path, known in (of_paths | {path: {"get"} for path in static}).items():
        right = {method.upper() for method in known} | ({"HEAD"} if "get" in known else set())
        for method in {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"} - right:
            response = api.request(method, path)
            assert response.status_code == 405, (method, path)
            if method != "HEAD":
                problem(response, 405, "method_not_allowed")
            assert sorted(response.headers["allow"].split(", ")) == sorted(right), (method, path)
