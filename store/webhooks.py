"""Webhooks: URLs that are notified when fits and lifts end, and what is delivered to them.

A delivery is recorded in the transaction that ends the job, so none is lost and none is made up.
Workers send what is due (``worker.webhooks``). Who takes a delivery has it for `LEASE_SECONDS`; one
whose worker died is due again after that. So a receiver may get the same message twice, and knows
it by its identifier.
"""

import json
import random
import secrets
from base64 import b64encode
from collections import Counter
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple, get_args
from urllib.parse import urlsplit

from sqlalchemy import delete as sql_delete
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from typing_extensions import TypeAliasType

from store import audit, clock
from store.authors import ALL_PROJECTS, owned_by
from store.database import Store
from store.errors import InputError, NotFoundError
from store.ids import new_id
from store.locks import alone
from store.records import AccessKey, Delivery, FitRecord, LiftRecord, WebhookRecord
from store.shares import Shares, Who

WebhookEvent = TypeAliasType(
    "WebhookEvent",
    Literal[
        "fit.succeeded",
        "fit.failed",
        "fit.cancelled",
        "lift.succeeded",
        "lift.failed",
        "lift.cancelled",
    ],
)
EVENTS: tuple[WebhookEvent, ...] = get_args(WebhookEvent.__value__)
MAX_WEBHOOKS = 20  # of a project
MAX_WAITING = 1000  # deliveries to one webhook; what ends beyond them is not delivered
OF_HOST = 4  # attempts of a project at one host at a time
LEASE_SECONDS = 60.0  # far longer than an attempt takes
# Before each further attempt, as Standard Webhooks advises; three days in all.
RETRY_SECONDS = (5.0, 300.0, 1800.0, 7200.0, 18000.0, 36000.0, 50400.0, 72000.0, 86400.0)
KEEP_SECONDS = 7 * 24 * 3600.0  # deliveries that ended, to be looked at


class Due(NamedTuple):
    """A delivery to attempt now.

    Attributes
    ----------
    attempt
        Which it is, from 1: the fencing token.
    """

    id: str
    project: str
    url: str
    secret: str
    payload: str
    attempt: int


def create(store: Store, url: str, events: Sequence[WebhookEvent]) -> WebhookRecord:
    """Make a webhook; its secret, which signs its messages, is in the record.

    Raises
    ------
    InputError
        If the project has as many as it may.
    """
    with store.writing() as session:
        alone(session, WebhookRecord.__tablename__)
        if (session.scalar(select(func.count(WebhookRecord.id))) or 0) >= MAX_WEBHOOKS:
            raise InputError("url", f"expected {MAX_WEBHOOKS} webhooks at most; delete some first")
        webhook = WebhookRecord(
            id=new_id("wh"),
            created_at=clock.read(session),
            url=url,
            events=[event for event in EVENTS if event in events],
            secret=f"whsec_{b64encode(secrets.token_bytes(32)).decode()}",
            **owned_by(store.author),
        )
        session.add(webhook)
        audit.note(session, "webhook.create", webhook.id)
    return webhook


def get(store: Store, webhook_id: str) -> WebhookRecord:
    """Return a webhook; raise ``NotFoundError`` if there is none."""
    with store.reading() as session:
        return _found(session, webhook_id)


def delete(store: Store, webhook_id: str) -> None:
    """Delete a webhook and what is to be delivered to it; raise ``NotFoundError`` as `get` does."""
    with store.writing() as session:
        session.delete(_found(session, webhook_id))
        audit.note(session, "webhook.delete", webhook_id)


def page(store: Store, *, limit: int, after: str | None = None) -> list[WebhookRecord]:
    """Return up to ``limit`` webhooks, newest first, older than ``after``."""
    query = select(WebhookRecord).order_by(WebhookRecord.id.desc()).limit(limit)
    if after is not None:
        query = query.where(WebhookRecord.id < after)
    with store.reading() as session:
        return list(session.scalars(query))


def deliveries(
    store: Store, webhook_id: str, *, limit: int, after: str | None = None
) -> list[Delivery]:
    """Return deliveries to a webhook, as :func:`page` returns webhooks; raises as `get` does."""
    query = select(Delivery).where(Delivery.webhook_id == webhook_id)
    if after is not None:
        query = query.where(Delivery.id < after)
    with store.reading() as session:
        _found(session, webhook_id)
        return list(session.scalars(query.order_by(Delivery.id.desc()).limit(limit)))


def announce(session: Session, job: FitRecord | LiftRecord) -> None:
    """Record a message to each webhook of a job's project, as the job ends in a transaction."""
    event = f"{job.noun}.{job.status}"
    query = select(WebhookRecord).where(WebhookRecord.project == job.project)
    for webhook in session.scalars(query, execution_options=ALL_PROJECTS).all():
        if event not in webhook.events or _waiting(session, webhook) >= MAX_WAITING:
            continue
        now = clock.read(session)
        session.add(
            Delivery(
                id=new_id("msg"),
                webhook_id=webhook.id,
                event=event,
                payload=json.dumps(_payload(event, job, now)),
                created_at=now,
                attempts=0,
                next_at=now,
                project=webhook.project,
                key_id=webhook.key_id,
            )
        )


def _waiting(session: Session, webhook: WebhookRecord) -> int:
    waits = (Delivery.webhook_id == webhook.id) & Delivery.next_at.is_not(None)
    return session.scalar(select(func.count(Delivery.id)).where(waits)) or 0


def _payload(event: str, job: FitRecord | LiftRecord, now: float) -> dict[str, Any]:
    """Return what a receiver gets: as little as it takes to ask for the job itself."""
    ended = datetime.fromtimestamp(now, UTC).isoformat(timespec="milliseconds")
    data = {
        "id": job.id,
        "name": job.name,
        "status": job.status,
        "dataset_id": job.dataset_id,
        "model_id": job.model_id,
        "error": job.error,
    }
    return {"type": event, "timestamp": ended.replace("+00:00", "Z"), "data": data}


def any_due(store: Store) -> bool:
    """Return whether a delivery is to be attempted now."""
    with store.reading() as session:
        return session.scalar(select(Delivery.id).where(_due()).limit(1)) is not None


def take_due(store: Store, in_hand: Collection[Due], at_a_time: int) -> list[Due]:
    """Take deliveries that are due, as many as may be in hand with those that are.

    No project gets more than its share of those (`store.shares`), no host of a project more than
    `OF_HOST`, and who has fewest in hand comes first: who does not answer keeps nobody else
    waiting. Those of a webhook whose key is no longer in force end: nothing of them is sent.
    """
    query = (
        select(Delivery, WebhookRecord, AccessKey)
        .join(WebhookRecord)
        .outerjoin(AccessKey, AccessKey.id == WebhookRecord.key_id)
    )
    with store.reading() as session:
        chosen = _choose(_candidates(session), in_hand, at_a_time)
    if not chosen:
        return []
    taken = []
    with store.writing() as session:
        now = clock.read(session)
        rows = session.execute(
            query.where(_due(), Delivery.id.in_(chosen)).with_for_update(
                of=Delivery, skip_locked=True
            )
        ).all()
        for delivery, webhook, key in rows:
            if key is not None and not _in_force(key, now):
                delivery.next_at, delivery.outcome = None, "The webhook's key is not in force."
                continue
            delivery.attempts += 1
            delivery.next_at = now + LEASE_SECONDS
            taken.append(
                Due(
                    delivery.id,
                    webhook.project,
                    webhook.url,
                    webhook.secret,
                    delivery.payload,
                    delivery.attempts,
                )
            )
    return taken


def _candidates(session: Session) -> list[tuple[str, Who]]:
    """Return deliveries that are due, the first few of each webhook, those due longest first."""
    place = func.row_number().over(partition_by=Delivery.webhook_id, order_by=Delivery.next_at)
    due = select(Delivery.id, Delivery.webhook_id, Delivery.next_at, place.label("place")).where(
        _due()
    )
    first = due.subquery()
    query = (
        select(first.c.id, WebhookRecord.project, WebhookRecord.url)
        .join(WebhookRecord, WebhookRecord.id == first.c.webhook_id)
        .where(first.c.place <= OF_HOST)
        .order_by(first.c.next_at)
    )
    return [(name, _receiver(project, url)) for name, project, url in session.execute(query)]


def _choose(due: list[tuple[str, Who]], in_hand: Collection[Due], at_a_time: int) -> list[str]:
    """Choose what is taken now."""
    shares, hosts = Shares(at_a_time), Counter[Who]()
    projects: Counter[str] = Counter()

    def count(receiver: Who) -> None:
        shares.take(receiver)
        hosts[receiver] += 1
        projects[receiver.project] += 1

    for one in in_hand:
        count(_receiver(one.project, one.url))
    left, chosen = list(due), []
    while left := [(name, to) for name, to in left if hosts[to] < OF_HOST and shares.may_take(to)]:
        first = min(left, key=lambda one: (projects[one[1].project], hosts[one[1]]))
        left.remove(first)
        count(first[1])
        chosen.append(first[0])
    return chosen


def _receiver(project: str, url: str) -> Who:
    """Return whose share a delivery takes from: the host stands where a key does elsewhere."""
    return Who(project, urlsplit(url).netloc)


def finish(store: Store, due: Due, outcome: str, *, delivered: bool) -> None:
    """Note how an attempt ended; one that failed is made again, later each time, up to ten times.

    Nothing is noted if another attempt was begun meanwhile, or the webhook was deleted.
    """
    with store.writing() as session:
        delivery = session.get(Delivery, due.id, with_for_update=True)
        if delivery is None or delivery.attempts != due.attempt or delivery.next_at is None:
            return
        now = clock.read(session)
        delivery.outcome = outcome[:200]
        if delivered:
            delivery.delivered_at, delivery.next_at = now, None
        elif due.attempt > len(RETRY_SECONDS):
            delivery.next_at = None
        else:
            pause = RETRY_SECONDS[due.attempt - 1]
            delivery.next_at = now + pause * random.uniform(1, 1.2)  # noqa: S311 (not all at once)


def forget(store: Store) -> None:
    """Delete deliveries that ended long ago."""
    with store.writing() as session:
        old = Delivery.created_at < clock.now() - KEEP_SECONDS
        session.execute(sql_delete(Delivery).where(Delivery.next_at.is_(None), old))


def _due() -> Any:
    return Delivery.next_at <= clock.now()


def _in_force(key: AccessKey, now: float) -> bool:
    return key.revoked_at is None and (key.expires_at is None or key.expires_at > now)


def _found(session: Session, webhook_id: str) -> WebhookRecord:
    webhook = session.get(WebhookRecord, webhook_id)
    if webhook is None:
        raise NotFoundError(WebhookRecord.noun, webhook_id)
    return webhook
