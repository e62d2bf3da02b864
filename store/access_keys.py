"""Keys, with which clients authenticate, and their scopes.

A token is shown once, when its key is made. The records keep only its SHA-256, so that reading them
does not give access. Tokens have 256 random bits, which need neither salt nor a slow hash.
"""

import hashlib
import secrets
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

from pydantic import Field
from sqlalchemy import func, select
from typing_extensions import TypeAliasType

from store import audit, clock
from store.database import Store
from store.errors import InputError, NotFoundError
from store.ids import new_id
from store.locks import alone
from store.quotas import Quotas
from store.records import DEFAULT_PROJECT, AccessKey

Scope = TypeAliasType("Scope", Literal["read", "lift", "write", "delete", "admin", "webhook"])
SCOPES: tuple[Scope, ...] = ("read", "lift", "write", "delete", "admin", "webhook")
Project = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
TOKEN_PREFIX = "fewview_"  # noqa: S105 (by which tokens are found in what was published by mistake)
MAX_KEYS = 10_000  # in force: each process of the API knows all of them


def new_token() -> str:
    """Return a random token."""
    return TOKEN_PREFIX + secrets.token_urlsafe(32)


def digest(token: str) -> str:
    """Return what the records keep of a token."""
    return hashlib.sha256(token.encode()).hexdigest()


def create(
    store: Store,
    *,
    name: str,
    scopes: Iterable[Scope],
    project: str = DEFAULT_PROJECT,
    expires_at: float | None = None,
    quotas: Quotas | None = None,
) -> tuple[AccessKey, str]:
    """Make a key; return its record and its token, which cannot be had again.

    Raises
    ------
    InputError
        If as many keys are in force as may be, or ``expires_at`` is past.
    """
    token = new_token()
    with store.writing() as session:
        alone(session, AccessKey.__tablename__)
        in_force = select(func.count(AccessKey.id)).where(AccessKey.revoked_at.is_(None))
        if (session.scalar(in_force) or 0) >= MAX_KEYS:
            raise InputError("name", f"expected {MAX_KEYS} keys at most; revoke some first")
        now = clock.read(session)
        if expires_at is not None and expires_at <= now:
            raise InputError("expires_at", "expected a moment to come, got one that is past")
        key = AccessKey(
            id=new_id("key"),
            name=name,
            project=project,
            digest=digest(token),
            scopes=[scope for scope in SCOPES if scope in set(scopes)],
            quotas=quotas.model_dump(exclude_none=True) if quotas else None,
            created_at=now,
            expires_at=expires_at,
        )
        session.add(key)
        audit.note(session, "key.create", key.id)
    return key, token


def revoke(store: Store, key_id: str) -> AccessKey:
    """Have a key be refused from now on; it stays in the records. Revoking twice is no error.

    Raises ``NotFoundError`` if there is no such key.
    """
    with store.writing() as session:
        key = session.get(AccessKey, key_id, with_for_update=True)
        if key is None:
            raise NotFoundError("key", key_id)
        if key.revoked_at is None:
            key.revoked_at = clock.read(session)
            audit.note(session, "key.revoke", key_id)
    return key


def get(store: Store, key_id: str) -> AccessKey:
    """Return a key; raise ``NotFoundError`` if there is none."""
    with store.reading() as session:
        key = session.get(AccessKey, key_id)
    if key is None:
        raise NotFoundError("key", key_id)
    return key


def page(store: Store, *, limit: int, after: str | None = None) -> list[AccessKey]:
    """Return up to ``limit`` keys, newest first, older than ``after``; revoked ones too."""
    query = select(AccessKey).order_by(AccessKey.id.desc()).limit(limit)
    if after is not None:
        query = query.where(AccessKey.id < after)
    with store.reading() as session:
        return list(session.scalars(query))


def in_force(store: Store) -> Sequence[AccessKey]:
    """Return the keys that were not revoked; they may have expired."""
    with store.reading() as session:
        return session.scalars(select(AccessKey).where(AccessKey.revoked_at.is_(None))).all()
