"""Webhooks: signed messages at the end of jobs, attempted until they arrive, in public alone."""

import hashlib
import hmac
import json
import os
import signal
import threading
from base64 import b64decode, b64encode
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

import pytest
from redis import Redis
from sqlalchemy import text
from standardwebhooks import Webhook

from store import access_keys, datasets, fits, jobs, lifts, lookup, webhooks
from store.authors import Author
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import InputError
from store.records import Delivery, FitRecord
from tests.deployments import on_every_deployment
from tests.processes import descendants, processes
from tests.tiers import thorough_after
from tests.waiting import wait_for
from tests.worker.conftest import CONFIG, StartWorker
from worker.addresses import is_public
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings
from worker.webhooks import deliver


class Message(NamedTuple):
    path: str
    headers: dict[str, str]
    body: str


class Receiver:
    """Notes what it gets, and answers with the statuses that it is given, the last for good."""

    def __init__(self) -> None:
        self.got: list[Message] = []
        self.statuses = [204]
        self.answering = threading.Event()
        self.answering.set()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                receiver.got.append(Message(self.path, dict(self.headers.items()), body))
                receiver.answering.wait()
                many = len(receiver.statuses) > 1
                self.send_response(receiver.statuses.pop(0) if many else receiver.statuses[0])
                self.send_header("Location", "/elsewhere")
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self.server.server_port
        self.url = f"http://127.0.0.1:{self.port}/hook?lab=1"


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receiving() as made:
        yield made


@contextmanager
def receiving() -> Iterator[Receiver]:
    made = Receiver()
    thread = threading.Thread(target=made.server.serve_forever)
    thread.start()
    yield made
    made.answering.set()
    made.server.shutdown()
    made.server.server_close()
    thread.join()


@pytest.fixture
def settings(settings: WorkerSettings) -> WorkerSettings:
    """Allow targets on this machine."""
    return settings.model_copy(update={"webhook_private_targets": True})


def cancelled_fit(store: Store, dataset_id: str) -> str:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config={})
    return fits.cancel(store, fit.id).id


def delivery(store: Store, webhook_id: str) -> Delivery:
    (found,) = webhooks.deliveries(store, webhook_id, limit=9)
    return found


@on_every_deployment
def test_the_ends_of_a_fit_and_of_a_lift_are_delivered_and_signed(
    receiver: Receiver,
    store: Store,
    redis: Redis,
    settings: WorkerSettings,
    dataset_id: str,
    start_worker: StartWorker,
) -> None:
    webhook = webhooks.create(store, receiver.url, webhooks.EVENTS)
    start_worker()
    fit = fits.create(store, dataset_id=dataset_id, name="walk", config=CONFIG)
    enqueue(open_queue(redis), fit)
    wait_for(lambda: receiver.got, "the message", 120)
    (got,) = receiver.got
    assert got.path == "/hook?lab=1"
    sent = json.loads(got.body)
    ended = lookup.get(store, FitRecord, fit.id)
    assert sent["type"] == "fit.succeeded"
    assert sent["data"] == {
        "id": fit.id,
        "name": "walk",
        "status": "succeeded",
        "dataset_id": dataset_id,
        "model_id": ended.model_id,
        "error": None,
    }
    # As the specification of Standard Webhooks has it, and as its library checks it.
    signed = f"{got.headers['webhook-id']}.{got.headers['webhook-timestamp']}.{got.body}"
    key = b64decode(webhook.secret.removeprefix("whsec_"))
    mac = hmac.new(key, signed.encode(), hashlib.sha256).digest()
    assert got.headers["webhook-signature"] == f"v1,{b64encode(mac).decode()}"
    assert Webhook(webhook.secret).verify(got.body, got.headers) == sent
    noted = wait_for(lambda: delivery(store, webhook.id).delivered_at, "the note", 20)
    assert noted >= (ended.finished_at or 0)
    assert delivery(store, webhook.id).next_at is None

    assert ended.model_id is not None
    lift = lifts.create(
        store, model_id=ended.model_id, dataset_id=dataset_id, name="l", chunk_frames=8
    )
    enqueue(open_queue(redis), lift)
    wait_for(lambda: len(receiver.got) > 1, "the second message", 120)
    sent = json.loads(receiver.got[1].body)
    assert sent["type"] == "lift.succeeded"
    assert (sent["data"]["id"], sent["data"]["model_id"]) == (lift.id, ended.model_id)


def test_every_end_is_announced_once_to_those_that_ask_for_it(
    receiver: Receiver, store: Store, settings: WorkerSettings, dataset_id: str
) -> None:
    everything = webhooks.create(store, receiver.url, webhooks.EVENTS)
    failures = webhooks.create(store, receiver.url, ["fit.failed"])
    webhooks.create(store.on_behalf_of(Author("others")), receiver.url, webhooks.EVENTS)
    cancelled = cancelled_fit(store, dataset_id)
    fits.cancel(store, cancelled)  # again
    refused = jobs.refuse(
        store, FitRecord, job_id="j", error={"code": "c"}, name="f", dataset_id="", config={}
    )
    deliver(settings)
    sent = sorted((m["type"], m["data"]["id"]) for m in map(json.loads, bodies(receiver)))
    assert sent == sorted(
        [("fit.cancelled", cancelled), ("fit.failed", refused), ("fit.failed", refused)]
    )
    assert delivery(store, failures.id).event == "fit.failed"
    assert len(webhooks.deliveries(store, everything.id, limit=9)) == 2
    webhooks.delete(store, everything.id)
    assert not webhooks.any_due(store)


def bodies(receiver: Receiver) -> list[str]:
    return [message.body for message in receiver.got]


def due_again(store: Store) -> None:
    """Let the time until the next attempt pass."""
    with store.writing() as session:
        session.execute(text("UPDATE deliveries SET next_at = 0 WHERE next_at IS NOT NULL"))


def test_what_fails_is_attempted_again_until_it_is_given_up(
    receiver: Receiver, store: Store, settings: WorkerSettings, dataset_id: str
) -> None:
    receiver.statuses = [500, 302, 204]
    webhook = webhooks.create(store, receiver.url, webhooks.EVENTS)
    cancelled_fit(store, dataset_id)
    deliver(settings)
    first = delivery(store, webhook.id)
    assert (first.attempts, first.outcome, first.delivered_at) == (1, "The answer was 500.", None)
    assert 4 < (first.next_at or 0) - first.created_at < 20
    deliver(settings)  # which is not due yet
    due_again(store)
    deliver(settings)
    assert delivery(store, webhook.id).outcome == "The answer was 302."  # and it is not followed
    due_again(store)
    deliver(settings)
    assert delivery(store, webhook.id).delivered_at is not None
    assert [message.path for message in receiver.got] == ["/hook?lab=1"] * 3
    assert len({message.headers["webhook-id"] for message in receiver.got}) == 1
    assert len(set(bodies(receiver))) == 1

    receiver.statuses = [500]
    webhooks.delete(store, webhook.id)
    webhook = webhooks.create(store, receiver.url, webhooks.EVENTS)
    cancelled_fit(store, dataset_id)
    while webhooks.any_due(store):
        deliver(settings)
        due_again(store)
    assert delivery(store, webhook.id).attempts == len(webhooks.RETRY_SECONDS) + 1
    assert delivery(store, webhook.id).next_at is None


def test_a_delivery_outlives_the_worker_that_attempted_it(
    receiver: Receiver, store: Store, dataset_id: str, start_worker: StartWorker
) -> None:
    receiver.answering.clear()
    webhook = webhooks.create(store, receiver.url, webhooks.EVENTS)
    cancelled_fit(store, dataset_id)
    worker = start_worker()
    wait_for(lambda: receiver.got, "the first attempt", 60)
    family = descendants(worker.pid)
    os.kill(worker.pid, signal.SIGKILL)
    wait_for(lambda: not family & processes().keys(), "the end of who attempts it", 20)
    assert delivery(store, webhook.id).attempts == 1
    receiver.answering.set()
    start_worker()
    due_again(store)  # the time of the lease
    wait_for(lambda: delivery(store, webhook.id).delivered_at, "another attempt", 60)
    first, second = receiver.got
    assert first.headers["webhook-id"] == second.headers["webhook-id"]
    assert first.body == second.body


def test_nothing_is_sent_once_the_key_is_not_in_force(
    receiver: Receiver, store: Store, settings: WorkerSettings, dataset_id: str
) -> None:
    key, _ = access_keys.create(store, name="lab", scopes=["webhook"])
    mine = store.on_behalf_of(Author(key_id=key.id))
    webhook = webhooks.create(mine, receiver.url, webhooks.EVENTS)
    cancelled_fit(store, dataset_id)
    deliver(settings)
    assert len(receiver.got) == 1
    access_keys.revoke(store, key.id)
    cancelled_fit(store, dataset_id)
    deliver(settings)
    assert len(receiver.got) == 1
    newest = webhooks.deliveries(store, webhook.id, limit=1)[0]
    assert newest.outcome == "The webhook's key is not in force."
    assert (newest.next_at, newest.attempts) == (None, 0)


@pytest.mark.parametrize(
    "host",
    thorough_after(
        2,
        [
            "localhost",
            "127.1",
            "127.0.0.1",
            "0x7f000001",
            "[::ffff:127.0.0.1]",
            "0.0.0.0",  # noqa: S104 (nothing listens on it)
        ],
    ),
)
def test_nothing_is_sent_to_private_addresses(
    receiver: Receiver, store: Store, settings: WorkerSettings, dataset_id: str, host: str
) -> None:
    """Whatever stands in the records: the address counts that a name has as it is connected to."""
    webhook = webhooks.create(store, f"http://{host}:{receiver.port}/", webhooks.EVENTS)
    cancelled_fit(store, dataset_id)
    deliver(settings.model_copy(update={"webhook_private_targets": False}))
    assert not receiver.got
    outcome = delivery(store, webhook.id).outcome
    assert outcome == "The host's address is not public: nothing was sent."


def test_one_receiver_keeps_no_other_waiting(
    receiver: Receiver, store: Store, settings: WorkerSettings, dataset_id: str
) -> None:
    """Neither where there is nobody, nor where there is no HTTP."""
    silent = Receiver().server  # bound, and nobody accepts
    for url in ("http://no.such.host.invalid/", f"http://127.0.0.1:{silent.server_port}/"):
        webhooks.create(store, url, webhooks.EVENTS)
    webhooks.create(store, receiver.url, webhooks.EVENTS)
    cancelled_fit(store, dataset_id)
    delivering = threading.Thread(target=deliver, args=(settings,))
    delivering.start()
    wait_for(lambda: receiver.got, "the one that answers", 10)
    assert delivering.is_alive()
    silent.server_close()  # or its attempt would take all of its time
    delivering.join(60)
    assert not delivering.is_alive()


@pytest.mark.parametrize(
    ("address", "public"),
    [
        ("8.8.8.8", True),
        ("2606:4700::1111", True),
        ("64:ff9b::808:808", True),
        ("2001:0:808:808:0:0:f7f7:f7f7", True),
        ("10.0.0.1", False),
        ("172.16.3.4", False),
        ("192.168.1.1", False),
        ("100.64.0.1", False),
        ("169.254.169.254", False),
        ("0.0.0.0", False),  # noqa: S104
        ("224.0.0.1", False),
        ("255.255.255.255", False),
        ("::", False),
        ("::1", False),
        ("::7f00:1", False),
        ("fe80::1", False),
        ("fe80::1%eth0", False),
        ("fc00::1", False),
        ("fec0::1", False),
        ("ff02::1", False),
        ("::ffff:10.0.0.1", False),
        ("64:ff9b::a00:1", False),
        ("2002:a00:1::", False),
        ("2001:0:0:0:0:0:f5ff:fffe", False),
    ],
)
def test_which_addresses_are_public(address: str, public: bool) -> None:
    assert is_public(address) is public


def test_webhooks_are_bounded_in_number(store: Store) -> None:
    for _ in range(webhooks.MAX_WEBHOOKS):
        webhooks.create(store, "https://example.com", webhooks.EVENTS)
    with pytest.raises(InputError, match="at most"):
        webhooks.create(store, "https://example.com", webhooks.EVENTS)
    webhooks.create(store.on_behalf_of(Author("other")), "https://example.com", webhooks.EVENTS)


def test_a_host_that_never_answers_keeps_only_its_own_messages_waiting(
    receiver: Receiver, store: Store, settings: WorkerSettings, capture: Capture
) -> None:
    with ExitStack() as ending:
        silent = ending.enter_context(receiving())
        silent.answering.clear()
        ending.callback(silent.answering.set)
        greedy, other = (store.on_behalf_of(Author(project)) for project in ("greedy", "other"))
        for n in range(webhooks.MAX_WEBHOOKS - 1):
            webhooks.create(greedy, f"{silent.url}&n={n}", webhooks.EVENTS)
        for mine in (greedy, other):
            webhooks.create(mine, receiver.url, webhooks.EVENTS)
        for mine in (greedy, other):
            dataset = datasets.create(mine, capture, CaptureDescription("figure"))
            cancelled_fit(mine, dataset.id)
        delivering = threading.Thread(target=deliver, args=[settings])
        delivering.start()
        ending.callback(delivering.join)
        ending.callback(silent.answering.set)  # first of all, or joining waits for every attempt
        wait_for(lambda: len(receiver.got) == 2, "the messages that can arrive", 10)
        wait_for(lambda: len(silent.got) >= webhooks.OF_HOST, "those that nobody answers", 10)
        assert len(silent.got) == webhooks.OF_HOST
