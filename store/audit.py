"""The audit: who changed what, written in the transaction of the change.

Every change is noted here, so here it is held against its author's account (``store.usage``).
"""

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from store import clock
from store.authors import author_of
from store.database import Store
from store.ids import new_id
from store.records import AuditRecord
from store.usage import check

FREEING = ("delete", "cancel", "revoke")  # which a full account allows


def note(session: Session, action: str, target: str, *, freeing: bool = False) -> None:
    """Note what an author did, in the author's transaction; the service's own work is not noted.

    Raises ``QuotaError`` if the author's account holds more than it may by now, save where the
    action made it smaller.

    Parameters
    ----------
    action
        Kind and verb: ``dataset.create``.
    target
        Identifier of the record.
    freeing
        The account got smaller by the action; one of `FREEING` never makes it larger.
    """
    author = author_of(session)
    if author is None:
        return
    session.add(
        AuditRecord(
            id=new_id("audit"),
            at=clock.read(session),
            project=author.project,
            key_id=author.key_id,
            action=action,
            target=target,
            request_id=author.request_id,
        )
    )
    if not freeing and action.rpartition(".")[2] not in FREEING:
        check(session)


def page(
    store: Store,
    *,
    limit: int,
    after: str | None = None,
    key_id: str | None = None,
    target: str | None = None,
) -> list[AuditRecord]:
    """Return up to ``limit`` entries of all projects, newest first, older than ``after``."""
    query = select(AuditRecord).order_by(AuditRecord.id.desc()).limit(limit)
    if after is not None:
        query = query.where(AuditRecord.id < after)
    equal = {"key_id": key_id, "target": target}
    query = query.filter_by(**{name: value for name, value in equal.items() if value is not None})
    with store.reading() as session:
        return list(session.scalars(query))


def forget(store: Store, *, older_than_seconds: float) -> int:
    """Delete what was noted longer ago than that; return how many entries went."""
    with store.writing() as session:
        old = delete(AuditRecord).where(AuditRecord.at < clock.now() - older_than_seconds)
        gone: int = session.execute(old).rowcount  # type: ignore[attr-defined]
    return gone
