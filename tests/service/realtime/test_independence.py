"""Real-time lifting waits for records, objects and queue only where a model is not in memory."""

import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

import httpx2
import numpy as np

from models.capture.synthetic import SyntheticCapture
from service.app import ENDPOINTS
from service.http.uploads import LARGE_BYTES
from service.realtime.lift import TINY_BYTES
from tests.service.conftest import BYTES, Live, frames_of, to_safetensors
from tests.service.realtime.conftest import as_bytes, read_bytes, started
from tests.waiting import wait_for

OTHERS = 20  # requests that wait for those that wait for the records
PATIENCE_SECONDS = 5.0  # far less than the records are waited for


@contextmanager
def locked(records: Path) -> Iterator[None]:
    """Let nobody write the records."""
    with closing(sqlite3.connect(records, isolation_level=None)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        yield


def test_lifts_streams_and_liveness_do_not_wait_for_the_records(
    live: Live, weights: bytes, capture: SyntheticCapture
) -> None:
    """While more requests wait for them than may be at work at a time."""
    made = live.http.post("/models", content=weights, headers=BYTES).json()["id"]
    model = "independent@test"
    assert live.http.put(f"/models/{model}", json={"model_id": made}).status_code == 200
    many = np.tile(capture.keypoints, (5, 1, 1, 1))
    small = {"model": model, "frames": frames_of(capture.keypoints[:1]), "refine": "off"}
    tiny = to_safetensors(keypoints=capture.keypoints[:1])
    middle = to_safetensors(keypoints=many)
    large = to_safetensors(keypoints=np.tile(many, (12, 1, 1, 1)))
    assert len(tiny) < TINY_BYTES < len(middle) < LARGE_BYTES < len(large)
    lift = f"/lift?model={model}&refine=off&format=safetensors"
    assert live.http.post(lift, content=tiny, headers=BYTES).status_code == 200

    def stored() -> int:
        return sum(path.is_file() for path in (live.data_dir / "objects" / "datasets").rglob("*"))

    before = stored()
    with (
        ThreadPoolExecutor(ENDPOINTS + OTHERS) as clients,
        httpx2.Client(base_url=live.url, timeout=PATIENCE_SECONDS) as http,
        started(live.http, model, model_id=made) as socket,
    ):
        with locked(live.data_dir / "records.db"):
            waiting = [
                clients.submit(live.http.post, "/datasets", content=tiny, headers=BYTES)
                for _ in range(ENDPOINTS + OTHERS)
            ]
            wait_for(lambda: stored() >= before + ENDPOINTS, "requests that wait", 15)
            for n in range(5):
                assert http.post("/lift", json=small).status_code == 200
                for body in (tiny, middle, large):
                    assert http.post(lift, content=body, headers=BYTES).status_code == 200
                socket.send(as_bytes(n, capture.keypoints[n]))
                assert read_bytes(socket.recv(timeout=PATIENCE_SECONDS)).sequence == n
                with started(live.http, model, model_id=made):
                    pass
                assert http.get("/health/live").status_code == 200
            assert not any(request.done() and request.result().is_success for request in waiting)
        answers = [request.result().status_code for request in waiting]
        assert answers.count(201) >= ENDPOINTS
        assert set(answers) <= {201, 503}  # who had no turn in time
