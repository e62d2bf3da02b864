"""The commands ``fewview key`` and ``fewview audit``: they work on the records themselves."""

import math
import sys
import time
from contextlib import closing
from datetime import UTC, datetime

from fewview.plain import visible
from pydantic import Field, field_validator
from pydantic_settings import CliApp, CliPositionalArg, SettingsConfigDict

from service.doctor import open_store
from service.keeping import ending
from store import access_keys
from store import audit as audits
from store.access_keys import SCOPES, Project
from store.authors import Author
from store.database import Store
from store.errors import NotFoundError
from store.private import keep_private
from store.quotas import Quotas
from store.records import DEFAULT_PROJECT, AccessKey
from store.settings import StoreSettings
from worker.settings import listed

BY_COMMAND = Author(key_id="command line")  # as the audit has it
DAY_SECONDS = 24 * 3600.0
USAGE = """\
usage: fewview key create NAME [--scopes read,lift,...] [--project ...] [--expires-in-days ...]
       fewview key list
       fewview key revoke KEY_ID

Keys let clients in. Each has scopes and a project, whose records alone it sees. What these commands
change is in force in every process of the API within a second. Each has --help."""


class Create(StoreSettings, Quotas):
    """Make a key, and print its token, which is stored nowhere: keep it."""

    model_config = SettingsConfigDict(
        cli_prog_name="fewview key create", cli_kebab_case=True, extra="ignore"
    )

    name: CliPositionalArg[str] = Field(
        min_length=1, max_length=200, description="Its owner, to distinguish keys."
    )
    scopes: str = Field(
        "read,lift",
        description="What it allows, separated by commas: `read` what is stored; `lift` frames at "
        "once; `write`: store, change, fit, cancel; `delete`; `webhook`: have URLs notified when "
        "jobs end; `admin`: keys and the audit.",
    )
    project: Project = Field(DEFAULT_PROJECT, description="Whose records it sees.")
    expires_in_days: float | None = Field(None, gt=0, le=36500, description="Default: never.")

    @field_validator("scopes")
    @classmethod
    def _are_scopes(cls, scopes: str) -> str:
        names = listed(scopes)
        if not names or set(names) - set(SCOPES):
            raise ValueError(f"expected some of {', '.join(SCOPES)}; got {scopes!r}")
        return scopes


class Listing(StoreSettings):
    """List all keys, newest first."""

    model_config = SettingsConfigDict(cli_prog_name="fewview key list", cli_kebab_case=True)


class Revoke(StoreSettings):
    """Revoke a key."""

    model_config = SettingsConfigDict(cli_prog_name="fewview key revoke", cli_kebab_case=True)

    key_id: CliPositionalArg[str] = Field(description="As `fewview key list` has it.")


class Audit(StoreSettings):
    """Print who changed what, newest first: when, by which key, in which project, and what."""

    model_config = SettingsConfigDict(cli_prog_name="fewview audit", cli_kebab_case=True)

    by: str | None = Field(None, description="Changes by this key only.")
    target: str | None = Field(None, description="Changes of this dataset, fit, ... only.")
    limit: int = Field(100, ge=1, le=100_000, description="Lines at most.")


def key(arguments: list[str]) -> None:
    """Run ``fewview key``: status 0, 1 if there is no such key, 2 if it cannot be carried out."""
    command = COMMANDS.get(arguments[0]) if arguments else None
    if command is None:
        helped = arguments[:1] in (["--help"], ["-h"])
        print(USAGE, file=sys.stdout if helped else sys.stderr)
        sys.exit(0 if helped else 2)
    with ending("key"):
        command(arguments[1:])


def _create(arguments: list[str]) -> None:
    asked = CliApp.run(Create, cli_args=arguments)
    keep_private(asked)
    with closing(Store(asked)) as store:  # which is made: a key comes before the first start
        record, token = access_keys.create(
            store.on_behalf_of(BY_COMMAND),
            name=asked.name,
            project=asked.project,
            scopes=[scope for scope in SCOPES if scope in listed(asked.scopes)],
            expires_at=asked.expires_in_days and time.time() + asked.expires_in_days * DAY_SECONDS,
            quotas=Quotas(**{name: getattr(asked, name) for name in Quotas.model_fields}),
        )
    print(f"{record.id} is in force. Its token cannot be shown again:", file=sys.stderr)
    print(token)


def _list(arguments: list[str]) -> None:
    settings = CliApp.run(Listing, cli_args=arguments)
    with closing(open_store(settings)) as store:
        for record in access_keys.page(store, limit=access_keys.MAX_KEYS):
            scopes = ",".join(record.scopes)
            name = visible(record.name)
            print(f"{record.id}  {_state(record):8} {record.project:12} {scopes:28} {name}")


def _state(record: AccessKey) -> str:
    if record.revoked_at is not None:
        return "revoked"
    return "expired" if (record.expires_at or math.inf) <= time.time() else "in force"


def _revoke(arguments: list[str]) -> None:
    settings = CliApp.run(Revoke, cli_args=arguments)
    with closing(open_store(settings)) as store:
        try:
            access_keys.revoke(store.on_behalf_of(BY_COMMAND), settings.key_id)
        except NotFoundError as error:
            print(visible(f"fewview key revoke: {error}"), file=sys.stderr)
            sys.exit(1)
    print(f"{settings.key_id} is revoked.")


def audit(arguments: list[str]) -> None:
    """Run ``fewview audit``."""
    settings = CliApp.run(Audit, cli_args=arguments)
    with ending("audit"), closing(open_store(settings)) as store:
        for entry in audits.page(
            store, limit=settings.limit, key_id=settings.by, target=settings.target
        ):
            at = datetime.fromtimestamp(entry.at, UTC).isoformat(timespec="seconds")
            request = f"  {entry.request_id}" if entry.request_id else ""
            line = f"{at}  {entry.key_id:30} {entry.project:12} {entry.action:15} "
            print(visible(f"{line}{entry.target}{request}"))


COMMANDS = {"create": _create, "list": _list, "revoke": _revoke}
