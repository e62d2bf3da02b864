"""Whether the file of the records is as SQLite wrote it."""

import sqlite3
import time

from sqlalchemy import Engine
from sqlalchemy.exc import DatabaseError, OperationalError

from store.engine import open_engine
from store.errors import in_words

RECORDS_DAMAGED = (
    "The file of the records is damaged. Stop the service and restore a backup; `fewview doctor` "
    "says what is found."
)
CORRUPT = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
STEPS = 10_000  # of SQLite's machine between two looks at the clock


def is_corrupt(error: BaseException) -> bool:
    """Whether an error of the records means that their file is damaged."""
    code = getattr(getattr(error, "orig", None), "sqlite_errorcode", 0)
    return code & 0xFF in CORRUPT  # what an extended code adds is in higher bits


def find_damage(engine: Engine, *, seconds: float, deep: bool = False) -> str | None:
    """Return what is wrong with the file of the records, or None; PostgreSQL looks after its own.

    SQLite keeps no checksums: it finds pages that cannot be, and not every bit that changed.

    Parameters
    ----------
    seconds
        After so many the search ends.
    deep
        Also compare indices with their tables.

    Raises
    ------
    TimeoutError
        If nothing was found in that time.
    OperationalError
        If the records cannot be read.
    """
    if engine.dialect.name != "sqlite":
        return None
    deadline = time.monotonic() + seconds
    fresh = open_engine(engine.url, forks=True)  # other connections remember pages
    try:
        with fresh.connect() as connection:
            driver = connection.connection.driver_connection
            assert isinstance(driver, sqlite3.Connection)  # noqa: S101
            driver.set_progress_handler(lambda: time.monotonic() > deadline, STEPS)
            check = "integrity_check" if deep else "quick_check"
            found = connection.exec_driver_sql(f"PRAGMA {check}(1)").scalar_one()
    except DatabaseError as error:
        if is_corrupt(error):
            return in_words(error)
        if isinstance(error, OperationalError) and "interrupted" in str(error.orig):
            raise TimeoutError(f"the records could not be read whole in {seconds:g} s") from None
        raise
    finally:
        fresh.dispose()
    return None if found == "ok" else str(found)
