"""What every answer forbids browsers to do with it, whoever answers and whatever."""

import re
import socket
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.http.safe_headers import HEADERS
from service.page.serving import BUILT
from tests.service.conftest import Live

NAMES = {name.decode() for name in HEADERS}


def missing(headers: Any) -> set[str]:
    """Return what headers lack, or allow others."""
    policy = headers.get("content-security-policy", "")
    loose = {
        "frame-ancestors 'none'" not in policy and "no frame-ancestors",
        headers.get("x-frame-options") != "DENY" and "frames",
        headers.get("x-content-type-options") != "nosniff" and "sniffing",
        headers.get("referrer-policy") != "no-referrer" and "referrer",
        "default-src 'none'" not in policy and "default-src 'self'" not in policy and "sources",
    }
    return {str(each) for each in loose if each} | {name for name in NAMES if name not in headers}


def test_every_route_forbids(api: TestClient) -> None:
    paths = api.get("/openapi.json").json()["paths"]
    asked = [(method, path) for path, item in paths.items() for method in item]
    asked += [("put", "/fits"), ("options", "/datasets"), ("head", "/datasets"), ("get", "/none")]
    asked += [
        (m, p) for m in ("get", "head") for p in ("/", "/docs", "/openapi.json", "/page/x.js")
    ]
    asked += [("get", "/docs/assets/swagger-ui.css"), ("get", "/docs/assets/no"), ("get", "/redoc")]
    asked += [("get", f"/page/{file.name}") for file in (BUILT / "page").glob("*.js")]
    for method, path in asked:
        if path.endswith("/events") or method == "trace":
            continue
        url = re.sub(r"[{}]", "", path)
        for headers in ({}, {"Origin": "https://evil.example"}, {"Host": "evil.example"}):
            answer = api.request(method, url, headers=headers)
            assert missing(answer.headers) == set(), (method, path, headers, answer.status_code)


def test_faults_forbid_too(api: TestClient) -> None:
    api.app.router.add_route("/faulty-page", lambda _request: 1 // 0)  # type: ignore[attr-defined]
    answer = api.get("/faulty-page")
    assert answer.status_code == 500
    assert missing(answer.headers) == set()


@pytest.mark.parametrize(
    "sent",
    [
        b"nonsense\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 70_000 + b"\r\n\r\n",
        b"GET /lift/stream HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n"
        b"Upgrade: websocket\r\nSec-WebSocket-Version: 1\r\nSec-WebSocket-Key: x\r\n\r\n",
    ],
)
def test_what_is_no_request_is_answered_so_too(live: Live, sent: bytes) -> None:
    host, port = live.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=20) as connection:
        connection.sendall(sent)
        head = b""
        while b"\r\n\r\n" not in head and (piece := connection.recv(65536)):
            head += piece
    status, *lines = head.partition(b"\r\n\r\n")[0].decode().split("\r\n")
    assert status.split()[1].startswith("4")
    headers = httpx2.Headers(
        [(name, value) for name, _, value in (x.partition(": ") for x in lines)]
    )
    assert missing(headers) == set()


def test_streams_that_are_refused_are_answered_so_too(live: Live) -> None:
    base = live.url.replace("http", "ws")
    for path, headers in (
        ("/lift/stream", {"Origin": "https://evil.example"}),
        ("/none", {}),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"{base}{path}", proxy=None, additional_headers=headers)
        assert missing(refused.value.response.headers) == set(), path
