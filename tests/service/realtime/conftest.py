"""A served app whose streams are open to tests, and frames as they travel."""

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import httpx2
import numpy as np
import orjson
import pytest
from fewview import cli
from typer.testing import CliRunner
from websockets.sync.client import ClientConnection, connect

from models.lifting.lift import CAMERA_MODELS
from service.settings import Settings
from service.wire.stream_messages import StreamAnswer, StreamReady
from tests.service.conftest import (
    JSON,
    frames_of,
    nested,
    served,
)

Array = np.ndarray[Any, Any]
KEYPOINTS = 16  # of the models of these tests
QUALITY = 8  # bytes that end an answer

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


def bridged(
    http: httpx2.Client, model: str, frames: list[dict[str, Any]], *options: str
) -> dict[int, Array]:
    """Return the points (P, 3) that `fewview live` sends of each frame, by its sequence number."""
    lines = b"\n".join(map(orjson.dumps, frames))
    found: dict[int, Array] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0)
        to = f"--to=udp+json://127.0.0.1:{receiver.getsockname()[1]}"
        words = ["live", model, to, f"--url={http.base_url}", *options]
        ran = CliRunner().invoke(cli.app, words, input=lines)
        assert ran.exit_code == 0, ran.stderr
        with suppress(BlockingIOError):
            while True:
                pose = orjson.loads(receiver.recv(65536))
                points = [point["position"] for point in pose["points"]]
                found.setdefault(pose["sequence"], np.array(points))
    return found


@contextmanager
def opened(
    http: httpx2.Client, origin: str | None = None, key: str | None = None
) -> Iterator[ClientConnection]:
    url = f"ws://{http.base_url.host}:{http.base_url.port}/lift/stream"
    named = {} if origin is None else {"Origin": origin}
    if key is not None:
        named["Authorization"] = f"Bearer {key}"
    with connect(url, compression=None, proxy=None, additional_headers=named) as socket:
        yield socket


@contextmanager
def started(
    http: httpx2.Client,
    model: str,
    *,
    model_id: str | None = None,
    origin: str | None = None,
    key: str | None = None,
    **more: Any,
) -> Iterator[ClientConnection]:
    with opened(http, origin, key) as socket:
        socket.send(orjson.dumps({"model": model, **more}).decode())
        ready = StreamReady.model_validate_json(socket.recv(timeout=300))
        assert ready.model == (model_id or model)  # where an alias was asked for
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


class Answer(NamedTuple):
    """An answer in bytes."""

    sequence: int
    flags: int
    points: Array  # (P, 3)
    views: Array  # (K,) of VIEW
    seen: Array  # (P,) how many views show a keypoint
    outlying: Array  # (K, P) how probably it is an outlier


def read_bytes(data: str | bytes) -> Answer:
    assert isinstance(data, bytes), data
    kind, flags, count, sequence = struct.unpack_from("<BBHI", data)
    assert kind == 2
    keypoints = KEYPOINTS
    views_at = 8 + 12 * keypoints
    seen_at = views_at + 108 * count
    judged_at = seen_at + keypoints
    ends = judged_at + 4 * count * keypoints
    # `uncertainty_in` and `quality_in` have what follows.
    assert len(data) - ends in {0, *(4 * keypoints * n + QUALITY for n in (1, 43))}
    return Answer(
        sequence,
        flags,
        np.frombuffer(data[8:views_at], "<f4").reshape(-1, 3),
        np.frombuffer(data[views_at:seen_at], VIEW),
        np.frombuffer(data[seen_at:judged_at], np.uint8),
        np.frombuffer(data[judged_at:ends], "<f4").reshape(count, keypoints),
    )


def quality_in(data: str | bytes) -> tuple[float, int]:
    """Return the quality that ends an answer in bytes, and the number of its reason."""
    assert isinstance(data, bytes), data
    quality, reason = struct.unpack("<fB3x", data[-QUALITY:])
    return quality, reason


def uncertainty_in(data: str | bytes) -> dict[str, Array]:
    """Return the arrays of an answer in bytes that are how far its points may be off."""
    assert isinstance(data, bytes), data
    views = struct.unpack_from("<H", data, 2)[0]
    rest = data[8 + 13 * KEYPOINTS + views * (108 + 4 * KEYPOINTS) :]
    if not rest:
        return {}
    numbers = np.frombuffer(rest[:-QUALITY], "<f4")
    found = {"points3d_sd": numbers[:KEYPOINTS]}
    if numbers.size > KEYPOINTS:
        covariances, modes = np.split(numbers[KEYPOINTS:], [6 * KEYPOINTS])
        found["points3d_covariance"] = covariances.reshape(KEYPOINTS, 6)
        found["points3d_modes"] = modes.reshape(KEYPOINTS, 3, 12)
    return found


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
