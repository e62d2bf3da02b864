"""How far points may be off: as much of it as is asked for, in lifts and in streams."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from fewview import Client
from pydantic import TypeAdapter
from safetensors.numpy import load

from models.lifting.lift import LiftedFrames
from models.posterior.quality import NO_EVIDENCE
from models.settings.uncertainty import ARRAYS, Uncertainty
from service.settings import Settings
from service.wire.schemas import LiftedFrame
from tests.models.posterior.test_deviations import LATER, capture, prior
from tests.service.conftest import BYTES, JSON, frames_of, problem, served, to_safetensors
from tests.service.realtime.conftest import (
    KEYPOINTS,
    as_bytes,
    as_json,
    opened,
    quality_in,
    read_bytes,
    read_json,
    started,
    uncertainty_in,
)

KINDS: tuple[Uncertainty, ...] = ("off", "sd", "full")
FRAMES = capture().keypoints[LATER].astype(np.float32)[:6]
FRAMES[3] = np.nan  # nobody is seen
FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@pytest.fixture(scope="module")
def http(settings: Settings) -> Iterator[httpx2.Client]:
    with served(settings) as client:
        yield client


@pytest.fixture(scope="module")
def model(http: httpx2.Client) -> str:
    made = http.post("/models", content=prior().to_bytes(), headers=BYTES)
    return str(made.json()["id"])


@pytest.fixture(scope="module")
def expected() -> LiftedFrames:
    return prior().lift(FRAMES, uncertainty="full")


def lifted(http: httpx2.Client, model: str, query: str) -> dict[str, Any]:
    url = f"/lift?model={model}&format=safetensors&{query}"
    answer = http.post(url, content=to_safetensors(keypoints=FRAMES), headers=BYTES)
    assert answer.status_code == 200, answer.text
    return load(answer.content)


def check(found: dict[str, Any], kind: Uncertainty, expected: LiftedFrames) -> None:
    """Hold arrays (N, ...) against those of the library; others may not be there."""
    assert found.keys() & ARRAYS["full"].keys() == ARRAYS[kind].keys()
    for name in ARRAYS[kind]:
        np.testing.assert_allclose(
            found[name], getattr(expected, name), rtol=1e-3, atol=1e-6, err_msg=name
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_lift_has_as_much_as_is_asked_for(
    http: httpx2.Client, model: str, expected: LiftedFrames, kind: Uncertainty
) -> None:
    assert np.isfinite(expected.points3d_modes[[0, 1, 2, 4, 5]]).all()
    arrays = lifted(http, model, f"uncertainty={kind}")
    check(arrays, kind, expected)
    if kind == "sd":
        assert lifted(http, model, "").keys() == arrays.keys()  # the default
    body = {"model": model, "frames": frames_of(FRAMES), "uncertainty": kind}
    answer = http.post("/lift?uncertainty=sd", content=orjson.dumps(body), headers=JSON)
    frames = answer.json()["frames"]
    TypeAdapter(list[LiftedFrame]).validate_python(frames)
    for n, frame in enumerate(frames):
        assert ("points3d_covariance" in frame) == ("points3d_modes" in frame) == (kind == "full")
        assert (frame["points3d_sd"] is None) == (kind == "off" or n == 3)
        for name in ARRAYS[kind]:
            nothing = np.full_like(arrays[name][n], np.nan)
            mine = nothing if frame[name] is None else np.array(frame[name], np.float32)
            np.testing.assert_array_equal(mine, arrays[name][n])


def test_a_point_without_an_answer_has_none(http: httpx2.Client, model: str) -> None:
    """Of frames in weak perspective nothing is known."""
    body = {"model": model, "frames": frames_of(FRAMES[:1]), "refine": "off", "uncertainty": "full"}
    [frame] = http.post("/lift", json=body).json()["frames"]
    assert frame["points3d"] is not None
    assert frame["points3d_sd"] is frame["points3d_covariance"] is frame["points3d_modes"] is None


def test_in_the_room_covariances_are_turned_and_scaled_as_points_are(
    http: httpx2.Client, model: str
) -> None:
    plain = lifted(http, model, "uncertainty=full")
    placed = lifted(http, model, "uncertainty=full&frame=room&up=0,-1,0")
    points = np.argwhere(np.isfinite(placed["points3d_sd"]))
    assert len(points) == 5 * KEYPOINTS
    for n, p in points:
        turn = placed["rotations"][n, 0].T.astype(np.float64) @ plain["rotations"][n, 0]
        assert np.abs(turn - np.eye(3)).max() > 0.1
        size = np.linalg.norm(placed["points3d"][n, 0] - placed["points3d"][n, 9])
        size /= np.linalg.norm(plain["points3d"][n, 0] - plain["points3d"][n, 9])
        before = plain["points3d_covariance"][n, p][FULL]
        after = placed["points3d_covariance"][n, p][FULL]
        near = 1e-4 * np.trace(after)
        np.testing.assert_allclose(after, size**2 * turn @ before @ turn.T, atol=near)
        assert placed["points3d_sd"][n, p] ** 2 == pytest.approx(np.trace(after), rel=1e-4)
        np.testing.assert_allclose(
            placed["points3d_modes"][n, p],
            size * turn @ plain["points3d_modes"][n, p],
            atol=np.sqrt(near),
        )


def test_where_the_first_camera_is_static_the_room_has_the_unit_of_the_lift(
    http: httpx2.Client, model: str
) -> None:
    plain, placed = lifted(http, model, ""), lifted(http, model, "frame=room")
    np.testing.assert_allclose(placed["points3d_sd"], plain["points3d_sd"], rtol=1e-4)


def test_streams_have_as_much_as_each_asked_for(
    http: httpx2.Client, model: str, expected: LiftedFrames
) -> None:
    """Three at once, whose frames are lifted together with none of the others."""

    def conversation(kind: Uncertainty) -> None:
        with started(http, model, uncertainty=kind) as socket:
            for n in range(30):
                socket.send((as_json if n % 2 else as_bytes)(n, FRAMES[n % 6]))
            for n in range(30):
                message = socket.recv(timeout=300)
                if n % 2:
                    frame = read_json(message)["frame"]
                    found = {
                        name: np.array(frame[name], np.float32)
                        for name in ARRAYS["full"]
                        if frame.get(name) is not None
                    }
                    if n % 6 == 3:
                        assert found == {}
                        continue
                else:
                    assert read_bytes(message).sequence == n
                    found = uncertainty_in(message)
                    if kind != "off":
                        quality, reason = quality_in(message)
                        assert quality == pytest.approx(expected.quality[n % 6], rel=1e-3)
                        assert reason == expected.quality_reason[n % 6]
                one = {name: array[None] for name, array in found.items()}
                check(one, kind, expected.frames(slice(n % 6, n % 6 + 1)))

    with ThreadPoolExecutor(6) as threads:
        for done in [threads.submit(conversation, kind) for kind in KINDS * 2]:
            done.result()


def test_the_client_reads_the_quality_of_frames(
    http: httpx2.Client, model: str, expected: LiftedFrames
) -> None:
    with Client(str(http.base_url)) as client:
        for kind in KINDS:
            with client.stream(model, uncertainty=kind) as stream:
                for n in (0, 3):
                    answer = stream.lift(FRAMES[n])
                    if kind == "off":
                        assert answer.quality is answer.quality_reason is None
                        continue
                    assert answer.quality == pytest.approx(expected.quality[n], rel=1e-3)
                    assert answer.quality_reason == expected.quality_reason[n]
    assert expected.quality_reason[3] == NO_EVIDENCE


def test_the_start_of_a_stream_says_how_long_it_is(http: httpx2.Client, model: str) -> None:
    for start, kind, numbers in (({}, "sd", 1), ({"uncertainty": "off"}, "off", 0)):
        with opened(http) as socket:
            socket.send(orjson.dumps({"model": model, **start}).decode())
            ready = orjson.loads(socket.recv(timeout=300))
        assert ready["uncertainty"] == kind
        assert ready["uncertainty_bytes"] == 4 * KEYPOINTS * numbers
        assert ready["quality_bytes"] == 8 * numbers
    with opened(http) as socket:
        socket.send(orjson.dumps({"model": model, "uncertainty": "full"}).decode())
        length = orjson.loads(socket.recv(timeout=300))["uncertainty_bytes"]
        socket.send(as_bytes(0, FRAMES[0]))
        message = socket.recv(timeout=300)
    arrays = uncertainty_in(message)
    assert length == sum(array.nbytes for array in arrays.values())
    assert len(arrays) == 3


def test_what_is_no_uncertainty_is_refused(http: httpx2.Client, model: str) -> None:
    body = {"model": model, "frames": frames_of(FRAMES[:1]), "uncertainty": "some"}
    problem(http.post("/lift", json=body), 422, "invalid_input", "/uncertainty")
    octets = to_safetensors(keypoints=FRAMES)
    answer = http.post(f"/lift?model={model}&uncertainty=all", content=octets, headers=BYTES)
    problem(answer, 422, "invalid_input", "/uncertainty")
