"""The stream: every frame answered in its order and form, whatever else happens."""

import re
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from models.capture.synthetic import SyntheticCapture
from models.lifting.lift import CAMERA_MODELS
from service.settings import Settings
from service.wire import stream_messages
from service.wire.stream_messages import StreamAnswer, StreamDropped, StreamError, StreamReady
from tests.service.conftest import (
    BYTES,
    JSON,
    frames_of,
    nested,
    problem,
    served,
    wait_for,
)

Array = np.ndarray[Any, Any]

VIEW = np.dtype(
    "<i4, (3,3)<f4, <f4, 3<f4, 2<f4, 2<f4, 8<f4, <f4",
)
VIEW.names = (
    "camera",
    "rotation",
    "scale",
    "translation",
    "focal",
    "principal_point",
    "distortion",
    "reprojection_error",
)


@pytest.fixture(scope="module")
def http(settings: Settings, model: str) -> Iterator[httpx2.Client]:
    with served(settings) as client:
        yield client


@contextmanager
def opened(http: httpx2.Client) -> Iterator[ClientConnection]:
    url = f"ws://{http.base_url.host}:{http.base_url.port}/lift/stream"
    with connect(url, compression=None, proxy=None) as socket:
        yield socket


@contextmanager
def started(http: httpx2.Client, model: str, **more: Any) -> Iterator[ClientConnection]:
    with opened(http) as socket:
        socket.send(orjson.dumps({"model": model, **more}).decode())
        ready = StreamReady.model_validate_json(socket.recv(timeout=60))
        assert ready.model == model
        assert ready.keypoints == 16
        yield socket


def as_bytes(sequence: int, keypoints: Array, confidence: Array | None = None) -> bytes:
    """Return a frame (K, P, 2) in the layout of docs/streaming.md."""
    data = struct.pack("<BBHI", 1, confidence is not None, len(keypoints), sequence)
    data += keypoints.astype("<f4").tobytes()
    return data if confidence is None else data + confidence.astype("<f4").tobytes()


def as_json(sequence: int, keypoints: Array) -> str:
    frame = [nested(view) for view in keypoints]
    return orjson.dumps({"sequence": sequence, "keypoints": frame}).decode()


def read_bytes(data: str | bytes) -> tuple[int, int, Array, Array]:
    """Return sequence, flags, points3d (P, 3) and views of an answer in bytes."""
    assert isinstance(data, bytes), data
    kind, flags, count, sequence = struct.unpack_from("<BBHI", data)
    assert kind == 2
    points = np.frombuffer(data[8 : len(data) - count * 108], "<f4").reshape(-1, 3)
    return sequence, flags, points, np.frombuffer(data[len(data) - count * 108 :], VIEW)


def read_json(data: str | bytes) -> dict[str, Any]:
    assert isinstance(data, str)
    StreamAnswer.model_validate_json(data)
    found: dict[str, Any] = orjson.loads(data)
    return found


def lifted(http: httpx2.Client, model: str, keypoints: Array, **more: Any) -> list[dict[str, Any]]:
    body = {"model": model, "frames": frames_of(keypoints), **more}
    response = http.post("/lift", content=orjson.dumps(body), headers=JSON)
    assert response.status_code == 200, response.text
    found: list[dict[str, Any]] = response.json()["frames"]
    return found


def check(points: Any, views: Any, expected: dict[str, Any]) -> None:
    """Compare the structure and the cameras in bytes with an answer of POST /lift."""
    if expected["status"] != "ok":
        assert np.isnan(points).all()
        return
    np.testing.assert_allclose(points, expected["points3d"], rtol=1e-3, atol=1e-4)
    for view, other in zip(views, expected["views"], strict=True):
        if other is None:
            assert view["camera"] == -1
            assert np.isnan(view["scale"])
            continue
        assert CAMERA_MODELS[view["camera"]] == other["camera"]
        for name in ("rotation", "scale", "focal", "principal_point", "reprojection_error"):
            if other[name] is None:
                assert np.isnan(view[name]).all()
            else:
                np.testing.assert_allclose(view[name], other[name], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("refine", ["off", "full"])
def test_answers_are_those_of_a_lift_in_the_order_and_form_of_the_frames(
    http: httpx2.Client, model: str, capture: SyntheticCapture, refine: str
) -> None:
    """Of 60 frames sent at once, the odd ones as JSON."""
    expected = lifted(http, model, capture.keypoints, refine=refine)
    with started(http, model, refine=refine) as socket:
        for n, keypoints in enumerate(capture.keypoints):
            socket.send((as_json if n % 2 else as_bytes)(1000 + n, keypoints))
        for n, known in enumerate(expected):
            message = socket.recv(timeout=60)
            if n % 2:
                answer = read_json(message)
                assert answer["sequence"] == 1000 + n
                assert answer["continued"] is False
                assert answer["frame"]["status"] == known["status"]
                np.testing.assert_allclose(
                    answer["frame"]["points3d"], known["points3d"], rtol=1e-3, atol=1e-4
                )
            else:
                sequence, flags, points, views = read_bytes(message)
                assert sequence == 1000 + n
                assert flags == 1
                check(points, views, known)


def test_views_and_confidence(http: httpx2.Client, model: str, capture: SyntheticCapture) -> None:
    keypoints, confidence = capture.keypoints[:3, [2, 0]], capture.confidence[:3, [2, 0]] / 2
    expected = lifted(http, model, keypoints, confidence=confidence.tolist(), views=[2, 0])
    with started(http, model, views=[2, 0]) as socket:
        for n in range(3):
            socket.send(as_bytes(n, keypoints[n], confidence[n]))
            sequence, _, points, views = read_bytes(socket.recv(timeout=60))
            assert sequence == n
            check(points, views, expected[n])
            socket.send(
                orjson.dumps(
                    {
                        "sequence": n,
                        "keypoints": frames_of(keypoints[n : n + 1])[0],
                        "confidence": confidence[n].tolist(),
                    }
                ).decode()
            )
            answer = read_json(socket.recv(timeout=60))
            np.testing.assert_allclose(answer["frame"]["points3d"], points, rtol=1e-3, atol=1e-4)


def test_a_frame_that_shows_too_little_says_so(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    nothing = np.full_like(capture.keypoints[0], np.nan)
    with started(http, model) as socket:
        socket.send(as_bytes(5, nothing))
        sequence, flags, points, views = read_bytes(socket.recv(timeout=60))
        assert (sequence, flags) == (5, 0)
        assert np.isnan(points).all()
        assert (views["camera"] == -1).all()
        socket.send(as_json(6, nothing))
        assert read_json(socket.recv(timeout=60))["frame"]["status"] == "too_few_keypoints"


def test_with_continuity_a_frame_may_start_from_the_one_before(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    """Of a figure that hardly moves, between two others; each stream continues its own."""
    still = np.repeat(capture.keypoints[:1], 10, axis=0)
    still += np.random.default_rng(0).normal(0, 0.05, still.shape).astype(np.float32)
    frames = [*still, capture.keypoints[30], *capture.keypoints[40:43, :2]]
    for continuity, refine in ((True, "full"), (False, "full"), (True, "off")):
        continued = []
        with started(http, model, continuity=continuity, refine=refine) as socket:
            for n, keypoints in enumerate(frames):
                socket.send((as_json if n == 5 else as_bytes)(n, keypoints))
            for n in range(len(frames)):
                message = socket.recv(timeout=60)
                if n == 5:
                    continued.append(read_json(message)["continued"])
                    continue
                sequence, flags, points, _ = read_bytes(message)
                assert sequence == n
                assert flags & 1
                continued.append(flags & 2 == 2)
                if n < len(still):
                    known = lifted(http, model, still[n : n + 1], refine=refine)[0]
                    np.testing.assert_allclose(points, known["points3d"], atol=0.05)
        if continuity and refine == "full":
            assert not continued[0]
            assert sum(continued[1:10]) >= 5
            assert not continued[11]  # the first of two views
        else:
            assert not any(continued)


def test_streams_do_not_mix(http: httpx2.Client, model: str, capture: SyntheticCapture) -> None:
    """Six clients at once, each with frames and sequence numbers of its own."""
    expected = lifted(http, model, capture.keypoints, refine="off")
    wrong: list[object] = []

    def client(start: int) -> None:
        try:
            with started(http, model, refine="off") as socket:
                for n in range(start, start + 50):
                    socket.send(as_bytes(n, capture.keypoints[n % 60]))
                for n in range(start, start + 50):
                    sequence, _, points, views = read_bytes(socket.recv(timeout=60))
                    assert sequence == n
                    check(points, views, expected[n % 60])
        except Exception as error:  # noqa: BLE001 - for the main thread to show
            wrong.append(error)

    threads = [threading.Thread(target=client, args=(1000 * k + 7 * k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def flood(socket: ClientConnection, keypoints: Array, count: int) -> None:
    for n in range(count):
        socket.send(as_bytes(n, keypoints[n % len(keypoints)]))


def test_all_frames_are_answered_however_fast_they_come(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    count = 1000
    with started(http, model, refine="off") as socket:
        sender = threading.Thread(target=flood, args=(socket, capture.keypoints, count))
        sender.start()
        answers = [read_bytes(socket.recv(timeout=60))[0] for _ in range(count)]
        sender.join()
    assert answers == list(range(count))


def test_stale_frames_are_dropped_and_told(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    count = 1000
    answered, dropped, seen = [], [], []
    with started(http, model, refine="full", on_overload="latest") as socket:
        flood(socket, capture.keypoints, count)
        while count - 1 not in answered:
            message = socket.recv(timeout=60)
            if isinstance(message, str):
                notice = StreamDropped.model_validate_json(message)
                assert notice.type == "dropped"
                dropped += notice.sequences
                seen += notice.sequences
            else:
                answered.append(read_bytes(message)[0])
                seen.append(answered[-1])
    assert dropped
    assert seen == list(range(count))


KEYPOINTS: list[Any] = [[[1.0, 2.0]] * 16] * 2
ZEROS = np.zeros((2, 16, 2))


@pytest.mark.parametrize(
    ("message", "code", "pointer", "sequence"),
    [
        ("{", "malformed_body", None, None),
        ("[]", "invalid_input", "", None),
        ({"keypoints": KEYPOINTS}, "invalid_input", "/sequence", None),
        ({"sequence": 7}, "invalid_input", "/keypoints", 7),
        ({"sequence": -1, "keypoints": KEYPOINTS}, "invalid_input", "/sequence", None),
        ({"sequence": 2**32, "keypoints": KEYPOINTS}, "invalid_input", "/sequence", None),
        ({"sequence": "7", "keypoints": KEYPOINTS}, "invalid_input", "/sequence", None),
        ({"sequence": 7, "keypoints": KEYPOINTS, "x": 1}, "invalid_input", "/x", 7),
        ({"sequence": 7, "keypoints": KEYPOINTS[:1]}, "invalid_input", "/views", 7),
        ({"sequence": 7, "keypoints": [[[1.0, 2.0]] * 15] * 2}, "invalid_input", "/keypoints", 7),
        ({"sequence": 7, "keypoints": [KEYPOINTS[0], [[1.0]] * 16]}, "invalid_input",
         "/keypoints/1/0", 7),
        ({"sequence": 7, "keypoints": KEYPOINTS, "confidence": [[2.0] * 16] * 2},
         "invalid_input", "/confidence", 7),
        (b"", "invalid_input", "", None),
        (b"\1\0", "invalid_input", "", None),
        (struct.pack("<BBHI", 2, 0, 2, 7) + ZEROS.astype("<f4").tobytes(), "invalid_input",
         "/kind", 7),
        (struct.pack("<BBHI", 1, 4, 2, 7) + ZEROS.astype("<f4").tobytes(), "invalid_input",
         "/flags", 7),
        (as_bytes(7, ZEROS)[:-1], "invalid_input", "/keypoints", 7),
        (as_bytes(7, ZEROS) + b"\0", "invalid_input", "/keypoints", 7),
        (as_bytes(7, ZEROS[:0]), "invalid_input", "/keypoints", 7),
        (as_bytes(7, ZEROS[:1]), "invalid_input", "/views", 7),
        (as_bytes(7, ZEROS + np.inf), "invalid_input", "/keypoints", 7),
        (as_bytes(7, ZEROS, ZEROS[..., 0] - 1), "invalid_input", "/confidence", 7),
    ],
)  # fmt: skip
def test_a_bad_frame_is_told_and_the_stream_goes_on(
    http: httpx2.Client,
    model: str,
    capture: SyntheticCapture,
    message: Any,
    code: str,
    pointer: str | None,
    sequence: int | None,
) -> None:
    with started(http, model, views=[0, 1]) as socket:
        socket.send(as_bytes(1, capture.keypoints[0, :2]))
        socket.send(orjson.dumps(message).decode() if isinstance(message, dict) else message)
        socket.send(as_bytes(2, capture.keypoints[1, :2]))
        assert read_bytes(socket.recv(timeout=60))[0] == 1
        error = StreamError.model_validate_json(socket.recv(timeout=60))
        assert (error.type, error.code, error.sequence) == ("error", code, sequence)
        assert [item.pointer for item in error.errors] == ([] if pointer is None else [pointer])
        assert error.detail
        assert read_bytes(socket.recv(timeout=60))[0] == 2


def ending(socket: ClientConnection) -> tuple[StreamError, int]:
    """Return the last message of a stream and its close code."""
    error = StreamError.model_validate_json(socket.recv(timeout=60))
    with pytest.raises(ConnectionClosed) as closed:
        socket.recv(timeout=60)
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
        ready = orjson.loads(socket.recv(timeout=60))
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
        assert read_bytes(socket.recv(timeout=60))[0] == 1
        assert http.delete(f"/models/{made}").status_code == 204
        socket.send(as_bytes(2, capture.keypoints[0]))
        error, closed = ending(socket)
    assert (error.code, closed) == ("not_found", 4404)


def test_messages_are_bounded(http: httpx2.Client, model: str) -> None:
    with started(http, model) as socket:
        socket.send(b"\1" + b"\0" * 256 * 1024)
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=60)
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


def test_the_service_closes_its_streams_as_it_stops(settings: Settings, model: str) -> None:
    with ExitStack() as stack:
        with served(settings) as http:
            socket = stack.enter_context(started(http, model))
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=60)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1012


def test_the_client_in_the_documentation_works(
    http: httpx2.Client, model: str, capture: SyntheticCapture, tmp_path: Path
) -> None:
    text = (Path(__file__).parents[3] / "docs" / "streaming.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (tmp_path / "stream.py").write_text(code)
    np.save(tmp_path / "keypoints.npy", capture.keypoints)
    url = f"ws://{http.base_url.host}:{http.base_url.port}/lift/stream"
    done = subprocess.run(
        [sys.executable, "stream.py", url, model, "keypoints.npy", "50"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    found = [int(n) for n in re.findall(r"^frame (\d+): .* px", done.stdout, re.MULTILINE)]
    told = [
        n for line in re.findall(r'"sequences":(\[.*\])', done.stdout) for n in orjson.loads(line)
    ]
    assert sorted(found + told) == list(range(60))
    assert 59 in found


def test_who_asks_without_a_websocket_is_told(api: TestClient) -> None:
    response = api.get("/lift/stream")
    assert "ws://" in problem(response, 426, "upgrade_required")
    assert response.headers["upgrade"] == "websocket"


def test_every_message_is_in_the_openapi_document(api: TestClient) -> None:
    document = api.get("/openapi.json").json()
    described = document["paths"]["/lift/stream"]["get"]["x-websocket"]
    schemas = document["components"]["schemas"]
    for side in ("client", "server"):
        for reference in described[side]["oneOf"]:
            name = reference["$ref"].rpartition("/")[2]
            getattr(stream_messages, name).model_validate(schemas[name]["example"])
