"""How a stream starts and ends: what is refused, bounded, deleted, stopped, documented."""

import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from service.wire import stream_messages, watch_messages
from service.wire.stream_messages import StreamError
from tests.damage import flip
from tests.service.conftest import (
    BYTES,
    problem,
    served,
)
from tests.service.realtime.conftest import (
    VIEW,
    as_bytes,
    opened,
    read_bytes,
    started,
)
from tests.waiting import wait_for


def ending(socket: ClientConnection) -> tuple[StreamError, int]:
    """Return the last message of a stream and its close code."""
    error = StreamError.model_validate_json(socket.recv(timeout=300))
    with pytest.raises(ConnectionClosed) as closed:
        socket.recv(timeout=300)
    assert closed.value.rcvd is not None
    assert error.sequence is None
    return error, closed.value.rcvd.code


@pytest.mark.parametrize(
    ("first", "code", "pointer"),
    [
        ("{", 4400, None),
        (b"{}", 4422, ""),
        ("{}", 4422, "/model"),
        ({"model": "mdl_no"}, 4404, None),
        ({"model": "MODEL", "x": 1}, 4422, "/x"),
        ({"model": "MODEL", "refine": "some"}, 4422, "/refine"),
        ({"model": "MODEL", "on_overload": "none"}, 4422, "/on_overload"),
        ({"model": "MODEL", "views": [1, 1]}, 4422, "/views"),
        ({"model": "MODEL", "views": [0, 9]}, 4422, "/views"),
        ({"model": "MODEL", "views": []}, 4422, "/views"),
        ({"model": "MODEL", "views": [-1]}, 4422, "/views/0"),
        ({"model": "MODEL", "views": [0, True]}, 4422, "/views/1"),
        ({"model": "MODEL", "continuity": 1}, 4422, "/continuity"),
    ],
)
def test_a_bad_start_ends_the_stream(
    http: httpx2.Client, model: str, first: Any, code: int, pointer: str | None
) -> None:
    with opened(http) as socket:
        if isinstance(first, dict):
            first = orjson.dumps(first).decode().replace("MODEL", model)
        socket.send(first)
        error, closed = ending(socket)
    assert closed == code
    assert [item.pointer for item in error.errors] == ([] if pointer is None else [pointer])


def test_the_start_says_what_was_understood(http: httpx2.Client, model: str) -> None:
    with opened(http) as socket:
        socket.send(orjson.dumps({"model": model, "views": [2, 0]}).decode())
        ready = orjson.loads(socket.recv(timeout=300))
    assert ready["views"] == [2, 0]
    assert ready["refine"] == "auto"  # the fit's
    assert ready["on_overload"] == "all"
    assert ready["continuity"] is False
    assert (ready["header_bytes"], ready["view_bytes"]) == (8, VIEW.itemsize)
    assert ready["limits"]["message_bytes"] == 256 * 1024


def test_a_model_that_is_deleted_ends_its_streams(
    http: httpx2.Client, weights: bytes, capture: SyntheticCapture
) -> None:
    made = http.post("/models", content=weights, headers=BYTES).json()["id"]
    with started(http, made) as socket:
        socket.send(as_bytes(1, capture.keypoints[0]))
        assert read_bytes(socket.recv(timeout=300))[0] == 1
        assert http.delete(f"/models/{made}").status_code == 204
        socket.send(as_bytes(2, capture.keypoints[0]))
        error, closed = ending(socket)
    assert (error.code, closed) == ("not_found", 4404)


def test_an_outage_ends_a_stream_with_its_own_code(
    http: httpx2.Client, settings: Settings, weights: bytes
) -> None:
    """A client may try again later; after a fault it had better not."""
    made = http.post("/models", content=weights, headers=BYTES).json()["id"]  # nobody has read it
    objects, elsewhere = settings.data_dir / "objects", settings.data_dir / "elsewhere"
    objects.rename(elsewhere)
    try:
        objects.write_text("no folder")
        with opened(http) as socket:
            socket.send(orjson.dumps({"model": made}).decode())
            error, closed = ending(socket)
    finally:
        objects.unlink()
        elsewhere.rename(objects)
    assert (error.code, closed) == ("unavailable", 4503)
    with started(http, made):
        pass


def test_damaged_weights_end_a_stream_and_are_named(
    http: httpx2.Client, settings: Settings, weights: bytes
) -> None:
    made = http.post("/models", content=weights, headers=BYTES).json()["id"]
    (file,) = (settings.data_dir / "objects" / "models" / made).iterdir()
    flip(file)
    with opened(http) as socket:
        socket.send(orjson.dumps({"model": made}).decode())
        error, closed = ending(socket)
    assert (error.code, closed) == ("object_damaged", 4500)
    assert f"models/{made}" in error.detail


def test_messages_are_bounded(http: httpx2.Client, model: str) -> None:
    with started(http, model) as socket:
        socket.send(b"\1" + b"\0" * 256 * 1024)
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=300)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


def test_streams_are_bounded_in_number_and_silence(settings: Settings, model: str) -> None:
    few = settings.model_copy(update={"max_streams": 1, "stream_idle_seconds": 1.0})
    with served(few) as http:
        with started(http, model) as socket:
            with pytest.raises(InvalidStatus) as refused, opened(http):
                pass
            response = refused.value.response
            assert response.status_code == 503
            assert response.headers["Content-Type"] == "application/problem+json"
            assert orjson.loads(response.body)["code"] == "overloaded"
            assert int(response.headers["Retry-After"]) > 0
            error, closed = ending(socket)
            assert (error.code, closed) == ("idle", 4408)

        def opens() -> bool:
            try:
                with started(http, model):
                    return True
            except InvalidStatus:
                return False

        wait_for(opens, "the place of the one that was silent")


def page_key(http: httpx2.Client) -> str:
    return str(http.get("/page-key").json()["token"])


def lifting_key(http: httpx2.Client) -> str:
    return str(http.post("/keys", json={"name": "page", "scopes": ["lift"]}).json()["token"])


def test_web_pages_open_streams_only_from_allowed_origins(
    http: httpx2.Client, settings: Settings, model: str
) -> None:
    given = settings.model_copy(update={"cors_origins": "https://lab.example"})
    own = f"http://{http.base_url.host}:{http.base_url.port}"
    key = lifting_key(http)
    for origin in ("https://evil.example", "https://lab.example", f"{own}0", "null", ""):
        with pytest.raises(InvalidStatus) as refused, opened(http, origin=origin, key=key):
            pass
        assert refused.value.response.status_code == 403
        assert orjson.loads(refused.value.response.body)["code"] == "origin_not_allowed"
    with pytest.raises(InvalidStatus) as refused, opened(http, origin=own):
        pass  # of this machine's user, but not of the page
    assert refused.value.response.status_code == 401
    with started(http, model, origin=own, key=page_key(http)):
        pass
    with served(given) as other:
        key = lifting_key(other)
        with started(other, model, origin="https://lab.example", key=key), started(other, model):
            pass
        with pytest.raises(InvalidStatus), opened(other, origin="https://evil.example", key=key):
            pass


def test_the_service_closes_its_streams_as_it_stops(settings: Settings, model: str) -> None:
    with ExitStack() as stack:
        with served(settings) as http:
            socket = stack.enter_context(started(http, model))
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=300)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1012


def test_the_example_in_bytes_works(
    http: httpx2.Client, model: str, capture: SyntheticCapture, tmp_path: Path
) -> None:
    script = Path(__file__).parents[3] / "examples" / "stream_bytes.py"
    np.save(tmp_path / "keypoints.npy", capture.keypoints)
    url = f"ws://{http.base_url.host}:{http.base_url.port}/lift/stream"
    done = subprocess.run(
        [sys.executable, str(script), url, model, "keypoints.npy", "50"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    found = [int(n) for n in re.findall(r"^frame (\d+): .* px", done.stdout, re.MULTILINE)]
    given = [
        n for line in re.findall(r'"sequences":(\[.*\])', done.stdout) for n in orjson.loads(line)
    ]
    assert sorted(found + given) == list(range(60))
    assert 59 in found


def test_a_request_without_a_websocket_is_refused(api: TestClient) -> None:
    response = api.get("/lift/stream")
    assert "ws://" in problem(response, 426, "upgrade_required")
    assert response.headers["upgrade"] == "websocket"


def test_every_message_is_in_the_openapi_document(api: TestClient) -> None:
    document = api.get("/openapi.json").json()
    schemas = document["components"]["schemas"]
    for path in ("/lift/stream", "/lift/streams/{stream_id}/watch"):
        for messages in document["paths"][path]["get"]["x-websocket"].values():
            for reference in messages["oneOf"]:
                name = reference["$ref"].rpartition("/")[2]
                kind = getattr(stream_messages, name, None) or getattr(watch_messages, name)
                kind.model_validate(schemas[name]["example"])
