"""Bodies of any content are refused in little time, and keep nobody waiting."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest

from tests.processes import growth
from tests.service.conftest import Live, problem, to_npz

MANY = 2_000_000
KEYPOINTS = b"[[[[1,2],[3,4],[5,6],[7,8]],[[1,2],[3,4],[5,6],[7,8]]]]"
JSON = {"Content-Type": "application/json"}
# Seconds that another request may wait: parsing 8 MB of JSON alone takes a tenth of this, and
# validating it item by item took 8 to 18.
LONGEST = 1.0


@contextmanager
def watched(live: Live) -> Iterator[list[float]]:
    """Ask all the time whether the service is alive; give how long that takes."""
    waits, over = [0.0], threading.Event()

    def watch() -> None:
        with httpx2.Client(base_url=live.url, timeout=60) as http:
            while not over.is_set():
                began = time.perf_counter()
                assert http.get("/health/live").status_code == 200
                waits.append(time.perf_counter() - began)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield waits
    finally:
        over.set()
        watcher.join()


def body(**others: Any) -> bytes:
    """Return a capture's JSON with other fields beside its keypoints."""
    return b'{"keypoints":' + KEYPOINTS + b"," + orjson.dumps(others)[1:]


# Made when they are sent, for they take a second and are 80 MB.
BODIES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "/view_names": ("/datasets", lambda: body(view_names=[1] * MANY)),
    "/image_sizes": ("/datasets", lambda: body(image_sizes=[[0, 0]] * (MANY // 4))),
    "/skeleton": ("/datasets", lambda: body(skeleton={"edges": [[-1, -1]] * (MANY // 4)})),
    "/tags": ("/datasets", lambda: body(tags=[""] * MANY)),
    "/metadata": ("/datasets", lambda: body(metadata={str(n): 0 for n in range(MANY // 4)})),
    "/0": ("/datasets", lambda: body(**{str(n): 0 for n in range(MANY // 4)})),
    "/views": (
        "/lift",
        lambda: b'{"model":"mdl_1","frames":[],"views":' + b"[" + b"-1," * MANY + b"0]}",
    ),
    "/config": (
        "/fits",
        lambda: orjson.dumps({"dataset_id": "ds_1", "config": {"view": [0] * MANY}}),
    ),
    "/calibration": ("/evaluations", lambda: orjson.dumps({"calibration": [{}] * MANY})),
}


@pytest.mark.parametrize("pointer", BODIES)
def test_fields_that_hold_too_much_are_refused_at_once(live: Live, pointer: str) -> None:
    path, made = BODIES[pointer]
    data = made()
    with watched(live) as waits:
        answer = live.http.post(path, content=data, headers=JSON, timeout=60)
    problem(answer, 422, "invalid_input", pointer)
    assert len(answer.content) < 50_000
    assert max(waits) < LONGEST


def test_fields_of_forms_are_bounded_too(live: Live) -> None:
    names = orjson.dumps([1] * 400_000).decode()
    arrays = to_npz(keypoints=np.ones((1, 2, 4, 2), np.float32))
    with watched(live) as waits:
        answer = live.http.post(
            "/datasets", files={"file": ("a.npz", arrays)}, data={"view_names": names}
        )
    problem(answer, 422, "invalid_input", "/view_names")
    assert max(waits) < LONGEST


def test_fields_of_forms_are_read_one_by_one(live: Live) -> None:
    """Together, as lists, they would take twenty times their bytes."""
    fields = {f"field{number}": "[" + "[]," * 340_000 + "0]" for number in range(15)}
    arrays = {"file": ("a.npz", to_npz(keypoints=np.ones((1, 2, 4, 2), np.float32)))}
    with growth(live.process.pid, b"service.app") as grew:
        answer = live.http.post("/datasets", files=arrays, data=fields)
    problem(answer, 422, "invalid_input", "/field0")
    assert grew[0] < 10 * sum(map(len, fields.values()))
