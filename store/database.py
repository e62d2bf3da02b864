"""Opening the store: one handle for records and objects."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

from sqlalchemy import text
from sqlalchemy.orm import Session

from store import deployment, schema
from store.authors import Author, AuthoredSession
from store.engine import open_engine
from store.expectations import Expected
from store.locks import alone
from store.objects import Objects
from store.records import DEFAULT_PROJECT
from store.settings import StoreSettings


class Store:
    """Records and objects of one deployment. Safe to share between threads, never across a fork."""

    def __init__(self, settings: StoreSettings, *, forks: bool = False) -> None:
        """Open records and objects, making folders and tables that are missing.

        Raises ``StoreError`` for records of another version of Fewview, save that older ones in the
        data folder are migrated, and ``DeploymentError`` for records and objects that do not belong
        together.

        Parameters
        ----------
        forks
            This process will fork. Then it may not touch the objects, whose threads would not live
            on in the fork, so another process must have opened the store before.
        """
        self.author: Author | None = None
        self.expected: Expected | None = None
        self.engine = open_engine(settings.resolved_database_url, forks=forks)
        try:
            schema.prepare(self.engine, embedded=settings.database_url is None)
            self.objects = Objects(settings.resolved_store_url)
            if not forks:
                self.identity = deployment.agree(self.reading, self.writing, self.objects)
        except BaseException:
            self.close()
            raise

    def on_behalf_of(self, author: Author, expected: Expected | None = None) -> Self:
        """Return this store as an author sees it: the author's project, and nothing else.

        Parameters
        ----------
        expected
            What is compared before that record changes: by `store.lookup.lock`.
        """
        seen = copy.copy(self)
        seen.author, seen.expected = author, expected
        return seen

    @property
    def project(self) -> str:
        """The project whose records are made, and seen where there is an author."""
        return DEFAULT_PROJECT if self.author is None else self.author.project

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Give a session for reading."""
        with AuthoredSession(self.engine, author=self.author) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Give a session whose writes are committed together on leaving, or not at all.

        In PostgreSQL, transactions run side by side: what one relies on, it locks first and checks
        then. All lock in one order, or two would wait for each other: the account of a key with
        quotas, an idempotency key, a task (``store.locks``), dataset, fit, model, lift, chunk of a
        lift, condemned objects by key.
        """
        engine = self.engine.execution_options(writing=True)
        session = AuthoredSession(
            engine, author=self.author, expected=self.expected, expire_on_commit=False
        )
        with session, session.begin():
            if self.author is not None and self.author.quotas.bound_records():
                alone(session, f"account of {self.author.key_id}")
            yield session

    def check_records(self) -> None:
        """Raise if the records cannot be read."""
        with self.engine.connect() as connection:
            connection.execute(text("SELECT 1 FROM fits LIMIT 1"))

    def close(self) -> None:
        """Close the connections to the records."""
        self.engine.dispose()
