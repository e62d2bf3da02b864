"""What one key leaves to workers, at its worst: long fits, and messages to who never answers."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import httpx2

HOSTS, ENDED = 20, 10  # webhooks of the greedy key, and jobs of it that end: a message each
FITS = 3
QUICK: dict[str, Any] = {"steps": 60, "dictionary_sizes": [16, 8], "cameras": "moving"}
LONG = QUICK | {"steps": 1_000_000}
PATIENCE_SECONDS = 60.0


@contextmanager
def never_answered(client: httpx2.Client) -> Iterator[None]:
    """Have messages due to hosts that take them and answer nothing."""
    with socket.create_server(("0.0.0.0", 0), backlog=1000) as silent:  # noqa: S104 (all of 127/8)
        port = silent.getsockname()[1]
        made = [_webhook(client, f"http://127.0.0.{host}:{port}/") for host in range(2, 2 + HOSTS)]
        for _ in range(ENDED):
            _ended(client)
        yield
        for each in made:
            client.delete(f"/webhooks/{each}")


def heard(client: httpx2.Client) -> httpx2.Response:
    """End a fit, and return the answer once the message of it has come."""
    came = threading.Event()

    def receive(one: socket.socket) -> None:
        with suppress(OSError), one.accept()[0] as connection:
            connection.recv(2**16)
            connection.sendall(b"HTTP/1.1 204 No Content\r\nConnection: close\r\n\r\n")
            came.set()

    with socket.create_server(("127.0.0.1", 0)) as receiver:
        waiting = threading.Thread(target=receive, args=(receiver,), daemon=True)
        waiting.start()
        webhook = _webhook(client, f"http://127.0.0.1:{receiver.getsockname()[1]}/")
        answer = _ended(client)
        if not came.wait(PATIENCE_SECONDS):
            raise TimeoutError(f"no message within {PATIENCE_SECONDS:g} s")
        client.delete(f"/webhooks/{webhook}")
    return answer


@contextmanager
def long_fits(client: httpx2.Client) -> Iterator[None]:
    """Have fits run that take hours."""
    with ExitStack() as stack:
        for _ in range(FITS):
            made = _fit(client, LONG).raise_for_status().json()["id"]
            stack.callback(client.post, f"/fits/{made}/cancel")
        yield


def fitted_soon(client: httpx2.Client) -> httpx2.Response:
    """Ask for a short fit, and return the answer once it has ended."""
    answer = _fit(client, QUICK)
    if answer.status_code >= 400:
        return answer
    where, ends = f"/fits/{answer.json()['id']}", time.monotonic() + PATIENCE_SECONDS
    while client.get(where).json()["status"] in ("queued", "running"):
        if time.monotonic() > ends:
            raise TimeoutError(f"a short fit did not end within {PATIENCE_SECONDS:g} s")
        time.sleep(0.1)
    return answer


def _webhook(client: httpx2.Client, url: str) -> str:
    return str(client.post("/webhooks", json={"url": url}).raise_for_status().json()["id"])


def _fit(client: httpx2.Client, config: dict[str, Any]) -> httpx2.Response:
    dataset = client.get("/datasets").json()["items"][0]["id"]
    return client.post("/fits", json={"dataset_id": dataset, "config": config})


def _ended(client: httpx2.Client) -> httpx2.Response:
    """Cancel a fit as soon as it is asked for."""
    made = _fit(client, LONG)
    return client.post(f"/fits/{made.raise_for_status().json()['id']}/cancel")
