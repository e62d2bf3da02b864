"""The names that the service answers under: no web page reaches it under one of its own."""

import socket
from typing import Any

import httpx2
import orjson
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.app import create_app
from service.settings import Settings
from tests.service.conftest import Live, problem
from tests.service.owner import OwnersClient

FOREIGN = ("evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example")


def asked(http: Any, host: str, path: str = "/version") -> httpx2.Response:
    response: httpx2.Response = http.get(path, headers={"Host": host})
    return response


def test_a_foreign_name_is_refused(live: Live) -> None:
    """As a page asks whose name was made to point to this machine (DNS rebinding)."""
    for host in (*FOREIGN, "", "192.168.1.5", "8.8.8.8:80", "[", "testserver"):
        detail = problem(asked(live.http, host), 421, "host_not_allowed")
        assert "FEWVIEW_ALLOWED_HOSTS" in detail
    for url in ("/datasets", "/lift", "/models", "/health/live", "/docs", "/openapi.json", "/none"):
        problem(asked(live.http, FOREIGN[0], url), 421, "host_not_allowed")
    posted = live.http.post("/lift", json={}, headers={"Host": FOREIGN[0]})
    problem(posted, 421, "host_not_allowed")
    deleted = live.http.delete("/datasets/ds_none", headers={"Host": FOREIGN[0]})
    problem(deleted, 421, "host_not_allowed")


def test_names_and_addresses_of_loopback_are_its_own(live: Live) -> None:
    port = live.url.rpartition(":")[2]
    for name in ("localhost", "LOCALHOST", "fewview.localhost", "127.0.0.1", "127.8.9.1", "[::1]"):
        for host in (name, f"{name}:{port}", f"{name}:80"):
            assert asked(live.http, host).status_code == 200


def test_a_stream_is_opened_under_no_foreign_name(live: Live) -> None:
    """A page under a foreign name has that name as its origin, too."""
    address, port = live.url.removeprefix("http://").split(":")
    for host in ("evil.example", "localhost.evil.example"):
        page = {"Origin": f"http://{host}:{port}"}
        with (
            pytest.raises(InvalidStatus) as refused,
            socket.create_connection((address, int(port))) as there,
            connect(f"ws://{host}:{port}/lift/stream", sock=there, additional_headers=page),
        ):
            pass
        assert refused.value.response.status_code == 421
        assert orjson.loads(refused.value.response.body)["code"] == "host_not_allowed"


@pytest.mark.parametrize(
    ("given", "own", "foreign"),
    [
        ({"allowed_hosts": "lab.example, API"}, ("lab.example", "api:80"), (*FOREIGN, "1.2.3.4")),
        ({"allowed_hosts": "*"}, (*FOREIGN, "1.2.3.4"), ()),
        ({"host": "192.168.1.5"}, ("192.168.1.5", "192.168.1.5:8000"), (*FOREIGN, "192.168.1.6")),
        ({"host": "lab.example"}, ("lab.example:8000",), FOREIGN),
        # In a container, for one: any address may be its own, and no name can be taken over.
        ({"host": "0.0.0.0"}, ("192.168.1.5:8000", "[fe80::1]:8000"), FOREIGN),  # noqa: S104
        ({"host": "::"}, ("192.168.1.5:8000", "[fe80::1]"), FOREIGN),
    ],
)
def test_further_names_can_be_allowed(
    settings: Settings, given: dict[str, str], own: tuple[str, ...], foreign: tuple[str, ...]
) -> None:
    other = settings.model_copy(update={"allowed_hosts": "", **given})
    client = OwnersClient(create_app(other))  # whose store nobody opens: none of this needs one
    for host in (*own, "localhost:8000"):
        assert asked(client, host, "/").status_code == 200, host
    for host in foreign:
        problem(asked(client, host), 421, "host_not_allowed")
