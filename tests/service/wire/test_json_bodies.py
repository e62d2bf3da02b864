"""Large JSON bodies are read in processes of their own, and understood as small ones are."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from tests.processes import command_of, descendants, growth
from tests.service.conftest import (
    BYTES,
    JSON,
    MIB,
    Live,
    frames_of,
    make_dataset,
    nested,
    problem,
    to_npz,
)
from tests.service.test_bad_input import FRAME, KEYPOINTS
from tests.tiers import thorough_after
from tests.waiting import wait_for

LARGE = b" " * MIB  # makes any body large
READER = b"service.wire.sandbox"  # in the command of the process that forks them

BODIES: dict[str, tuple[str, Any]] = {
    "captures": ("/datasets", {"keypoints": FRAME}),
    "no capture": ("/datasets", {}),
    "no object": ("/datasets", [1]),
    "a detector's": ("/datasets", {"people": []}),
    "unknown fields": ("/datasets", {"keypoints": FRAME, "nme": 1, "": 2, "x/y": [1]}),
    "wrong fields": ("/datasets", {"keypoints": FRAME, "name": "", "tags": [1], "fps": -1}),
    "many unknown fields": ("/datasets", {str(n): 0 for n in range(200)}),
    "what does not fit": ("/datasets", {"keypoints": FRAME, "view_names": ["a"]}),
    "nothing but nulls": ("/datasets", {"keypoints": [[None, None], None]}),
    "nulls beside nulls": ("/datasets", {"keypoints": [None], "confidence": [None]}),
    "unequal nulls": ("/datasets", {"keypoints": [[None, None], [None]]}),
    "confidence": ("/datasets", {"keypoints": FRAME, "confidence": [[[1, 1, 1, 2]] * 2]}),
    "confidence of another shape": ("/datasets", {"keypoints": FRAME, "confidence": [[1]]}),
    "confidence, a little high": (
        "/datasets",
        {"keypoints": FRAME, "confidence": [[[1, 1, 1, 1.01]] * 2]},
    ),
    "a truth": ("/datasets", {"keypoints": FRAME, "points3d": [[[1, 2, 3]] * 3 + [None]]}),
    "a truth of two": ("/datasets", {"keypoints": FRAME, "points3d": [[[1, 2]] * 4]}),
    "times": ("/datasets", {"keypoints": FRAME * 2, "times": [1792000000.25, 1792000000.26]}),
    "times of views": ("/datasets", {"keypoints": FRAME, "times": [[1.5, 1.25]]}),
    "times of no views": ("/datasets", {"keypoints": FRAME, "times": [[1.5]]}),
    "times that fall": ("/datasets", {"keypoints": FRAME * 2, "times": [2, 1]}),
    "text for times": ("/datasets", {"keypoints": FRAME, "times": ["now"]}),
    "two mistakes": ("/datasets", {"keypoints": 3, "confidence": "x", "times": [{}]}),
    "a mistake and a name": ("/datasets", {"keypoints": 3, "name": 7}),
    "frames": ("/datasets/DATASET/frames", {"keypoints": [[[[1, 2]] * 16] * 2]}),
    "lifts of no model": ("/lift", {"model": "mdl_no", "frames": "x"}),
    "lifts": ("/lift", {"model": "MODEL", "frames": "FRAMES"}),
    "lifts with times": ("/lift", {"model": "MODEL", "frames": "FRAMES", "times": [1, 2, 3]}),
    "lifts with wrong times": ("/lift", {"model": "MODEL", "frames": "FRAMES", "times": [1]}),
    "lifts of wrong views": ("/lift", {"model": "MODEL", "frames": "FRAMES", "views": [0]}),
    "lifts of nulls": ("/lift", {"model": "MODEL", "frames": [[None, None]] * 3}),
    "lifts of nulls with confidence": (
        "/lift",
        {"model": "MODEL", "frames": [[None, None]] * 3, "confidence": [[None, None]] * 3},
    ),
    "lifts of nothing": ("/lift", {"model": "MODEL", "frames": [None] * 3}),
    "lifts of numbers": ("/lift", {"model": "MODEL", "frames": [1]}),
    "lifts of other keypoints": ("/lift", {"model": "MODEL", "frames": FRAME}),
    "an evaluation": ("/evaluations", {"points": [[[0, 0, 1], [0, 2, 0], [3, 0, 0]]] * 2}),
    "a whole evaluation": (
        "/evaluations",
        {
            "points": [[[0, 0, 1], [0, 2, 0], [3, 0, 0]]] * 2,
            "truth": [[[0, 0, 2], [0, 3, 0], [4, 0, 0]], [None, [0, 3, 0], [4, 0, 1]]],
        },
    ),
    "an evaluation of text": ("/evaluations", {"points": [["x"]], "truth": [[[0, 0, 1]]]}),
    "fits": ("/fits", {"dataset_id": "ds_no", "config": {"seed": "x", "step": 3}}),
    "jobs of lifts": ("/lifts", {"dataset_id": "ds_no", "model_id": 3}),
}


def outcome(response: Any) -> Any:
    """Return an answer without what is new in each."""
    found = response.json()
    for name in ("id", "created_at", "request_id"):
        found.pop(name, None)
    return response.status_code, found


@pytest.mark.parametrize("name", BODIES)
def test_large_bodies_are_understood_as_small_ones_are(
    api: TestClient, model: str, capture: SyntheticCapture, name: str
) -> None:
    path, fields = BODIES[name]
    frames = orjson.dumps(frames_of(capture.keypoints[:3]))
    text = orjson.dumps(fields).replace(b"MODEL", model.encode()).replace(b'"FRAMES"', frames)
    small, large = (
        api.post(
            path.replace("DATASET", make_dataset(api)["id"] if "DATASET" in path else ""),
            content=body,
            headers=JSON,
        )
        for body in (text, text.ljust(MIB))
    )
    assert outcome(small) == outcome(large)


@pytest.mark.parametrize("name", KEYPOINTS)
def test_bad_keypoints_are_refused_alike(api: TestClient, name: str) -> None:
    text = orjson.dumps({"keypoints": KEYPOINTS[name]})
    small, large = (api.post("/datasets", content=t, headers=JSON) for t in (text, text.ljust(MIB)))
    assert outcome(small) == outcome(large)


@pytest.mark.parametrize("text", [b"{", b'{"keypoints": [[1, NaN]]}', b"\xff", b"[" * 2000, b""])
def test_broken_json_is_refused_alike(api: TestClient, text: bytes) -> None:
    sizes = (2500, MIB)
    small, large = (api.post("/datasets", content=text.rjust(n), headers=JSON) for n in sizes)
    assert small.status_code == large.status_code == 400
    assert small.json()["detail"].split("column")[0] == large.json()["detail"].split("column")[0]


ODD = {
    "a list twice": b'{"keypoints":[],"keypoints":%b}',
    "a list elsewhere": b'{"metadata":{"keypoints":[[1]]},"keypoints":%b}',
    "a list elsewhere alone": b'{"metadata":{"keypoints":%b}}',
    "text like a list": b'{"name":"\\"keypoints\\": [","keypoints":%b}',
    "an escaped name": b'{"k\\u0065ypoints":%b}',
    "blanks": b' { "keypoints"\n\t: %b } ',
    "blanks of others": b'{"keypoints"\x0b:%b}',
    "text within": b'{"keypoints":[%b,"]"]}',
    "a comma too many": b'{"keypoints":%b,"times":[1,]}',
    "commas alone": b'{"keypoints":%b,"times":[,]}',
    "more after it": b'{"keypoints":%b}]',
}


@pytest.mark.parametrize("name", ODD)
def test_odd_texts_are_understood_alike(api: TestClient, name: str) -> None:
    text = ODD[name] % orjson.dumps(FRAME)
    small, large = (api.post("/datasets", content=t, headers=JSON) for t in (text, text.ljust(MIB)))
    assert outcome(small) == outcome(large)


def test_arrays_are_the_same_to_the_last_bit(api: TestClient, capture: SyntheticCapture) -> None:
    body = orjson.dumps(
        {
            "keypoints": frames_of(capture.keypoints),
            "confidence": capture.confidence.tolist(),
            "points3d": capture.points3d.tolist(),
            "times": [0.1 * frame for frame in range(len(capture.keypoints))],
        }
    )
    small, large = (api.post("/datasets", content=t, headers=JSON) for t in (body, body.ljust(MIB)))
    assert small.status_code == large.status_code == 201
    assert small.json()["checksum"] == large.json()["checksum"]


NUMBERS = np.round(np.random.default_rng(0).uniform(0, 1000, (6000, 4, 17, 2)), 3)
HOSTILE = {
    "a capture": orjson.dumps({"keypoints": NUMBERS}, option=orjson.OPT_SERIALIZE_NUMPY),
    "an irregular one": orjson.dumps(
        {"keypoints": [*NUMBERS.tolist(), [[1]]]}, option=orjson.OPT_SERIALIZE_NUMPY
    ),
    "small numbers": b'{"keypoints":[' + b",".join([b"[[[1,2]],[[3,4]]]"] * 400_000) + b"]}",
    "an unknown field": b'{"keypoints":[],"x":[' + b",".join([b'"a"'] * 1_500_000) + b"]}",
    "many nulls": orjson.dumps({"keypoints": [[[[1, 2]] * 30] * 4] + [None] * 200_000}),
}


def test_long_arrays_are_the_same_to_the_last_bit(live: Live) -> None:
    """They are read some frames at a time."""
    frames, rng = NUMBERS[:2500].astype(np.float32), np.random.default_rng(1)
    frames[rng.random(frames.shape[:3]) < 0.1] = np.nan
    frames[[0, 7, -1], 1] = np.nan
    frames[700:1900] = np.nan
    arrays = {"keypoints": frames, "confidence": rng.random(frames.shape[:3], np.float32)}
    arrays |= {"points3d": np.concatenate((frames[:, 0], frames[:, 1, :, :1]), -1)}
    times = np.cumsum(rng.random(len(frames))) + 1.7e9
    fields = {name: [nested(frame) for frame in array] for name, array in arrays.items()}
    bodies = [
        (orjson.dumps(fields | {"times": times.tolist()}), JSON),
        (to_npz(**arrays, times=times), BYTES),
    ]
    made = [live.http.post("/datasets", content=c, headers=kind).json() for c, kind in bodies]
    assert made[0]["checksum"] == made[1]["checksum"]


@pytest.mark.parametrize("place", [2500, -1])
@pytest.mark.parametrize("wrong", thorough_after(2, [[[1]], "x", 1, {}, [None, [[1, 2]] * 17]]))
def test_a_wrong_frame_is_named(live: Live, place: int, wrong: Any) -> None:
    frames: list[Any] = NUMBERS[:3000].tolist()
    frames[place] = wrong
    body = orjson.dumps({"keypoints": frames})
    answer = live.http.post("/datasets", content=body, headers=JSON)
    problem(answer, 422, "invalid_input", f"/keypoints/{place % len(frames)}")


@pytest.mark.parametrize("name", HOSTILE)
def test_large_bodies_take_little_memory(live: Live, name: str) -> None:
    """As lists in the service's own process, they would take 14 to 25 times their bytes."""
    body = HOSTILE[name]
    live.http.post("/datasets", content=orjson.dumps({"x": 1}) + LARGE, headers=JSON)
    with growth(live.process.pid, b"service.app") as grew:
        answer = live.http.post("/datasets", content=body, headers=JSON)
    assert answer.status_code == (201 if name == "a capture" else 422), answer.text[:500]
    assert grew[0] < 10 * len(body)


def test_arrays_of_small_bodies_are_small(live: Live) -> None:
    """A null for a frame of many keypoints takes five bytes."""
    frame = np.ones((16, 200, 2)).tolist()
    body = orjson.dumps({"keypoints": [frame] + [None] * 8000})
    with growth(live.process.pid, b"service.app") as grew:
        answer = live.http.post("/datasets", content=body, headers=JSON)
    assert "send the frames in parts" in problem(answer, 422, "invalid_input", "/keypoints")
    assert grew[0] < 40 * MIB


def readers(of: int) -> set[int]:
    return {pid for pid in descendants(of) if READER in command_of(pid)}


def test_readers_that_are_killed_are_replaced(live: Live) -> None:
    def post(body: bytes) -> httpx2.Response:
        return live.http.post("/datasets", content=body, headers=JSON)

    of = live.process.pid
    assert post(orjson.dumps({"keypoints": FRAME}) + LARGE).status_code == 201
    (before,) = readers(of)
    many = orjson.dumps({"keypoints": NUMBERS.tolist() * 3})[:-2] + b",[[1]]]}"
    with ThreadPoolExecutor(1) as threads:
        answer = threads.submit(post, many)
        (reading,) = wait_for(lambda: readers(of) - {before}, "a process that reads")
        os.kill(reading, signal.SIGKILL)
        assert int(answer.result().headers["Retry-After"]) > 0
    problem(answer.result(), 503, "overloaded")

    os.kill(before, signal.SIGKILL)
    assert post(orjson.dumps({"keypoints": FRAME}) + LARGE).status_code == 201
    assert not readers(of) & {before}
