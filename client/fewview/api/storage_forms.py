"""What is stored and what it takes, as frozen dataclasses."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StoredKind:
    """How many there are of a kind, and the bytes of their records and objects."""

    kind: str
    count: int
    stored_bytes: int


@dataclass(frozen=True)
class StoredItem:
    """Something stored: ``kind`` is datasets, fits, lifts or models."""

    kind: str
    id: str
    name: str
    stored_bytes: int


@dataclass(frozen=True)
class Storage:
    """What is stored of a project; ``quota_bytes`` is None where there is no bound.

    ``own_bytes``, and ``own`` by kind, count for the quota of the key that asks.
    """

    stored_bytes: int
    items: tuple[StoredKind, ...]
    largest: tuple[StoredItem, ...]
    own_bytes: int
    quota_bytes: int | None
    own: tuple[StoredKind, ...] | None = None
