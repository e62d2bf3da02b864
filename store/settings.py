"""Where records and objects live."""

import re
from pathlib import Path

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

_PASSWORD = re.compile(r"^([^:]+://)[^/]*@")


class StoreSettings(BaseSettings):
    """Settings of the store, read from ``FEWVIEW_*`` environment variables; frozen once read."""

    model_config = SettingsConfigDict(
        env_prefix="FEWVIEW_",
        env_ignore_empty=True,
        frozen=True,
        extra="ignore",
        hide_input_in_errors=True,  # there are passwords in URLs
    )

    data_dir: Path = Field(
        Path("fewview-data"),
        description="Folder of the embedded defaults: records, objects and queue live below it.",
    )
    database_url: str | None = Field(
        None,
        description="URL of the records: postgresql://user:password@host/database, or "
        "sqlite:////folder/records.db. Without it: SQLite in the data folder.",
        examples=["postgresql://fewview:password@localhost/fewview"],
    )
    store_url: str | None = Field(
        None,
        description="URL of the objects (arrays, weights): file:///folder, s3://bucket/prefix, "
        "gs://, az://. Without it: a folder in the data folder.",
        examples=["file:///var/lib/fewview/objects"],
    )

    @field_validator("database_url")
    @classmethod
    def _is_url(cls, url: str | None) -> str | None:
        if url is not None and _records(url) is None:
            raise ValueError(
                "expected a URL such as postgresql://user:password@host/database or "
                "sqlite:////folder/records.db; write what is special in a password as %40 (@)"
            )
        return url

    def to_environment(self) -> dict[str, str]:
        """Return the environment variables that give another process these settings."""
        values = self.model_dump(mode="json", exclude_none=True)
        return {f"FEWVIEW_{name.upper()}": str(value) for name, value in values.items()}

    @property
    def uses_data_dir(self) -> bool:
        """Whether records or objects live in the data folder."""
        return self.database_url is None or self.store_url is None

    @property
    def resolved_database_url(self) -> URL:
        """The records' URL, the embedded default included."""
        known = None if self.database_url is None else _records(self.database_url)
        if known is not None:
            return known
        return URL.create("sqlite", database=str(self.data_dir.absolute() / "records.db"))

    @property
    def resolved_store_url(self) -> str:
        """The objects' URL, the embedded default included."""
        return self.store_url or (self.data_dir.absolute() / "objects").as_uri()


def shown(url: object) -> str:
    """Return a URL for people to read: without user, password and query."""
    return _PASSWORD.sub(r"\1***@", str(url)).partition("?")[0]


def _records(text: str) -> URL | None:
    """Return the URL of a database that can hold records, with the one driver for it; else None."""
    try:
        url = make_url(text)
    except (ArgumentError, ValueError):  # whose messages may hold a part of the password
        return None
    match url.drivername.partition("+")[0]:
        case "sqlite" if url.database not in (None, "", ":memory:"):
            return url.set(drivername="sqlite")
        case "postgresql" | "postgres":
            return url.set(drivername="postgresql+psycopg")
        case _:
            return None
