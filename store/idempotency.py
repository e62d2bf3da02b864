"""Idempotency keys: a request that is sent twice makes one thing."""

from dataclasses import dataclass

from sqlalchemy.orm import Session

from store import clock
from store.authors import author_of, owned_by
from store.engine import insert
from store.errors import KeyReusedError
from store.records import DEFAULT_PROJECT, IdempotencyKey


@dataclass(frozen=True)
class Idempotency:
    """A client's key for one creating request.

    Attributes
    ----------
    scope
        What the key is unique within: the operation, and the record it works on.
    key
        The client's ``Idempotency-Key``.
    fingerprint
        A digest of the request; the same key with another digest is refused.
    older_fingerprint
        What an older version may have noted of the same request.
    """

    scope: str
    key: str
    fingerprint: str
    older_fingerprint: str | None = None


def replayed(session: Session, request: Idempotency | None) -> str | None:
    """Return the identifier that this very request made before, or None if it is new.

    Raises
    ------
    KeyReusedError
        If the key came before with a different request.
    """
    if request is None:
        return None
    earlier = session.get(IdempotencyKey, (_scope(session, request), request.key))
    if earlier is None:
        return None
    if earlier.fingerprint not in (request.fingerprint, request.older_fingerprint):
        raise KeyReusedError(
            f"Idempotency-Key {request.key!r} was used before with a different request. "
            "Send a new key, or repeat the first request unchanged."
        )
    return earlier.resource_id


def _scope(session: Session, request: Idempotency) -> str:
    """Return what a key is unique within: another project may use the same key."""
    author = author_of(session)
    if author is None or author.project == DEFAULT_PROJECT:
        return request.scope
    return f"{author.project}: {request.scope}"[:200]


def claim(session: Session, request: Idempotency | None, resource_id: str) -> str | None:
    """Record the result of a request in the caller's transaction, or return its earlier result.

    If the same request is in another transaction, this waits for its end, so only one of several
    simultaneous requests makes something.

    Raises
    ------
    KeyReusedError
        If the key came before with a different request.
    """
    if request is None:
        return None
    noted = (
        insert(session, IdempotencyKey)
        .values(
            scope=_scope(session, request),
            key=request.key,
            fingerprint=request.fingerprint,
            resource_id=resource_id,
            created_at=clock.now(),
            **owned_by(author_of(session)),
        )
        .on_conflict_do_nothing()
        .returning(IdempotencyKey.key)
    )
    return replayed(session, request) if session.scalar(noted) is None else None
