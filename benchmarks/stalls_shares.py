"""One key at its worst, and what becomes of another project's requests meanwhile."""

import io
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from itertools import count, permutations
from multiprocessing import get_context
from typing import Any, NamedTuple

import h5py
import httpx2
import numpy as np
from safetensors.numpy import save

from benchmarks import stalls_work
from benchmarks.captures import Float32
from benchmarks.figures import Row
from benchmarks.service_rig import BYTES, Service
from models.lifting.fitted_prior import FittedPrior

SECONDS = 4.0  # of the other's requests
TAKEN_UP_SECONDS = 3.0  # until the greedy key has what it gets
REFUSED = (429, 503)
FRAMES = 200  # of the dataset that each has
SOCKETS, BODIES, READERS, CLIENTS = 300, 64, 6, 32


class User(NamedTuple):
    """A key of a project of its own, with a model and a fit."""

    client: httpx2.Client
    token: str
    model: str
    frame: np.ndarray[Any, Any]
    fit: str


class Worst(NamedTuple):
    """What one key does, and what another project asks for beside lifts."""

    name: str
    attack: Callable[[Service, User], Any]  # a context
    ask: Callable[[User], httpx2.Response]


def rows(
    running: Service, prior: FittedPrior, keypoints: Float32, only: list[str]
) -> Iterator[Row]:
    """Yield how another project's requests fare beside one key at its worst, a row for each way.

    Both have the `keypoints` (N, K, P, 2) that the prior was fitted to, a part of them as dataset.
    """
    with ExitStack() as clients:
        greedy, other = (
            clients.enter_context(_user(running, prior, keypoints, name))
            for name in ("greedy", "other")
        )
        for worst in ALL:
            if any(text in worst.name for text in only):
                yield _measure(running, worst, greedy, other)


@contextmanager
def _user(running: Service, prior: FittedPrior, keypoints: Float32, project: str) -> Iterator[User]:
    scopes = ["read", "lift", "write", "delete", "webhook"]
    asked = {"name": project, "project": project, "scopes": scopes}
    token = running.client.post("/keys", json=asked).raise_for_status().json()["token"]
    headers = {"Authorization": f"Bearer {token}"}
    with httpx2.Client(
        base_url=running.address, headers=headers, timeout=600, trust_env=False
    ) as client:
        mine = Service(running.address, client)
        size = (1, prior.known_views, prior.keypoints_per_frame, 2)
        frame = np.round(np.random.default_rng(0).uniform(100, 900, size), 2)
        model = mine.import_model(prior)
        dataset = mine.upload_many(keypoints, FRAMES)
        fit = client.post("/fits", json={"dataset_id": dataset}).raise_for_status().json()["id"]
        client.post(f"/fits/{fit}/cancel")
        user = User(client, token, model, frame, fit)
        _lift(user).raise_for_status()
        yield user


def _measure(running: Service, worst: Worst, greedy: User, other: User) -> Row:
    refused, longest, lifts = 0, 0.0, 0
    with worst.attack(running, greedy):
        time.sleep(TAKEN_UP_SECONDS)
        asked = time.perf_counter()
        refused += worst.ask(other).status_code in REFUSED
        seconds = time.perf_counter() - asked
        ends = time.monotonic() + SECONDS
        while time.monotonic() < ends:
            began = time.perf_counter()
            refused += _lift(other).status_code in REFUSED
            longest = max(longest, time.perf_counter() - began)
            lifts += 1
    return {
        "one key": worst.name,
        "another's longest lift ms": 1000 * longest,
        "its own of the kind s": seconds,
        "lifts": lifts,
        "refused": refused,
    }


def _lift(user: User, views: list[int] | None = None) -> httpx2.Response:
    frame = user.frame if views is None else user.frame[:, views]
    body = {"model": user.model, "frames": frame.tolist()}
    return user.client.post("/lift", json=body if views is None else body | {"views": views})


def _opened(running: Service, user: User, head: str, body: bytes = b"") -> socket.socket:
    one = socket.create_connection((running.host, running.port))
    lines = f"{head} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {user.token}\r\n"
    one.sendall(lines.encode() + body)
    return one


WEB_SOCKET = (
    b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


@contextmanager
def _held(make: Callable[[], socket.socket], many: int) -> Iterator[None]:
    with ExitStack() as held:
        for _ in range(many):
            held.enter_context(make())
        yield


def _silent_streams(running: Service, greedy: User) -> Any:
    return _held(lambda: _opened(running, greedy, "GET /lift/stream", WEB_SOCKET), SOCKETS)


def _ask_for_stream(user: User) -> httpx2.Response:
    upgrade = dict(line.split(": ") for line in WEB_SOCKET.decode().split("\r\n") if line)
    with user.client.stream("GET", "/lift/stream", headers=upgrade) as answer:
        return answer


@contextmanager
def _followers(running: Service, greedy: User) -> Iterator[None]:
    dataset = greedy.client.get("/datasets").json()["items"][0]["id"]
    asked = {"dataset_id": dataset, "config": {"steps": 1_000_000}}
    fit = greedy.client.post("/fits", json=asked).raise_for_status().json()["id"]
    head = f"GET /fits/{fit}/events"
    with _held(lambda: _opened(running, greedy, head, b"\r\n"), SOCKETS):
        yield
    greedy.client.post(f"/fits/{fit}/cancel")


def _bodies(running: Service, greedy: User) -> Any:
    body = b"Content-Type: application/octet-stream\r\nContent-Length: 200000000\r\n\r\n"
    body += bytes(16 * 2**20)

    token = greedy.token

    def send() -> socket.socket:
        one = socket.create_connection((running.host, running.port))
        head = f"POST /datasets HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}"
        with suppress(OSError):  # it is refused before it has come whole
            one.sendall(head.encode() + b"\r\n" + body)
        return one

    return _held(send, BODIES)


def _upload(user: User) -> httpx2.Response:
    data = save({"keypoints": np.repeat(user.frame, 5000, 0).astype(np.float32)})
    return user.client.post("/datasets", content=data, headers={"Content-Type": BYTES})


def _long_file() -> bytes:
    """Return a small file of SLEAP's that takes very long to read."""
    file = io.BytesIO()
    with h5py.File(file, "w") as written:
        written.create_dataset(
            "tracks", (1, 2, 17, 4_000_000), "f8", chunks=(1, 1, 17, 4096), compression="gzip"
        )
        written["node_names"] = [f"n{n}".encode() for n in range(17)]
        written["track_names"] = [b"t"]
    return file.getvalue()


@contextmanager
def _readers(running: Service, greedy: User) -> Iterator[None]:
    files = [("files", (f"{n}.analysis.h5", _long_file())) for n in range(2)]

    def post(client: httpx2.Client) -> None:
        with suppress(httpx2.HTTPError):  # it takes as long as it is to take
            client.post("/datasets", files=files, timeout=TAKEN_UP_SECONDS + SECONDS)

    with ThreadPoolExecutor(READERS) as threads:
        for _ in range(READERS):
            threads.submit(post, greedy.client)
        yield


def _read(user: User) -> httpx2.Response:
    pose = b'{"people": [{"pose_keypoints_2d": [' + b"1, 2, 0.5, " * 24 + b"1, 2, 0.5]}]}"
    return user.client.post(
        "/datasets", files=[("files", (f"cam{n}_000000000000_keypoints.json", pose)) for n in "ab"]
    )


@contextmanager
def _orders(running: Service, greedy: User) -> Iterator[None]:
    asked = running.address, greedy.token, greedy.model, greedy.frame
    # A process of its own: threads of this one would keep the other's requests waiting here.
    process = get_context("spawn").Process(target=_lift_in_orders, args=asked, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def _lift_in_orders(address: str, token: str, model: str, frame: np.ndarray[Any, Any]) -> None:
    """Lift for ever, with many clients, each time with the views in another order."""
    orders = list(permutations(range(frame.shape[1])))

    def lift(first: int) -> None:
        headers = {"Authorization": f"Bearer {token}"}
        with httpx2.Client(base_url=address, headers=headers, trust_env=False) as client:
            greedy = User(client, token, model, frame, "")
            for n in count(first):
                _lift(greedy, list(orders[n % len(orders)]))

    with ThreadPoolExecutor(CLIENTS) as threads:
        list(threads.map(lift, range(CLIENTS)))


@contextmanager
def _queue(_running: Service, greedy: User) -> Iterator[None]:
    dataset = greedy.client.get("/datasets").json()["items"][0]["id"]
    made = []
    while True:
        answer = greedy.client.post("/fits", json={"dataset_id": dataset})
        if answer.status_code >= 400:
            break
        made.append(answer.json()["id"])
    yield
    for fit in made:
        greedy.client.post(f"/fits/{fit}/cancel")


def _ask_for_fit(user: User) -> httpx2.Response:
    dataset = user.client.get("/datasets").json()["items"][0]["id"]
    answer = user.client.post("/fits", json={"dataset_id": dataset})
    if answer.status_code < 400:
        user.client.post(f"/fits/{answer.json()['id']}/cancel")
    return answer


def _follow(user: User) -> httpx2.Response:
    return user.client.get(f"/fits/{user.fit}/events")


ALL = (
    Worst("silent streams", _silent_streams, _ask_for_stream),
    Worst("followers of a job", _followers, _follow),
    Worst("bodies that do not end", _bodies, _upload),
    Worst("files that take long", _readers, _read),
    Worst("views in ever new orders", _orders, _lift),
    Worst("waiting fits", _queue, _ask_for_fit),
    Worst(
        "webhooks never answered",
        lambda _, greedy: stalls_work.never_answered(greedy.client),
        lambda other: stalls_work.heard(other.client),
    ),
    Worst(
        "long fits beside a short one",
        lambda _, greedy: stalls_work.long_fits(greedy.client),
        lambda other: stalls_work.fitted_soon(other.client),
    ),
)
