"""The service's own user: any program of that user's needs no key, and no page of others has it."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from service.app import create_app
from service.settings import Settings
from tests.fork_server import run
from tests.processes import free_port
from tests.service.conftest import Live, problem
from tests.service.owner import OwnersClient
from worker.process import python, tied

SOMEBODY = 12345
# What a browser sends for a page that it has of this very place, and of others.
OF_BROWSERS: tuple[dict[str, str], ...] = (
    {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"},
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"},
    {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
    {"Origin": "http://127.0.0.1"},
    {"Origin": "null"},
    {"Referer": "http://127.0.0.1/"},
    {"Cookie": "a=b"},
    {"User-Agent": "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/605.1.15 Version/16.1 Safari/605"},
)
# What programs send that are none: curl, Python, Node's `fetch`.
OF_PROGRAMS: tuple[dict[str, str], ...] = (
    {"User-Agent": "curl/8.14.1", "Accept": "*/*"},
    {"User-Agent": "python-httpx/0.28", "Accept": "*/*", "Connection": "keep-alive"},
    {"User-Agent": "node", "Accept-Language": "*", "Sec-Fetch-Mode": "cors"},
)
# Listens on ::1 as another user until its input ends, and prints why it cannot.
LISTENER = """
import os, socket, sys
os.setgroups([]), os.setresgid(*3 * [int(sys.argv[1])]), os.setresuid(*3 * [int(sys.argv[1])])
try:
    listener = socket.create_server((sys.argv[3], int(sys.argv[2])), family=socket.AF_INET6)
    print("listens", flush=True)
except OSError as error:
    print(os.strerror(error.errno), flush=True)
sys.stdin.read()
"""


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def page_key(api: Any) -> dict[str, str]:
    answer = api.get("/page-key")
    assert answer.headers["cache-control"] == "no-store"
    return bearer(answer.json()["token"])


def test_programs_need_no_key_and_browsers_that_of_the_page(api: TestClient) -> None:
    key = page_key(api)
    asked = {"name": "x", "scopes": ["admin"]}
    for headers in OF_PROGRAMS:
        assert api.get("/datasets", headers=headers).status_code == 200
    for headers in OF_BROWSERS:
        for path in ("/datasets", "/page-key", "/none"):
            detail = problem(api.get(path, headers=headers), 401, "unauthorized")
            assert "fewview open" in detail
        problem(api.post("/keys", json=asked, headers=headers), 401, "unauthorized")
        with_key = api.get("/datasets", headers=headers | key)
        assert with_key.status_code == (401 if headers.get("Origin") == "null" else 200)
        # The page itself, and what describes the API, hold nothing of anybody's.
        for path in ("/", "/docs", "/openapi.json", "/docs/assets/swagger-ui.css"):
            assert api.get(path, headers=headers).status_code == 200, path
    strange = {b"Authorization": b"Bearer " + b"\xe9" * 43}
    problem(api.get("/datasets", headers=strange), 401, "unauthorized")


def test_streams_of_a_page_need_its_key(api: TestClient, model: str) -> None:
    token = page_key(api)["Authorization"].removeprefix("Bearer ")
    own = {"Origin": "http://127.0.0.1"}
    with pytest.raises(WebSocketDenialResponse) as refused:
        api.websocket_connect("/lift/stream", headers=own).__enter__()
    assert refused.value.status_code == 401
    offered = ["fewview", f"bearer.{token}"]
    with api.websocket_connect("/lift/stream", headers=own, subprotocols=offered) as stream:
        stream.send_json({"model": model})
        assert stream.receive_json()["type"] == "ready"
        foreign = {"Origin": "http://localhost"}
        with pytest.raises(WebSocketDenialResponse) as refused:
            api.websocket_connect("/lift/stream", headers=foreign, subprotocols=offered).__enter__()
    assert refused.value.status_code == 401


def test_the_pages_key_is_of_no_use_to_others(api: TestClient) -> None:
    key = page_key(api)
    for header in ("X-Forwarded-For", "Forwarded"):
        problem(api.get("/datasets", headers=key | {header: "for=192.0.2.1"}), 401, "unauthorized")
    peer = api.app_state.pop("peer")
    try:
        problem(api.get("/datasets", headers=key), 401, "unauthorized")
    finally:
        api.app_state["peer"] = peer
    assert api.get("/datasets", headers=key).status_code == 200


def test_a_name_that_was_allowed_is_not_trusted(settings: Settings) -> None:
    """It may be a proxy's, or lead elsewhere tomorrow; loopback's own names lead here alone."""
    for allowed in ("lab.example", "*"):
        other = settings.model_copy(update={"allowed_hosts": allowed})
        with OwnersClient(create_app(other)) as client:
            for host in ("localhost", "127.0.0.1:80", "[::1]:8000", "fewview.localhost"):
                assert client.get("/version", headers={"Host": host}).status_code == 200
            named = {"Host": "lab.example"}
            problem(client.get("/version", headers=named), 401, "unauthorized")
            problem(client.get("/version", headers=named | page_key(client)), 401, "unauthorized")


def test_who_trusts_nobody_has_no_key_for_the_page(settings: Settings) -> None:
    token = "a" * 40
    closed = settings.model_copy(update={"admin_key": token, "trust_local": False})
    with OwnersClient(create_app(closed)) as client:
        detail = problem(client.get("/page-key", headers=bearer(token)), 404, "not_found")
        assert "fewview key create" in detail


def test_each_start_has_a_key_of_its_own(settings: Settings) -> None:
    with OwnersClient(create_app(settings)) as one, OwnersClient(create_app(settings)) as other:
        problem(other.get("/datasets", headers=page_key(one)), 401, "unauthorized")


# --- another user of the machine, on the other address of localhost -------------------------------


@contextmanager
def listening(port: int, host: str = "::1") -> Iterator[str]:
    """Have another user listen; give what came of it."""
    command = tied(sys.executable, "-c", LISTENER, str(SOMEBODY), str(port), host)
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.fixture
def two_users() -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can be several users")
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")


@pytest.mark.usefixtures("two_users")
def test_nobody_else_listens_on_the_other_address_of_localhost(live: Live) -> None:
    port = int(live.url.rpartition(":")[2])
    for host in ("::1", "::"):
        with listening(port, host) as came:
            assert came == "Address already in use", host
    with httpx2.Client(base_url=f"http://[::1]:{port}", trust_env=False) as http:
        assert http.get("/version").status_code == 200  # and it is ours


@pytest.mark.usefixtures("two_users")
def test_it_does_not_start_where_another_has_the_other_address(tmp_path: Path) -> None:
    port = free_port()
    with listening(port) as came:
        assert came == "listens"
        for more in ((), ("--host=localhost",), ("--api-processes=2",)):
            words = ("serve", f"--port={port}", f"--data-dir={tmp_path / 'data'}", *more)
            ran = run(python("-m", "service.cli", *words))
            assert ran.returncode == 2
            assert f"Cannot listen on ::1:{port}: Address already in use." in ran.stderr
            assert "`localhost` is that address, too" in ran.stderr


@pytest.mark.parametrize(
    ("host", "addresses"),
    [
        ("127.0.0.1", ["127.0.0.1", "::1"]),
        ("localhost", ["localhost", "::1"]),
        ("::1", ["::1", "127.0.0.1"]),
        ("0.0.0.0", ["0.0.0.0", "::1"]),  # noqa: S104
        ("::", ["::", "127.0.0.1"]),
        ("127.0.0.2", ["127.0.0.2"]),
        ("192.168.1.5", ["192.168.1.5"]),
    ],
)
def test_of_localhost_both_addresses_are_listened_on(host: str, addresses: list[str]) -> None:
    assert Settings(host=host).addresses == addresses
