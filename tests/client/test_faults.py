"""What the client does when the service is away, busy, or the line to it breaks."""

import asyncio
import threading
import time
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest
from fewview import ApiError, AsyncClient, Client, ConnectionFailed, TooManyRequests, Unavailable
from fewview.api.forms import Fit
from fewview.api.retries import patiently
from fewview.api.steps import Request, Send, Sleep, nothing

from tests.client.conftest import Served, a_capture
from tests.client.faulty import Line
from tests.client.hearing import hearing_streams
from tests.processes import free_port
from tests.service.conftest import CONFIG


@pytest.fixture
def line(served: Served) -> Iterator[Line]:
    found = Line(("127.0.0.1", urlsplit(served.live.url).port or 0), free_port())
    with found.open():
        yield found


def answer(status: int, **headers: str) -> httpx2.Response:
    request = httpx2.Request("GET", "http://fewview")
    return httpx2.Response(status, headers=headers, request=request)


def test_requests_wait_as_long_as_they_are_asked_to_and_ever_longer() -> None:
    steps = patiently(Send(Request("GET", "/fits", nothing)), patience=30)
    assert isinstance(next(steps), Send)
    asked = steps.send(answer(503, **{"Retry-After": "7"}))
    assert asked == Sleep(7)
    next(steps)
    pauses = []
    for _ in range(7):
        pause = steps.throw(ConnectionFailed("away"))
        assert isinstance(pause, Sleep)
        pauses.append(pause.seconds)
        next(steps)
    assert all(0.2 * 2**n <= pause <= 0.4 * 2**n for n, pause in enumerate(pauses[:3], 1))
    assert max(pauses) <= 10
    with pytest.raises(StopIteration):
        steps.send(answer(200))


def test_what_would_take_too_long_is_given_up_at_once() -> None:
    for status, kind in ((429, TooManyRequests), (503, Unavailable), (504, Unavailable)):
        steps = patiently(Send(Request("POST", "/fits", nothing)), patience=30)
        next(steps)
        with pytest.raises(kind):
            steps.send(answer(status, **{"Retry-After": "60"}))


def test_nobody_there_is_said_with_what_to_do() -> None:
    with (
        Client(f"http://127.0.0.1:{free_port()}", patience=0) as client,
        pytest.raises(ConnectionFailed, match="start the service with `fewview serve`"),
    ):
        client.health.ready()


@pytest.mark.parametrize("kind", ["blocking", "awaiting"])
def test_a_service_that_comes_back_is_reached(served: Served, kind: str) -> None:
    line = Line(("127.0.0.1", urlsplit(served.live.url).port or 0), free_port())
    done = threading.Event()

    def come_back() -> None:
        time.sleep(1)
        with line.open():
            done.wait(300)

    service = threading.Thread(target=come_back)
    service.start()

    async def get() -> Fit:
        async with AsyncClient(line.url) as client, client.stream(served.model) as stream:
            assert stream.ready.model == served.model
            return await client.fits.get(served.fit.id)

    try:
        if kind == "awaiting":
            found = asyncio.run(get())
        else:
            with Client(line.url) as client, client.stream(served.model) as stream:
                assert stream.ready.model == served.model
                found = client.fits.get(served.fit.id)
    finally:
        done.set()
        service.join()
    assert found == served.fit


def test_what_was_done_is_not_done_again_when_its_answer_is_lost(
    served: Served, line: Line
) -> None:
    line.faults = [(b"POST /datasets", 0), (b"DELETE", 0)]
    with Client(line.url) as client:
        dataset = client.datasets.create(a_capture(20), name="once")
        assert not line.faults[1:]
        assert [found.id for found in client.datasets.list(name="once")] == [dataset.id]
        client.datasets.delete(dataset)
        assert not list(client.datasets.list(name="once"))
    assert not line.faults


def test_a_download_goes_on_where_it_broke_off(served: Served, line: Line, tmp_path: Path) -> None:
    whole = served.client.models.download(served.model, tmp_path / "whole").read_bytes()
    at = len(whole) // 3
    line.faults = [(b"/weights", at), (b"/weights", at)]
    with Client(line.url) as client:
        file = client.models.download(served.model, tmp_path / "broken")
    assert file.read_bytes() == whole
    assert sum(b"Range: bytes=" in asked for asked in line.asked) == 2

    line.faults = [(b"/weights", at), (b"/weights", 0)]
    with Client(line.url, patience=0) as client:
        with pytest.raises(ConnectionFailed):
            client.models.download(served.model, tmp_path / "later")
        assert not (tmp_path / "later").exists()
        (part,) = tmp_path.glob("later.*.part")
        assert 0 < part.stat().st_size < at
        del line.asked[:]
        file = client.models.download(served.model, tmp_path / "later")
    assert file.read_bytes() == whole
    assert any(b"Range: bytes=" in asked for asked in line.asked)
    assert not list(tmp_path.glob("*.part"))

    other = tmp_path / "later.%22other%22.part"  # of another version
    other.write_bytes(b"what is old")
    assert served.client.models.download(served.model, file).read_bytes() == whole
    assert not other.exists()


# A fit that goes on for as long as events are broken and asked for again.
LONGER = CONFIG | {"refine": "off", "steps": 1000}


def test_a_fit_is_followed_through_breaks_and_without_events(served: Served, line: Line) -> None:
    for faults in ([(b"/events", 2500)], [(b"/events", 0)] * 50):
        line.faults = list(faults)
        del line.asked[:]
        heard: list[Fit] = []
        with Client(line.url, patience=0) as client:
            fit = client.fits.create(served.dataset, **LONGER)
            done = client.fits.wait(fit, on_progress=heard.append)
        assert heard[-1] == done
        assert done.model_id is not None
        if len(faults) == 1:
            assert any(b"Last-Event-ID" in asked for asked in line.asked)
        else:
            assert sum(b"/events" in asked for asked in line.asked) == 3


@pytest.mark.parametrize(
    ("status", "patient"),
    [
        (HTTPStatus.TOO_MANY_REQUESTS, True),
        (HTTPStatus.SERVICE_UNAVAILABLE, True),
        (HTTPStatus.NOT_FOUND, False),
    ],
)
def test_a_stream_is_opened_when_the_service_is_no_longer_busy(
    status: HTTPStatus, *, patient: bool
) -> None:
    with hearing_streams(lambda: (status, {}, "{}")) as (port, keys):
        url = f"http://127.0.0.1:{port}"
        with Client(url, "key", patience=0.9) as client, pytest.raises(ApiError):
            client.stream("mdl_any").__enter__()
        tries = len(keys)

        async def stream() -> None:
            async with AsyncClient(url, "key", patience=0.9) as client:
                await client.stream("mdl_any").__aenter__()

        with pytest.raises(ApiError):
            asyncio.run(stream())
    assert (tries > 1) is (len(keys) - tries > 1) is patient
