"""Tags and metadata: what people say of anything stored, to find it again."""

from typing import Annotated, Any

import orjson
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from sqlalchemy import ColumnElement, String, case, cast, func, literal, select

from store.records import Labelled

MAX_METADATA = 64 * 1024
MAX_TAGS = 32


def _printable(tag: str) -> str:
    if tag != tag.strip() or not tag.isprintable():
        raise ValueError("expected printable text without blanks at its ends")
    return tag


def _once(tags: list[str]) -> list[str]:
    return list(dict.fromkeys(tags))


def _bounded(value: dict[str, Any]) -> dict[str, Any]:
    try:
        size = len(orjson.dumps(value))
    except orjson.JSONEncodeError as error:  # nested too deeply, integers beyond 64 bits
        raise ValueError(f"expected JSON that can be given back: {error}") from error
    if size > MAX_METADATA:
        raise ValueError(f"expected {MAX_METADATA} bytes of JSON at most, got {size}")
    return value


Tag = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable)]
Tags = Annotated[list[Tag], Field(max_length=MAX_TAGS), AfterValidator(_once)]
Metadata = Annotated[dict[str, Any], AfterValidator(_bounded)]

TAGS = "Words of yours that lists can be filtered by; 32 at most, none twice."
METADATA = "Anything of yours, kept and given back; 64 KiB of JSON at most."


class Labels(BaseModel):
    """What can be said of anything as it is made."""

    model_config = ConfigDict(extra="forbid")

    tags: Tags = Field([], description=TAGS)
    metadata: Metadata = Field({}, description=METADATA)

    def columns(self) -> dict[str, Any]:
        """Return the columns of a record that hold them."""
        return {"tags": self.tags, "user_metadata": self.metadata}


def labels_of(record: Labelled) -> dict[str, Any]:
    """Return what is said of a record, by the names of the fields; older ones may hold nothing."""
    return {"tags": record.tags or [], "metadata": record.user_metadata or {}}


def tagged(dialect: str, kind: type[Labelled], tag: str) -> ColumnElement[bool]:
    """Return the condition that a record has a tag.

    Parameters
    ----------
    dialect
        The database's, as SQLAlchemy calls it.
    """
    each = func.json_each if dialect == "sqlite" else func.json_array_elements_text
    elements = each(kind.tags).table_valued("value")
    return select(literal(1)).select_from(elements).where(elements.c.value == tag).exists()


def says(dialect: str, kind: type[Labelled], key: str, text: str) -> ColumnElement[bool]:
    """Return the condition that a record's metadata has a text, or the JSON of a number, a truth.

    Parameters
    ----------
    dialect
        The database's, as SQLAlchemy calls it.
    key
        Of the metadata's first level.
    """
    value: ColumnElement[str]
    if dialect == "sqlite":
        members = func.json_each(kind.user_metadata).table_valued("key", "value", "type")
        kept = cast(members.c.value, String)  # which says 1 and 0 of truths
        value = case((members.c.type.in_(("true", "false")), members.c.type), else_=kept)
    else:
        members = func.json_each_text(kind.user_metadata).table_valued("key", "value")
        value = members.c.value
    said = (members.c.key == key) & (value == text)
    return select(literal(1)).select_from(members).where(said).exists()
