"""Frames with times: streams with a lag, and requests, are smoothed as films are."""

from collections.abc import Iterator
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from fewview import Client
from fewview.api.stream_messages import Answer
from websockets.sync.client import ClientConnection

from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.settings.times import MAX_LAG
from models.training.trainer import fit
from service.settings import Settings
from service.wire.stream_messages import StreamError
from tests.models.lifting.comparison import without
from tests.models.walk import film
from tests.service.conftest import BYTES, JSON, frames_of, nested, problem, served, to_npz
from tests.service.realtime.conftest import (
    Array,
    as_bytes,
    as_json,
    bridged,
    opened,
    read_bytes,
    read_json,
    started,
)
from tests.sharing import fitted_once

FRAMES, FPS, NOISE = 300, 50.0, 8.0
MOMENTS = np.arange(FRAMES, dtype=np.float64)
TIMES = MOMENTS / FPS
AZIMUTHS = [0.0, 90.0, 200.0]
CLEAN = film(AZIMUTHS, MOMENTS).astype(np.float32)
NOISY = film(AZIMUTHS, MOMENTS, noise=NOISE).astype(np.float32)
# What comes after the fit: of its own frames a fit knows much without times, too.
LATER_CLEAN = film(AZIMUTHS, MOMENTS + FRAMES).astype(np.float32)
LATER = (LATER_CLEAN + NOISE * np.random.default_rng(1).standard_normal(CLEAN.shape)).astype(
    np.float32
)


@pytest.fixture(scope="module")
def prior() -> FittedPrior:
    config = FitConfig(steps=40, batch_size=16, refine="off")
    made = fitted_once("film", lambda: fit(NOISY, config, times=TIMES))
    assert made.smooths
    return made


@pytest.fixture(scope="module")
def http(settings: Settings) -> Iterator[httpx2.Client]:
    with served(settings) as client:
        yield client


@pytest.fixture(scope="module")
def smoothing(http: httpx2.Client, prior: FittedPrior) -> str:
    """Return the model that smooths; `model` does not."""
    response = http.post("/models?name=film", content=prior.to_bytes(), headers=BYTES)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def timed(sequence: int, keypoints: Array, time: float | None, form: str) -> str | bytes:
    """Return a frame with its time, in the layout of docs/streaming.md."""
    if form == "json":
        message = orjson.loads(as_json(sequence, keypoints))
        return orjson.dumps(message if time is None else message | {"time": time}).decode()
    data = as_bytes(sequence, keypoints)
    if time is None:
        return data
    return bytes([1, data[1] | 2]) + data[2:8] + np.float64(time).tobytes() + data[8:]


def flush(socket: ClientConnection) -> None:
    socket.send('{"flush": true}')


def received(socket: ClientConnection, count: int) -> list[tuple[int, Array]]:
    """Return sequence and structure of so many answers."""
    answers = []
    for _ in range(count):
        message = socket.recv(timeout=300)
        if isinstance(message, bytes):
            found = read_bytes(message)
            answers.append((found.sequence, found.points))
        else:
            answer = read_json(message)
            answers.append((answer["sequence"], np.array(answer["frame"]["points3d"])))
    return answers


def off(prior: FittedPrior, points: Any) -> float:
    """Return how far structures of later frames are from those of keypoints without noise.

    These are not denoised, as that would bring them to where noisy ones are brought.
    """
    clear = without(prior, "denoiser", "motion").lift(LATER_CLEAN[: len(points)]).points3d
    return float(np.linalg.norm(np.array(points) - clear, axis=-1).mean())


@pytest.mark.parametrize("options", [(), (f"--fps={FPS}",)])
def test_the_bridge_passes_smoothed_frames_on_to_the_last(
    http: httpx2.Client, smoothing: str, prior: FittedPrior, options: tuple[str, ...]
) -> None:
    """A detector that begins anew begins another film."""
    lag, count = 3, 12
    following, expected = prior.follow(lag=lag), []
    for n in range(count):
        observed = following.push(NOISY[n : n + 1], None, n / FPS)
        expected += [] if observed is None else [*prior.lift_observed(observed).points3d]
    last = following.flush()
    assert last is not None
    expected += [*prior.lift_observed(last).points3d]
    frames = [{"sequence": n, "keypoints": nested(NOISY[n]), "time": n / FPS} for n in range(count)]
    found = bridged(http, smoothing, frames[-3:] + frames, "--frame=canonical", "--lag=3", *options)
    for n in range(count - 3):
        np.testing.assert_allclose(found[n], expected[n], atol=1e-4)


@pytest.mark.parametrize("form", ["json", "bytes"])
def test_smoothed_frames_come_late_in_their_order_and_are_truer(
    http: httpx2.Client, smoothing: str, prior: FittedPrior, form: str
) -> None:
    lag = 5
    with started(http, smoothing, lag=lag) as socket:
        answers = []
        for n in range(FRAMES):
            socket.send(timed(7 * n, LATER[n], float(TIMES[n]), form))
            if n >= lag:
                answers += received(socket, 1)
                assert answers[-1][0] == 7 * (n - lag)
        flush(socket)
        answers += received(socket, lag)
    assert [sequence for sequence, _ in answers] == list(range(0, 7 * FRAMES, 7))
    alone = off(prior, prior.lift(LATER).points3d)
    assert off(prior, [points for _, points in answers]) < 0.9 * alone


def test_the_answers_are_those_of_the_library_and_a_flush_begins_anew(
    http: httpx2.Client, smoothing: str, prior: FittedPrior
) -> None:
    views, lag = [2, 0], 3
    keypoints = NOISY[:30, views].copy()
    keypoints[10:14, 1, 4] = np.nan
    following = prior.follow(views=views, lag=lag)
    expected: list[Array] = []
    with started(http, smoothing, lag=lag, fps=FPS, views=views) as socket:
        for _ in range(2):
            for n, frame in enumerate(keypoints):
                socket.send(as_bytes(n, frame))
                observed = following.push(frame[None], None, n / FPS)
                expected += [] if observed is None else [*prior.lift_observed(observed).points3d]
            flush(socket)
            observed = following.flush()
            assert observed is not None
            expected += [*prior.lift_observed(observed).points3d]
        answers = received(socket, len(expected))
    assert [sequence for sequence, _ in answers] == 2 * [*range(30)]
    np.testing.assert_allclose([points for _, points in answers], expected, atol=1e-4)


def test_with_a_lag_longer_than_the_film_it_is_the_lift_of_all_frames(
    http: httpx2.Client, smoothing: str, prior: FittedPrior
) -> None:
    """The poses that the fit knows come on top of what smoothing does."""
    count = MAX_LAG
    with started(http, smoothing, lag=MAX_LAG, fps=FPS) as socket:
        for n in range(count):
            socket.send(as_bytes(n, NOISY[n]))
        flush(socket)
        points = np.array([points for _, points in received(socket, count)])
    whole = prior.lift(NOISY[:count], times=TIMES[:count]).points3d
    truth = prior.lift(CLEAN[:count]).points3d
    apart, wrong = (np.linalg.norm(other - truth, axis=-1).mean() for other in (points, whole))
    assert apart < 1.1 * wrong


def test_frames_that_still_wait_are_not_answered(http: httpx2.Client, smoothing: str) -> None:
    with started(http, smoothing, lag=3, fps=FPS) as socket:
        for n in range(3):
            socket.send(as_bytes(n, NOISY[n]))
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.5)
        socket.send(as_bytes(3, NOISY[3]))
        assert received(socket, 1)[0][0] == 0


def test_stale_frames_are_gaps_and_the_last_one_is_answered(
    http: httpx2.Client, smoothing: str, prior: FittedPrior
) -> None:
    answered: list[tuple[int, Array]] = []
    dropped: list[int] = []
    with started(http, smoothing, lag=2, fps=FPS, on_overload="latest") as socket:
        for n in range(FRAMES):
            socket.send(as_bytes(n, NOISY[n]))
        flush(socket)
        while FRAMES - 1 not in [n for n, _ in answered]:
            message = socket.recv(timeout=300)
            if isinstance(message, str):
                dropped += orjson.loads(message)["sequences"]
            else:
                found = read_bytes(message)
                answered.append((found.sequence, found.points))
    numbers = [n for n, _ in answered]
    assert numbers == sorted(numbers)
    assert sorted(numbers + dropped) == list(range(FRAMES))
    assert np.isfinite([points for _, points in answered]).all()


def test_continuity_and_a_lag_go_together(
    http: httpx2.Client, smoothing: str, prior: FittedPrior
) -> None:
    with started(http, smoothing, lag=1, fps=FPS, continuity=True, refine="full") as socket:
        for n in range(20):
            socket.send(as_bytes(n, NOISY[n]))
        flush(socket)
        assert [n for n, _ in received(socket, 20)] == [*range(20)]


@pytest.mark.parametrize("form", ["json", "bytes"])
@pytest.mark.parametrize(
    ("fps", "sequence", "time", "pointer"),
    [
        (None, 9, None, "/time"),
        (None, 9, 0.1, "/time"),
        (None, 9, 0.05, "/time"),
        (None, 9, 1e13, "/time"),
        (FPS, 9, 0.2, "/time"),
        (FPS, 5, None, "/sequence"),
        (FPS, 4, None, "/sequence"),
    ],
)
def test_a_frame_with_a_wrong_time_is_an_error_and_the_stream_goes_on(
    http: httpx2.Client,
    smoothing: str,
    form: str,
    fps: float | None,
    sequence: int,
    time: float | None,
    pointer: str,
) -> None:
    more: dict[str, Any] = {} if fps is None else {"fps": fps}
    with started(http, smoothing, lag=0, **more) as socket:
        socket.send(timed(5, NOISY[0], None if fps else 0.1, form))
        socket.send(timed(sequence, NOISY[1], time, form))
        socket.send(timed(10, NOISY[2], None if fps else 0.2, form))
        assert received(socket, 1)[0][0] == 5
        error = StreamError.model_validate_json(socket.recv(timeout=300))
        assert (error.code, error.sequence) == ("invalid_input", sequence)
        assert [item.pointer for item in error.errors] == [pointer]
        assert received(socket, 1)[0][0] == 10


@pytest.mark.parametrize(
    ("message", "pointer"),
    [
        ({"flush": False}, "/flush"),
        ({"flush": True, "sequence": 1}, "/sequence"),
        ({"sequence": 1, "keypoints": [], "time": "now"}, "/time"),
        (timed(1, NOISY[0], float("nan"), "bytes"), "/time"),
        (timed(1, NOISY[0, :2], 0.0, "bytes"), "/views"),
        (timed(1, NOISY[0], 0.0, "bytes")[:-8], "/keypoints"),
        (b"\x01\x04" + as_bytes(1, NOISY[0])[2:], "/flags"),
    ],
)
def test_messages_that_are_wrong_with_a_lag(
    http: httpx2.Client, smoothing: str, message: Any, pointer: str
) -> None:
    with started(http, smoothing, lag=0) as socket:
        socket.send(orjson.dumps(message).decode() if isinstance(message, dict) else message)
        error = StreamError.model_validate_json(socket.recv(timeout=300))
        assert pointer in [item.pointer for item in error.errors]


def test_without_a_lag_there_are_no_times_and_no_flush(http: httpx2.Client, smoothing: str) -> None:
    with started(http, smoothing) as socket:
        for message, pointer in (
            (timed(1, NOISY[0], 0.0, "json"), "/time"),
            (timed(1, NOISY[0], 0.0, "bytes"), "/flags"),
            ('{"flush": true}', "/flush"),
        ):
            socket.send(message)
            error = StreamError.model_validate_json(socket.recv(timeout=300))
            assert pointer in [item.pointer for item in error.errors]


@pytest.mark.parametrize(
    ("start", "pointer"),
    [
        ({"lag": -1}, "/lag"),
        ({"lag": MAX_LAG + 1}, "/lag"),
        ({"lag": 2, "fps": 0}, "/fps"),
        ({"fps": 50}, "/fps"),
        ({"lag": 2, "views": [0, 3]}, "/views"),
    ],
)
def test_a_wrong_start_says_what_is_wrong(
    http: httpx2.Client, smoothing: str, start: dict[str, Any], pointer: str
) -> None:
    with opened(http) as socket:
        socket.send(orjson.dumps({"model": smoothing, **start}).decode())
        error = StreamError.model_validate_json(socket.recv(timeout=300))
        assert pointer in [item.pointer for item in error.errors]


def test_a_model_that_does_not_smooth_has_no_lag(http: httpx2.Client, model: str) -> None:
    with opened(http) as socket:
        socket.send(orjson.dumps({"model": model, "lag": 2}).decode())
        error = StreamError.model_validate_json(socket.recv(timeout=300))
        assert [item.pointer for item in error.errors] == ["/lag"]
        assert "with `fps` or `times`" in error.detail


def test_the_client_streams_with_a_lag(
    http: httpx2.Client, smoothing: str, prior: FittedPrior
) -> None:
    with (
        Client(str(http.base_url)) as client,
        client.stream(smoothing, lag=2, uncertainty="full") as stream,
    ):
        for n in range(10):
            stream.send(NOISY[n], time=TIMES[n])
        stream.flush()
        answers = [stream.receive() for _ in range(10)]
        assert all(isinstance(answer, Answer) and answer.lifted for answer in answers)
        for answer in answers:
            assert isinstance(answer, Answer)
            assert answer.points3d_modes is not None
            assert answer.points3d_modes.shape == (NOISY.shape[2], 3, 12)
        with pytest.raises(ValueError, match="answers wait for later frames"):
            stream.lift(NOISY[10], time=TIMES[10])


@pytest.mark.parametrize("form", ["json", "npz", "client"])
def test_a_request_with_times_is_smoothed_as_the_library_does(
    http: httpx2.Client, smoothing: str, prior: FittedPrior, form: str
) -> None:
    frames = slice(0, 60)
    if form == "client":
        with Client(str(http.base_url)) as client:
            points = client.lift(smoothing, LATER[frames], times=TIMES[frames]).points3d
    else:
        body: Any = {"keypoints": LATER[frames], "times": TIMES[frames]}
        if form == "json":
            body = {"frames": frames_of(LATER[frames]), "times": TIMES[frames].tolist()}
            sent = orjson.dumps({"model": smoothing, **body})
            response = http.post("/lift", content=sent, headers=JSON)
        else:
            url = f"/lift?model={smoothing}"
            response = http.post(url, content=to_npz(**body), headers=BYTES)
        assert response.status_code == 200, response.text
        points = np.array([frame["points3d"] for frame in response.json()["frames"]])
    expected = prior.lift(LATER[frames], times=TIMES[frames]).points3d
    np.testing.assert_allclose(points, expected, atol=1e-3)
    assert off(prior, points) < 0.9 * off(prior, prior.lift(LATER[frames]).points3d)


@pytest.mark.parametrize("count", [1, 3, 8])
def test_few_frames_with_times_are_lifted_one_by_one(
    http: httpx2.Client, smoothing: str, prior: FittedPrior, count: int
) -> None:
    with Client(str(http.base_url)) as client:
        points = client.lift(smoothing, NOISY[:count], times=TIMES[:count]).points3d
    np.testing.assert_allclose(points, prior.lift(NOISY[:count]).points3d, atol=1e-4)


def test_times_of_a_model_that_does_not_smooth_change_nothing(
    http: httpx2.Client, model: str
) -> None:
    with Client(str(http.base_url)) as client:
        with_times = client.lift(model, NOISY[:20], times=TIMES[:20]).points3d
        np.testing.assert_array_equal(with_times, client.lift(model, NOISY[:20]).points3d)


@pytest.mark.parametrize(
    "times",
    [[0.0], [0.0, 0.1, 0.1], [0.0, 0.2, 0.1], [0.0, 0.1, None], [0.0, 0.1, 1e13], "now", 3],
)
def test_wrong_times_are_errors(http: httpx2.Client, smoothing: str, times: Any) -> None:
    body = {"model": smoothing, "frames": frames_of(NOISY[:3]), "times": times}
    response = http.post("/lift", content=orjson.dumps(body), headers=JSON)
    assert response.status_code == 422, response.text
    assert response.json()["errors"][0]["pointer"].startswith("/times")
    if isinstance(times, list) and None not in times:
        file = to_npz(frames=NOISY[:3], times=np.array(times))
        url = f"/lift?model={smoothing}"
        problem(http.post(url, content=file, headers=BYTES), 422, "invalid_input", "/times")
