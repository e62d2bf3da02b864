"""Every answer names its request, and what is logged of it does, too."""

import re
import socket
from collections.abc import Iterator
from typing import Any

import httpx2
import orjson
import pytest
from starlette.testclient import TestClient
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.app import create_app
from service.settings import Settings
from store import lookup
from store.records import FitRecord
from tests.service.conftest import JSON, make_dataset, problem, served
from tests.service.owner import OwnersClient
from worker.contract import KnownJob, PlainDataSerializer
from worker.queue import enqueue_again

HEADER = "X-Request-Id"
MADE = re.compile(r"[0-9a-f]{32}")


@pytest.fixture(scope="module")
def http(settings: Settings) -> Iterator[httpx2.Client]:
    with served(settings.model_copy(update={"request_seconds": 1})) as client:
        yield client


def raw(http: httpx2.Client, sent: bytes) -> tuple[int, str]:
    """Send bytes; return the status of the answer, and the identifier that it has."""
    with socket.create_connection((http.base_url.host, http.base_url.port or 0), 20) as connection:
        connection.sendall(sent)
        answer = b""
        while piece := connection.recv(1 << 16):
            answer += piece
    found = re.findall(rb"(?im)^x-request-id: (\S+)\r$", answer.partition(b"\r\n\r\n")[0] + b"\r")
    assert len(found) == 1, answer
    return int(answer.split()[1]), found[0].decode()


def test_a_given_identifier_comes_back_and_another_is_made(api: TestClient, model: str) -> None:
    frames = [[[[1.0, 2.0]] * 16] * 3]
    for method, path, body in (
        ("GET", "/version", None),
        ("HEAD", "/version", None),
        ("OPTIONS", "/version", None),
        ("GET", "/docs", None),
        ("GET", "/docs/assets/swagger-ui.css", None),
        ("GET", "/docs/assets/none", None),
        ("GET", "/openapi.json", None),
        ("GET", "/datasets/ds_none", None),
        ("GET", "/datasets?what=1", None),
        ("GET", "/no/such/path", None),
        ("DELETE", "/version", None),
        ("POST", "/datasets", "{"),
        ("POST", "/lift", orjson.dumps({"model": model, "frames": frames})),
        ("POST", "/lift", "x" * 5_000_000),
    ):
        given = "".join(map(chr, range(33, 127)))
        asked = JSON | {HEADER: given}
        assert api.request(method, path, content=body, headers=asked).headers[HEADER] == given
        made = [api.request(method, path, content=body, headers=JSON).headers[HEADER] for _ in "ab"]
        assert all(MADE.fullmatch(each) for each in made)
        assert made[0] != made[1]


def test_what_is_no_identifier_is_replaced(api: TestClient) -> None:
    assert api.get("/version", headers={HEADER: "x" * 128}).headers[HEADER] == "x" * 128
    for given in ("", "x" * 129, "two words", "tab\there", "caf\xe9"):
        answer = api.get("/version", headers={HEADER.encode(): given.encode("latin-1")})
        assert MADE.fullmatch(answer.headers[HEADER])


def test_problems_name_the_request(api: TestClient) -> None:
    answer = api.get("/fits/fit_none", headers={HEADER: "mine"})
    problem(answer, 404, "not_found")
    assert answer.json()["request_id"] == "mine"
    answer = api.get("/fits/fit_none", headers={"Host": "evil.example"})
    problem(answer, 421, "host_not_allowed")
    assert answer.json()["request_id"] == answer.headers[HEADER]


def test_faults_of_ours_name_the_request(settings: Settings) -> None:
    def fail() -> None:
        raise RuntimeError("a fault")

    for origins in ("", "https://lab.example"):
        app = create_app(settings.model_copy(update={"cors_origins": origins}))
        app.add_api_route("/fault", fail)
        with OwnersClient(app, raise_server_exceptions=False) as client:
            answer = client.get("/fault", headers={HEADER: "mine"})
            problem(answer, 500, "internal_error")
            assert answer.headers[HEADER] == answer.json()["request_id"] == "mine"
            if origins:
                page = {"Origin": origins, "Access-Control-Request-Method": "GET"}
                preflight = client.options("/fits", headers=page | {HEADER: "mine"})
                assert preflight.headers[HEADER] == "mine"
                exposed = client.get("/version", headers={"Origin": origins})
                assert HEADER in exposed.headers["access-control-expose-headers"]


def test_what_is_no_request_yet_gets_one_too(http: httpx2.Client) -> None:
    head = b"GET /version HTTP/1.1\r\nHost: localhost\r\n"
    for sent, status in (
        (b"nonsense\r\n\r\n", 400),
        (head + b"X-Long: " + b"x" * 70_000 + b"\r\n\r\n", 431),
        (head, 408),
        (head + b"Content-Length: x\r\n\r\n", 400),
    ):
        answered, identifier = raw(http, sent)
        assert (answered, bool(MADE.fullmatch(identifier))) == (status, True)
    large = head + b"X-Request-Id: mine\r\nX-Long: " + b"x" * 66_000 + b"\r\n\r\n"
    assert raw(http, large) == (431, "mine")


@pytest.mark.parametrize("given", [None, "mine"])
def test_handshakes_of_websockets_have_one(http: httpx2.Client, given: str | None) -> None:
    url = f"ws://{http.base_url.host}:{http.base_url.port}"
    asked = {} if given is None else {HEADER: given}
    expected = re.compile(given or MADE.pattern)

    with connect(f"{url}/lift/stream", proxy=None, additional_headers=asked) as accepted:
        assert accepted.response is not None
        assert expected.fullmatch(accepted.response.headers[HEADER])
    for path, more, status in (
        ("/lift/stream", {"Origin": "https://evil.example"}, 401),
        ("/no/such/path", {}, 403),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"{url}{path}", proxy=None, additional_headers=asked | more)
        response = refused.value.response
        assert response.status_code == status
        assert response.headers.get_all(HEADER) == [response.headers[HEADER]]
        assert expected.fullmatch(response.headers[HEADER])
    line = "" if given is None else f"{HEADER}: {given}\r\n"
    upgrade = f"GET /lift/stream HTTP/1.1\r\nHost: localhost\r\n{line}Upgrade: websocket\r\n"
    status, identifier = raw(http, f"{upgrade}Connection: Upgrade\r\n\r\n".encode())
    assert 400 <= status < 500
    assert expected.fullmatch(identifier)


def test_a_job_carries_the_request_that_asked_for_it(api: TestClient) -> None:
    """Also where it is put on the queue again, by who knows nothing of the request."""
    dataset = make_dataset(api)["id"]
    body = {"dataset_id": dataset, "config": {"steps": 5}}
    fit = api.post("/fits", json=body, headers={HEADER: "of-the-fit"}).json()
    state: Any = api.app.state  # type: ignore[attr-defined]

    def noted() -> Any:
        return KnownJob.fetch(fit["job_id"], state.redis, PlainDataSerializer).meta["request_id"]

    assert noted() == "of-the-fit"
    enqueue_again(state.redis, state.store, lookup.get(state.store, FitRecord, fit["id"]))
    assert noted() == "of-the-fit"
    api.post(f"/fits/{fit['id']}/cancel")
