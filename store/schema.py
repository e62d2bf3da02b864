"""Which version the tables are of, and bringing them to that of this code.

The steps are in ``store/migrations``, run by Alembic, each noted in the table ``alembic_version``.
Tables without a note are of a version before there were migrations: the first step knows them.
"""

import logging
from pathlib import Path
from typing import Literal, NamedTuple

from sqlalchemy import Connection, Engine, inspect, select, text
from sqlalchemy.exc import DBAPIError, ProgrammingError

from store.errors import StoreError, in_words
from store.locks import alone
from store.records import Record
from store.settings import shown

logger = logging.getLogger(__name__)

REVISIONS = tuple(f"{number:04}" for number in range(1, 14))  # in order
MIGRATIONS = Path(__file__).parent / "migrations"

State = Literal["empty", "older", "current", "newer"]


class SchemaState(NamedTuple):
    """The state of the tables as seen by this code, and their revision if they have one."""

    state: State
    revision: str | None


def version(connection: Connection) -> SchemaState:
    """Return the version of the tables."""
    found = inspect(connection)
    revision = None
    if found.has_table("alembic_version"):
        revision = connection.scalar(text("SELECT version_num FROM alembic_version"))
    if revision is None:
        some = any(found.has_table(table.name) for table in Record.metadata.sorted_tables)
        return SchemaState("older" if some else "empty", None)
    if revision not in REVISIONS:
        return SchemaState("newer", revision)
    return SchemaState("current" if revision == REVISIONS[-1] else "older", revision)


def look(engine: Engine) -> SchemaState:
    """Return the same for the records of an engine."""
    with engine.connect() as connection:
        return version(connection)


def prepare(engine: Engine, *, embedded: bool) -> None:
    """Have the tables be those of this code.

    Where there are none they are made. Those of an older version are migrated if the records are
    ours alone, in the data folder.

    Raises
    ------
    StoreError
        If they are of a newer version, or of an older one in a database of the user's own, who may
        want to choose the hour, and to stop others of the older version first.
    """
    found = look(engine)
    if found.state == "older" and not embedded:
        raise StoreError(
            f"The records in {shown(engine.url)} are of an older version of Fewview: stop what "
            "uses them, make a backup with that older version, and run `fewview migrate`."
        )
    if found.state != "current":
        migrate(engine)


def migrate(engine: Engine) -> SchemaState:
    """Bring the tables to the version of this code; return which they were of.

    All of it happens or nothing. Of several processes the first does it and the others wait.

    Raises
    ------
    StoreError
        If the tables are of a newer version, or differ from all that were ever written.
    """
    with engine.execution_options(writing=True).begin() as connection:
        if connection.dialect.name == "postgresql":  # there may be many records
            connection.execute(text("SET LOCAL statement_timeout = 0"))
        alone(connection, "the tables")
        found = version(connection)
        if found.state == "newer":
            raise StoreError(
                f"The records in {shown(engine.url)} are of a newer version of Fewview (tables "
                f"{found.revision}, this one knows {REVISIONS[-1]}): use that version."
            )
        if found.state != "current":
            _upgrade(connection)
            _check(connection)
    return found


def _upgrade(connection: Connection) -> None:
    logging.getLogger("alembic").setLevel(logging.WARNING)  # before it logs its imports
    from alembic import command  # noqa: PLC0415 (takes long to import, and is hardly ever needed)
    from alembic.config import Config  # noqa: PLC0415

    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    try:
        command.upgrade(config, "head")
    except DBAPIError as error:  # a step counts on a column that is not there
        if isinstance(error, ProgrammingError) or "no such column" in str(error.orig):
            raise _strange(connection, in_words(error)) from error
        raise


def _check(connection: Connection) -> None:
    """Raise ``StoreError`` unless all tables can be read as they shall be."""
    for table in Record.metadata.sorted_tables:
        try:
            connection.execute(select(table).limit(0))
        except DBAPIError as error:
            raise _strange(connection, f"its table {table.name!r} differs") from error


def _strange(connection: Connection, why: str) -> StoreError:
    return StoreError(
        f"The records in {shown(connection.engine.url)} were written by another version of "
        f"Fewview: {why}. Use that version, or another data folder."
    )
