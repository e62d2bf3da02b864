"""Opening the store: one handle for records and objects."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, inspect, select, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session
from sqlalchemy.pool import NullPool
from sqlalchemy.schema import CreateColumn

from store import deployment
from store.errors import StoreError
from store.objects import Objects
from store.records import Record
from store.settings import StoreSettings

_BUSY_TIMEOUT_MS = 20_000


class Store:
    """Records and objects of one deployment. Safe to share between threads, never across a fork."""

    def __init__(self, settings: StoreSettings, *, forks: bool = False) -> None:
        """Open records and objects, making folders, tables and nullable columns that are missing.

        Raises ``StoreError`` for records of another version of Fewview that differ in more, and
        ``DeploymentError`` for records and objects that do not belong together.

        Parameters
        ----------
        forks
            This process will fork. Then it keeps no connection open between uses, for SQLite drops
            the locks of a file when any inherited descriptor of it is closed; and it may not touch
            the objects, whose threads would not live on in the fork, so another process must have
            opened the store before.
        """
        self.engine = _open_records(settings.resolved_database_url, pooled=not forks)
        self.objects = Objects(settings.resolved_store_url)
        if not forks:
            self.identity = deployment.agree(self.reading, self.writing, self.objects)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Give a session for reading."""
        with Session(self.engine) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Give a session whose writes are committed together on leaving, or not at all."""
        engine = self.engine.execution_options(writing=True)
        with Session(engine, expire_on_commit=False) as session, session.begin():
            yield session

    def check_records(self) -> None:
        """Raise if the records cannot be read."""
        with self.engine.connect() as connection:
            connection.execute(text("SELECT 1 FROM fits LIMIT 1"))

    def close(self) -> None:
        """Close the connections to the records."""
        self.engine.dispose()


def _open_records(url: URL, *, pooled: bool) -> Engine:
    is_sqlite = url.get_backend_name() == "sqlite"
    if is_sqlite and url.database:
        Path(url.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(url) if pooled else create_engine(url, poolclass=NullPool)
    if is_sqlite:
        event.listen(engine, "connect", _configure_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    with engine.execution_options(writing=True).begin() as connection:
        Record.metadata.create_all(connection)
        _add_missing_columns(connection)
    with engine.connect() as connection:
        for table in Record.metadata.sorted_tables:
            try:
                connection.execute(select(table).limit(0))
            except DBAPIError as error:
                raise StoreError(
                    f"The records in {url} were written by another version of Fewview: its table "
                    f"{table.name!r} differs. Use that version, or another data folder."
                ) from error
    return engine


def _add_missing_columns(connection: Connection) -> None:
    """Add the nullable columns that tables of an older version lack; their rows hold null there.

    The connection must hold the write lock, so that of several processes that open an old folder
    at once only the first adds them.
    """
    found = inspect(connection)
    quote = connection.dialect.identifier_preparer.quote
    for table in Record.metadata.sorted_tables:
        there = {column["name"] for column in found.get_columns(table.name)}
        for column in table.columns:
            if column.nullable and column.name not in there:
                definition = CreateColumn(column).compile(dialect=connection.dialect)
                connection.execute(text(f"ALTER TABLE {quote(table.name)} ADD COLUMN {definition}"))


def _configure_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # transactions begin where _begin_sqlite says, not by guess
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={_BUSY_TIMEOUT_MS}")
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that reads first and writes later fails at once if another wrote in between,
    # whatever the busy timeout: writers take the write lock when they begin.
    writing = connection.get_execution_options().get("writing", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")
