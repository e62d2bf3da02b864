"""Backups: all records of an instant as plain data, and the objects they name, in a folder.

    backup.json              what there is; written last, so a backup is whole or not there
    records-backup_X.jsonl   a line for each row: the table's name and the row's columns
    objects/                 as in the deployment

Nothing in it depends on the kind of database or object store that it came from. Records are read
first, in one transaction, and then the objects; so a service may go on meanwhile.
"""

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import Select, Table, insert, select

from store.answers import PROVISIONAL
from store.database import Store
from store.errors import DamagedError, StoreError
from store.housekeeping import KEYS, known_keys
from store.ids import new_id
from store.objects import Objects
from store.records import (
    CondemnedObject,
    Delivery,
    Deployment,
    FitRecord,
    IdempotencyKey,
    Record,
)

FORMAT = 1  # of a backup; grows when older versions could not restore it
SUMMARY = "backup.json"
# What is of this deployment alone, or of the next minutes.
LEFT_OUT = {kind.__tablename__ for kind in (Deployment, CondemnedObject, IdempotencyKey, Delivery)}
# Gone in seconds: a fit that runs starts anew when restored.
PASSING = {column.key: None for column in PROVISIONAL} | {"first_bytes": 0}
AT_A_TIME = 4  # objects in hand
ROWS_AT_A_TIME = 500
TRIES = 5

OnCopied = Callable[[int, int, int], None]  # objects done, of how many, and their bytes


class Outcome(NamedTuple):
    """What a backup or a restoration did.

    Attributes
    ----------
    rows, objects
        How many there are.
    copied
        Objects that were not there before.
    bytes
        Of these.
    damaged
        Objects that the records name and that are lost or damaged: they could not be copied.
    """

    rows: int
    objects: int
    copied: int
    bytes: int
    damaged: list[str]


def backup(
    store: Store, folder: Path, say: OnCopied, *, project: str | None = None, deep: bool = False
) -> Outcome:
    """Bring the backup in a folder up to date, or make it; all objects copied are read again.

    Objects that it has are not copied again; those that no record names any more are deleted at
    the end. The previous backup stays valid until this one is complete.

    Parameters
    ----------
    project
        The one project to copy, with its keys and its part of the audit; None: all.
    deep
        Read objects that were copied before, too, and copy damaged ones again.

    Raises
    ------
    StoreError
        If the folder holds something else, the project has nothing, or too much is deleted
        meanwhile.
    """
    _prepare(folder, store.identity, project)
    with _alone(folder):
        return _backup(store, folder, say, project, deep=deep)


def _backup(
    store: Store, folder: Path, say: OnCopied, project: str | None, *, deep: bool
) -> Outcome:
    target = Objects((folder / "objects").absolute().as_uri())
    for _ in range(TRIES):
        records = folder / f"records-{new_id('backup')}.jsonl"
        taken_at = time.time()
        rows, named = _write_records(store, records, project)
        if project is not None and not rows:
            records.unlink()
            raise StoreError(f"There is no project {project!r}: nothing belongs to it.")
        copied, size, failed = _copy(store.objects, target, named, say, deep=deep)
        with store.reading() as session:
            damaged = sorted(failed & known_keys(session))
        if len(damaged) == len(failed):
            break
        records.unlink()  # what was deleted meanwhile is in it
    else:
        raise StoreError("Too much is deleted while it is copied: try again when it is calmer.")
    summary = {
        "format": FORMAT,
        "deployment": store.identity,
        "project": project,
        "taken_at": taken_at,
        "records": records.name,
        "sha256": _digest(records),
        "objects": len(named),
        "damaged": damaged,
    }
    _write_durably(folder / SUMMARY, json.dumps(summary, indent=2))
    for old in folder.glob("records-*.jsonl"):
        if old != records:
            old.unlink()
    target.delete(*(key for key, _ in target.list() if key not in named))
    target.delete_partial(taken_at)
    return Outcome(rows, len(named), copied, size, damaged)


def restore(store: Store, folder: Path, say: OnCopied) -> Outcome:
    """Fill an empty deployment with a backup; the deployment keeps its own identity.

    Objects come first, then all records in one transaction, so an interrupted restore can be
    repeated.

    Raises
    ------
    StoreError
        If there is no backup in the folder that this version can read, or the deployment is not
        empty.
    """
    records = _checked_records(folder)
    named: set[str] = set()
    for table, row in _read_records(records):
        named.update(_keys_in(table, row))
    _refuse_full(store, named)
    source = Objects((folder / "objects").absolute().as_uri())
    copied, size, damaged = _copy(source, store.objects, named, say, deep=True)
    rows = 0
    with store.writing() as session:
        for table, lines in groupby(_read_records(records), key=lambda line: line[0]):
            mine = (row for _, row in lines)
            while some := list(islice(mine, ROWS_AT_A_TIME)):
                session.execute(insert(table), some)
                rows += len(some)
    return Outcome(rows, len(named), copied, size, sorted(damaged))


def _tables() -> list[Table]:
    """Return the tables of a backup; those that others refer to come first."""
    return [table for table in Record.metadata.sorted_tables if table.name not in LEFT_OUT]


def _keys_in(table: Table, row: dict[str, Any]) -> list[str]:
    """Return the objects that a row names."""
    columns = [key.key for key in KEYS if key.class_.__tablename__ == table.name]
    return [row[column] for column in columns if row.get(column) is not None]


def _prepare(folder: Path, identity: str, project: str | None) -> None:
    """Make the folder of a backup; raise ``StoreError`` if it holds something else."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if (folder / SUMMARY).exists():
        summary = _summary(folder)
        if summary["deployment"] != identity:
            raise StoreError(
                f"{folder} holds a backup of another deployment ({summary['deployment']}): choose "
                "another folder."
            )
        if (of := summary.get("project")) != project:
            held = "all projects" if of is None else f"the project {of!r}"
            raise StoreError(f"{folder} holds a backup of {held}: choose another folder.")
    elif {file.name.partition("-")[0] for file in folder.iterdir()} - {"objects", "records"}:
        raise StoreError(f"{folder} holds something else: choose an empty folder, or a new one.")


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other backups out of a folder; raise ``StoreError`` if there is one."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise StoreError(f"Another backup into {folder} is under way.") from error
    finally:
        os.close(descriptor)


def _summary(folder: Path) -> dict[str, Any]:
    try:
        summary: dict[str, Any] = json.loads((folder / SUMMARY).read_text())
        if summary["format"] > FORMAT:
            raise StoreError(f"The backup in {folder} was made by a newer version of Fewview.")
    except FileNotFoundError as error:
        raise StoreError(f"There is no backup in {folder}: it has no {SUMMARY}.") from error
    except (ValueError, TypeError, KeyError) as error:
        raise StoreError(f"{folder / SUMMARY} cannot be read: it is damaged.") from error
    return summary


def _write_records(store: Store, file: Path, project: str | None) -> tuple[int, set[str]]:
    """Write the rows as of one instant; return how many, and the objects they name."""
    count, named = 0, set[str]()
    engine = store.engine  # a transaction of SQLite sees one instant anyway
    if engine.dialect.name != "sqlite":
        engine = engine.execution_options(isolation_level="REPEATABLE READ")
    with (
        engine.connect() as connection,
        connection.begin(),
        file.open("w") as lines,
    ):
        for table in _tables():
            query = _rows(table, project).execution_options(yield_per=ROWS_AT_A_TIME)
            for found in connection.execute(query).mappings():
                row = dict(found)
                if table.name == FitRecord.__tablename__:
                    row |= PASSING
                named.update(_keys_in(table, row))
                lines.write(json.dumps([table.name, row]) + "\n")
                count += 1
        lines.flush()
        os.fsync(lines.fileno())
    return count, named


def _rows(table: Table, project: str | None) -> Select[Any]:
    """Return the query of all rows of a table, or of those of one project.

    What the database computes is left out: it cannot be written.
    """
    query = select(*(column for column in table.columns if column.computed is None))
    if project is None:
        return query
    if "project" in table.columns:
        return query.where(table.columns["project"] == project)
    (reference,) = table.foreign_keys  # to what it is a part of
    owner = reference.column.table
    return query.join(owner).where(owner.columns["project"] == project)


def _checked_records(folder: Path) -> Path:
    summary = _summary(folder)
    records = folder / str(summary["records"])
    if not records.is_file() or _digest(records) != summary["sha256"]:
        raise StoreError(f"{records} is damaged: it is not what was written. Use another backup.")
    return records


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _read_records(file: Path) -> Iterator[tuple[Table, dict[str, Any]]]:
    """Yield every row of a backup with its table; raise ``StoreError`` for what is unknown."""
    with file.open() as lines:
        for line in lines:
            name, row = json.loads(line)
            table = Record.metadata.tables.get(name)
            if table is None or row.keys() - table.columns.keys():
                raise StoreError(
                    f"{file} was made by a newer version of Fewview: its table {name!r} differs."
                )
            yield table, row


def _refuse_full(store: Store, named: set[str]) -> None:
    with store.reading() as session:
        first = {table.name: session.execute(select(table).limit(1)).first() for table in _tables()}
    full = [name for name, row in first.items() if row is not None]
    if full:
        raise StoreError(
            f"The deployment is not empty: there are {', '.join(full)}. Restore into a new one: "
            "another FEWVIEW_DATA_DIR, or FEWVIEW_DATABASE_URL and FEWVIEW_STORE_URL."
        )
    if any(key not in named for key, _ in store.objects.list()):
        raise StoreError(
            f"There are objects of others in {store.objects.url}: choose another FEWVIEW_STORE_URL."
        )


def _copy(
    source: Objects, target: Objects, named: set[str], say: OnCopied, *, deep: bool
) -> tuple[int, int, set[str]]:
    """Copy what is not there; return how many, their bytes, and those that cannot be copied."""
    there = named & {key for key, _ in target.list()}
    if deep:
        there -= target.damaged(there)
    missing = sorted(named - there)
    size, failed = 0, set[str]()
    with ThreadPoolExecutor(AT_A_TIME) as threads:
        copies = threads.map(partial(_copy_one, source, target), missing)
        for done, (key, copied) in enumerate(zip(missing, copies, strict=True), start=1):
            if copied is None:
                failed.add(key)
            else:
                size += copied
            say(done, len(missing), size)
    return len(missing) - len(failed), size, failed


def _copy_one(source: Objects, target: Objects, key: str) -> int | None:
    """Copy an object, read it back, and return its size; None if it is lost or damaged."""
    try:
        data = source.get(key)
    except (FileNotFoundError, DamagedError):
        return None
    target.put(key, data)
    return target.check(key)


def _write_durably(file: Path, text: str) -> None:
    """Replace a file by another, so that it is the old or the new one whatever happens."""
    new = file.with_suffix(".new")
    with new.open("w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    new.replace(file)
