"""The commands of who keeps a deployment: backup, restore, migrate, prune and doctor."""

import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from fewview.plain import visible
from obstore.exceptions import BaseError as ObjectStoreError
from pydantic import Field
from pydantic_settings import CliApp, CliImplicitFlag, CliPositionalArg, SettingsConfigDict
from sqlalchemy.exc import SQLAlchemyError

from service.doctor import examine, open_store
from service.settings import Settings
from store import backup as backups
from store import housekeeping, retention, schema
from store.access_keys import Project
from store.backup import Outcome
from store.database import Store
from store.engine import open_engine
from store.errors import StoreError, in_words
from store.private import keep_private
from store.settings import StoreSettings, shown
from worker.settings import WorkerSettings

MEBIBYTE = 1024 * 1024
LINE_SECONDS = 10.0  # between two lines of progress where no terminal shows them


class Backup(StoreSettings):
    """Copy what a deployment holds, or one of its projects, into a folder, while it runs or not.

    The records are copied as of one instant, as plain data, and then the objects that they name,
    each checked and read again. The next backup into the same folder copies what is new. The
    settings are those of the deployment: the same variables, or options.
    """

    model_config = SettingsConfigDict(cli_prog_name="fewview backup", cli_kebab_case=True)

    folder: CliPositionalArg[Path] = Field(description="Of the backup; made if it is missing.")
    project: Project | None = Field(
        None, description="Copy this project alone, with its keys and its part of the audit."
    )
    deep: CliImplicitFlag[bool] = Field(
        False, description="Also read what earlier backups copied, and copy anew what is damaged."
    )


class Restore(StoreSettings):
    """Fill an empty deployment with what `fewview backup` copied.

    It may be of another kind: a backup of SQLite and a folder can be restored into PostgreSQL and
    S3. Interrupted, it can be repeated.
    """

    model_config = SettingsConfigDict(cli_prog_name="fewview restore", cli_kebab_case=True)

    folder: CliPositionalArg[Path] = Field(description="Of the backup.")


class Prune(WorkerSettings):
    """Delete jobs that ended long ago (the settings --keep-...-days), and leftovers of crashes.

    Workers do the same, hourly. Datasets and models are never deleted.
    """

    model_config = SettingsConfigDict(cli_prog_name="fewview prune", cli_kebab_case=True)

    dry_run: CliImplicitFlag[bool] = Field(
        False, description="Delete nothing, print what would be deleted."
    )


class Doctor(Settings):
    """Examine a deployment and print what is wrong with it; the exit status is then 1."""

    model_config = SettingsConfigDict(cli_prog_name="fewview doctor", cli_kebab_case=True)

    deep: CliImplicitFlag[bool] = Field(False, description="Read every stored object.")


class Migrate(StoreSettings):
    """Bring the tables of the records to this version, or make them in an empty database.

    Before it, stop what uses the records and make a backup with the version that you had. Records
    in the data folder need no such command: they are migrated when they are opened.
    """

    model_config = SettingsConfigDict(cli_prog_name="fewview migrate", cli_kebab_case=True)

    check: CliImplicitFlag[bool] = Field(
        False,
        description="Change nothing; status 1 if the records are of another version.",
    )


def backup(arguments: list[str]) -> None:
    """Run ``fewview backup``: status 0, 1 if it is not whole, 2 if it cannot be made."""
    settings = CliApp.run(Backup, cli_args=arguments)
    with ending("backup"), closing(open_store(settings)) as store:
        outcome = backups.backup(
            store, settings.folder, CopyProgress(), project=settings.project, deep=settings.deep
        )
        _report("backup", "Backed up", outcome)


def restore(arguments: list[str]) -> None:
    """Run ``fewview restore``: status as above."""
    settings = CliApp.run(Restore, cli_args=arguments)
    with ending("restore"):
        keep_private(settings)
        with closing(Store(settings)) as store:
            outcome = backups.restore(store, settings.folder, CopyProgress())
        _report("restore", "Restored", outcome)


def prune(arguments: list[str]) -> None:
    """Run ``fewview prune``."""
    settings = CliApp.run(Prune, cli_args=arguments)
    with ending("prune"), closing(open_store(settings)) as store:
        if settings.dry_run:
            gone = retention.outdated(store, settings.retention)
        else:
            gone = retention.prune(store, settings.retention)
        swept = housekeeping.sweep(store, dry_run=settings.dry_run)
    for job in gone:
        print(visible(f"{job.noun} {job.id} {job.name!r}, {job.status}"))
    would = "would be " if settings.dry_run else ""
    print(
        f"{len(gone)} fits and lifts {would}deleted. Objects that no record names: "
        f"{swept.deleted} {would}deleted, {swept.condemned} {would}noted, to go in a day."
    )


def migrate(arguments: list[str]) -> None:
    """Run ``fewview migrate``: status 0, 1 if a check finds another version, 2 if it cannot be."""
    settings = CliApp.run(Migrate, cli_args=arguments)
    with ending("migrate"):
        engine = open_engine(settings.resolved_database_url, forks=False)
        found = schema.look(engine) if settings.check else schema.migrate(engine)
        engine.dispose()
    where, to = shown(settings.resolved_database_url), schema.REVISIONS[-1]
    was = f"tables {found.revision}" if found.revision else "tables without a number"
    match found.state:
        case "current":
            print(f"The records in {where} are of this version (tables {to}).")
        case "empty":
            print(f"{where} is empty." if settings.check else f"Made tables {to} in {where}.")
        case _ if settings.check:
            print(f"The records in {where} are of another version: {was}, this one's are {to}.")
        case _:
            print(f"Migrated the records in {where} from {was} to {to}.")
    sys.exit(int(settings.check and found.state != "current"))


def doctor(arguments: list[str]) -> None:
    """Run ``fewview doctor``."""
    settings = CliApp.run(Doctor, cli_args=arguments)
    failed = False
    for verdict in examine(settings, deep=settings.deep):
        print(visible(f"{verdict.state:8} {verdict.part}: {verdict.words}"), flush=True)
        failed |= verdict.state == "failed"
    sys.exit(int(failed))


class CopyProgress:
    """A line of how far copying has come, on stderr: written over on a terminal."""

    def __init__(self) -> None:
        self._printed_at = time.monotonic()
        self._terminal = sys.stderr.isatty()

    def __call__(self, done: int, count: int, size: int) -> None:
        """Print that ``done`` of ``count`` objects, ``size`` bytes, are copied."""
        now = time.monotonic()
        pause = 0.1 if self._terminal else LINE_SECONDS
        if now - self._printed_at < pause and not (self._terminal and done == count):
            return
        self._printed_at = now
        line = f"{done} of {count} objects, {size / MEBIBYTE:.1f} MiB"
        end = "\r" if self._terminal and done < count else "\n"
        print(line, end=end, file=sys.stderr, flush=True)


@contextmanager
def ending(command: str) -> Iterator[None]:
    """End with status 2 and one line where a command cannot be carried out."""
    try:
        yield
    except (StoreError, SQLAlchemyError, ObjectStoreError, OSError) as error:
        print(visible(f"fewview {command}: {in_words(error)}"), file=sys.stderr)
        sys.exit(2)


def _report(command: str, done: str, outcome: Outcome) -> None:
    print(
        f"{done} {outcome.rows} records and {outcome.objects} objects: {outcome.copied} copied "
        f"and checked, {outcome.bytes / MEBIBYTE:.1f} MiB."
    )
    for key in outcome.damaged:
        print(f"fewview {command}: {key} is lost or damaged, and was left out", file=sys.stderr)
    if outcome.damaged:
        sys.exit(1)
