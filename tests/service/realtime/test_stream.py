"""The stream: every frame answered in its order and form, whatever else happens."""

import struct
import threading
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from websockets.sync.client import ClientConnection

from models.capture.synthetic import SyntheticCapture
from service.wire.stream_messages import StreamDropped, StreamError
from tests.service.conftest import (
    frames_of,
)
from tests.service.realtime.conftest import (
    Array,
    as_bytes,
    as_json,
    check,
    lifted,
    read_bytes,
    read_json,
    started,
)


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
            message = socket.recv(timeout=300)
            if n % 2:
                answer = read_json(message)
                assert answer["sequence"] == 1000 + n
                assert answer["continued"] is False
                assert answer["frame"]["status"] == known["status"]
                np.testing.assert_allclose(
                    answer["frame"]["points3d"], known["points3d"], rtol=1e-3, atol=1e-4
                )
            else:
                sequence, flags, points, views, seen, outlying = read_bytes(message)
                assert sequence == 1000 + n
                assert flags == 1
                check(points, views, known)
                np.testing.assert_array_equal(seen, known["keypoints_seen"])
                judged = np.array(known["outlier_probability"], np.float32)
                np.testing.assert_array_equal(outlying, judged)


def test_views_and_confidence(http: httpx2.Client, model: str, capture: SyntheticCapture) -> None:
    keypoints, confidence = capture.keypoints[:3, [2, 0]], capture.confidence[:3, [2, 0]] / 2
    expected = lifted(http, model, keypoints, confidence=confidence.tolist(), views=[2, 0])
    with started(http, model, views=[2, 0]) as socket:
        for n in range(3):
            socket.send(as_bytes(n, keypoints[n], confidence[n]))
            sequence, _, points, views, *_ = read_bytes(socket.recv(timeout=300))
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
            answer = read_json(socket.recv(timeout=300))
            np.testing.assert_allclose(answer["frame"]["points3d"], points, rtol=1e-3, atol=1e-4)


def test_a_frame_that_shows_too_little_is_marked(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    nothing = np.full_like(capture.keypoints[0], np.nan)
    with started(http, model) as socket:
        socket.send(as_bytes(5, nothing))
        sequence, flags, points, views, seen, outlying = read_bytes(socket.recv(timeout=300))
        assert (sequence, flags) == (5, 0)
        assert np.isnan(points).all()
        assert (views["camera"] == -1).all()
        assert not seen.any()
        assert np.isnan(outlying).all()
        socket.send(as_json(6, nothing))
        assert read_json(socket.recv(timeout=300))["frame"]["status"] == "too_few_keypoints"


def test_with_continuity_a_frame_may_start_from_the_one_before(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    """Of a figure that hardly moves, between two others; each stream continues its own.

    The model explains this frame to a pixel, so that there is one answer wherever it starts from.
    """
    still = np.repeat(capture.keypoints[1:2], 10, axis=0)
    still += np.random.default_rng(0).normal(0, 0.05, still.shape).astype(np.float32)
    frames = [*still, capture.keypoints[30], *capture.keypoints[40:43, :2]]
    for continuity, refine in ((True, "full"), (False, "full"), (True, "off")):
        continued = []
        with started(http, model, continuity=continuity, refine=refine) as socket:
            for n, keypoints in enumerate(frames):
                socket.send((as_json if n == 5 else as_bytes)(n, keypoints))
            for n in range(len(frames)):
                message = socket.recv(timeout=300)
                if n == 5:
                    continued.append(read_json(message)["continued"])
                    continue
                sequence, flags, points, *_ = read_bytes(message)
                assert sequence == n
                assert flags & 1
                continued.append(flags & 2 == 2)
                if n < len(still):
                    known = lifted(http, model, still[n : n + 1], refine=refine)[0]
                    np.testing.assert_allclose(points, known["points3d"], atol=0.01)
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
                    sequence, _, points, views, *_ = read_bytes(socket.recv(timeout=300))
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
        answers = [read_bytes(socket.recv(timeout=300))[0] for _ in range(count)]
        sender.join()
    assert answers == list(range(count))


def test_stale_frames_are_dropped_and_reported(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    count = 1000
    answered, dropped, seen = [], [], []
    with started(http, model, refine="full", on_overload="latest") as socket:
        flood(socket, capture.keypoints, count)
        while count - 1 not in answered:
            message = socket.recv(timeout=300)
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


def test_a_frame_with_an_error_takes_no_place_of_a_good_one(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    """Each second frame is refused; all errors come, and the last good frame is answered."""
    count = 200
    good: list[int] = []
    errors: list[int] = []
    dropped: list[int] = []
    with started(http, model, refine="full", on_overload="latest") as socket:
        for number in range(count):
            seen = capture.keypoints[number % len(capture.keypoints)]
            socket.send(as_bytes(number, seen if number % 2 == 0 else seen[:, :-1]))
        while len(good) + len(errors) + len(dropped) < count:
            message = socket.recv(timeout=300)
            if not isinstance(message, str):
                good.append(read_bytes(message)[0])
            elif (notice := orjson.loads(message))["type"] == "dropped":
                dropped += notice["sequences"]
            else:
                errors.append(notice["sequence"])
    assert errors == list(range(1, count, 2))
    assert sorted(good + dropped) == list(range(0, count, 2))
    assert good[-1] == count - 2


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
def test_a_bad_frame_is_an_error_and_the_stream_goes_on(
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
        assert read_bytes(socket.recv(timeout=300))[0] == 1
        error = StreamError.model_validate_json(socket.recv(timeout=300))
        assert (error.type, error.code, error.sequence) == ("error", code, sequence)
        assert [item.pointer for item in error.errors] == ([] if pointer is None else [pointer])
        assert error.detail
        assert read_bytes(socket.recv(timeout=300))[0] == 2
