"""Locks of the records that belong to no row.

In SQLite who writes is alone anyway: a transaction that writes begins by taking the one lock.
"""

import hashlib

from sqlalchemy import Connection, func, select
from sqlalchemy.orm import Session


def alone(transaction: Connection | Session, task: str) -> None:
    """Wait until no other transaction does a task; none begins to before the end of this one."""
    bind = transaction.get_bind() if isinstance(transaction, Session) else transaction
    if bind.dialect.name == "postgresql":
        number = int.from_bytes(hashlib.sha256(task.encode()).digest()[:8], signed=True)
        transaction.execute(select(func.pg_advisory_xact_lock(number)))
