"""Opening the store: one handle for records and objects."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Engine, inspect, select, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session
from sqlalchemy.schema import CreateColumn

from store import deployment
from store.engine import open_engine
from store.errors import StoreError
from store.locks import alone
from store.objects import Objects
from store.records import Record
from store.settings import StoreSettings


class Store:
    """Records and objects of one deployment. Safe to share between threads, never across a fork."""

    def __init__(self, settings: StoreSettings, *, forks: bool = False) -> None:
        """Open records and objects, making folders, tables and nullable columns that are missing.

        Raises ``StoreError`` for records of another version of Fewview that differ in more, and
        ``DeploymentError`` for records and objects that do not belong together.

        Parameters
        ----------
        forks
            This process will fork. Then it may not touch the objects, whose threads would not live
            on in the fork, so another process must have opened the store before.
        """
        self.engine = open_engine(settings.resolved_database_url, forks=forks)
        try:
            _prepare(self.engine)
            self.objects = Objects(settings.resolved_store_url)
            if not forks:
                self.identity = deployment.agree(self.reading, self.writing, self.objects)
        except BaseException:
            self.close()
            raise

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Give a session for reading."""
        with Session(self.engine) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Give a session whose writes are committed together on leaving, or not at all.

        In PostgreSQL, transactions run side by side: what one relies on, it locks first and checks
        then. All lock in one order, or two would wait for each other: an idempotency key, a task
        (``store.locks``), dataset, fit, model, lift, chunk of a lift, condemned objects by key.
        """
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


def _prepare(engine: Engine) -> None:
    with engine.execution_options(writing=True).begin() as connection:
        alone(connection, "the tables")
        Record.metadata.create_all(connection)
        _add_missing_columns(connection)
    with engine.connect() as connection:
        for table in Record.metadata.sorted_tables:
            try:
                connection.execute(select(table).limit(0))
            except DBAPIError as error:
                raise StoreError(
                    f"The records in {engine.url} were written by another version of Fewview: its "
                    f"table {table.name!r} differs. Use that version, or another data folder."
                ) from error


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
