"""Connections to the records: SQLite in a file, or PostgreSQL."""

import os
import sqlite3
import time
from pathlib import Path
from typing import Any
from weakref import WeakMethod

import orjson
from sqlalchemy import URL, Connection, Engine, create_engine, event
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session
from sqlalchemy.pool import NullPool

from store.errors import StoreError
from store.records import Record

WAIT_SECONDS = 20  # for a lock, or for an answer
PAUSE_SECONDS = 0.01  # between two tries where SQLite does not wait
PRIMARY_CODE = 0xFF  # the bits of SQLite's code of an error that are its kind
# Of PostgreSQL. Options in the URL take precedence.
CONNECTING = {
    "connect_timeout": "5",
    "tcp_user_timeout": f"{WAIT_SECONDS}000",  # a host that has vanished does not answer
    "keepalives_idle": "10",
    "application_name": "fewview",
}
SESSION = {
    "statement_timeout": f"{WAIT_SECONDS}s",
    "idle_in_transaction_session_timeout": "60s",  # locks of a process that is frozen end
}
POOL = {
    "pool_size": 5,  # connections of a process that are kept open,
    "max_overflow": 15,  # and those besides that are opened when there is much to do
    "pool_timeout": 10,  # seconds to wait for one
    "pool_recycle": 1800,
    "pool_use_lifo": True,  # what is not needed grows old
}


def open_engine(url: URL, *, forks: bool) -> Engine:
    """Return an engine for the records; nothing is read or written yet.

    Raises ``StoreError`` if the driver of PostgreSQL is not installed.

    Parameters
    ----------
    forks
        This process will fork: no connection may be used on both sides.
    """
    if url.get_backend_name() == "sqlite":
        return _open_sqlite(url, forks=forks)
    return _open_postgresql(url, forks=forks)


def insert(session: Session, kind: type[Record]) -> postgresql.Insert | sqlite.Insert:
    """Return an INSERT with ON CONFLICT, which means the same in both databases."""
    is_sqlite = session.get_bind().dialect.name == "sqlite"
    return sqlite.insert(kind) if is_sqlite else postgresql.insert(kind)


def _open_postgresql(url: URL, *, forks: bool) -> Engine:
    options = " ".join(f"-c {name}={value}" for name, value in SESSION.items())
    given = url.query.get("options", "")
    query = CONNECTING | dict(url.query) | {"options": f"{options} {given}".strip()}
    pool = POOL | {"pool_size": 1, "max_overflow": 1} if forks else POOL
    try:
        engine = create_engine(
            url.set(query=query), pool_pre_ping=True, json_serializer=_to_json, **pool
        )
    except ImportError as error:
        raise StoreError(
            "PostgreSQL needs its driver: pip install 'fewview-server[postgresql]'."
        ) from error
    if forks:
        _leave_to_parent(engine)
    return engine


def _leave_to_parent(engine: Engine) -> None:
    """Have forked processes open connections of their own, and leave those of this one alone."""
    dispose = WeakMethod(engine.dispose)

    def forget() -> None:
        alive = dispose()
        if alive is not None:
            alive(close=False)

    os.register_at_fork(after_in_child=forget)


def _open_sqlite(url: URL, *, forks: bool) -> Engine:
    if url.database:
        Path(url.database).parent.mkdir(parents=True, exist_ok=True)
    # SQLite drops the locks of a file when any inherited descriptor of it is closed: a process
    # that forks keeps no connection open between uses.
    pool: dict[str, Any] = {"poolclass": NullPool} if forks else POOL
    engine = create_engine(url, json_serializer=_to_json, **pool)
    event.listen(engine, "connect", _configure_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _configure_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # transactions begin in _begin_sqlite, not implicitly
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={WAIT_SECONDS * 1000}")
    _write_ahead(cursor)
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _write_ahead(cursor: sqlite3.Cursor) -> None:
    """Have the file keep a write-ahead log, which it then does for good.

    Of several that begin this together SQLite refuses some at once, whatever the busy timeout.
    """
    until = time.monotonic() + WAIT_SECONDS
    while True:
        try:
            cursor.execute("PRAGMA journal_mode=WAL")
            return
        except sqlite3.OperationalError as error:
            busy = error.sqlite_errorcode & PRIMARY_CODE == sqlite3.SQLITE_BUSY
            if not busy or time.monotonic() > until:
                raise
            time.sleep(PAUSE_SECONDS)


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that reads first and writes later fails at once if another wrote in between,
    # whatever the busy timeout: writers take the write lock when they begin.
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")


def _to_json(value: Any) -> str:
    """Return JSON, which knows no NaN: PostgreSQL refuses it, and it is null everywhere."""
    return orjson.dumps(value, option=orjson.OPT_NON_STR_KEYS).decode()
