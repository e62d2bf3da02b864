"""Tags and metadata, with which people find stored resources."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import orjson
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from sqlalchemy import ColumnElement, case, cast, func, literal, or_, select
from sqlalchemy.dialects.postgresql import JSONB

from store.records import Labelled

MAX_METADATA = 64 * 1024
MAX_TAGS = 32


def _printable(tag: str) -> str:
    if tag != tag.strip() or not tag.isprintable():
        raise ValueError("expected printable text without blanks at its ends")
    return tag


def _held_by_databases(text: str) -> str:
    if "\0" in text:
        raise ValueError("expected text without the character NUL (U+0000)")
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise ValueError("expected whole characters, got half of one (U+D800 to U+DFFF)")
    return text


def storable(text: str) -> str:
    """Return a text with what no database can hold replaced: NUL, and halves of characters."""
    return text.encode(errors="replace").decode().replace("\0", "?")


def _once(tags: list[str]) -> list[str]:
    return list(dict.fromkeys(tags))


def _bounded(value: dict[str, Any]) -> dict[str, Any]:
    try:
        size = len(orjson.dumps(value))
    except orjson.JSONEncodeError as error:  # nested too deeply, integers beyond 64 bits
        raise ValueError(f"expected JSON that can be given back: {error}") from error
    if size > MAX_METADATA:
        raise ValueError(f"expected {MAX_METADATA} bytes of JSON at most, got {size}")
    for text in _texts(value):
        _held_by_databases(text)
    return value


def _texts(value: Any) -> Iterator[str]:
    """Yield all texts in plain data, keys included."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for item in value.items():
            yield from _texts(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)


Text = Annotated[str, AfterValidator(_held_by_databases)]  # which every database can hold
Tag = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable)]
Tags = Annotated[list[Tag], Field(max_length=MAX_TAGS), AfterValidator(_once)]
Metadata = Annotated[dict[str, Any], AfterValidator(_bounded)]

TAGS = "Words of yours that lists can be filtered by; 32 at most, none twice."
METADATA = "Anything of yours, kept and given back; 64 KiB of JSON at most."


class Labels(BaseModel):
    """The labels of a new resource."""

    model_config = ConfigDict(extra="forbid")

    tags: Tags = Field([], description=TAGS)
    metadata: Metadata = Field({}, description=METADATA)

    def columns(self) -> dict[str, Any]:
        """Return the columns of a record that hold them."""
        return {"tags": self.tags, "user_metadata": self.metadata}


def labels_of(record: Labelled) -> dict[str, Any]:
    """Return the labels of a record, by the names of the fields; older records may have none."""
    return {"tags": record.tags or [], "metadata": record.user_metadata or {}}


def tagged(dialect: str, kind: type[Labelled], tag: str) -> ColumnElement[bool]:
    """Return the condition that a record has a tag.

    Parameters
    ----------
    dialect
        The database's, as SQLAlchemy calls it.
    """
    if dialect == "postgresql":
        return cast(kind.tags, JSONB).contains([tag])  # which an index knows
    elements = func.json_each(kind.tags).table_valued("value")
    return select(literal(1)).select_from(elements).where(elements.c.value == tag).exists()


def mentions(dialect: str, kind: type[Labelled], word: str) -> ColumnElement[bool]:
    """Return the condition that a record's name, or one of its tags, has a word in it.

    Capitals count as small letters, in SQLite those of ASCII alone.

    Parameters
    ----------
    dialect
        The database's, as SQLAlchemy calls it.
    """
    if dialect == "postgresql":
        # An older record may have no tags: null, in JSON.
        array = case((func.jsonb_typeof(cast(kind.tags, JSONB)) == "array", cast(kind.tags, JSONB)))
        tags = func.jsonb_array_elements_text(array).table_valued("value")
    else:
        tags = func.json_each(kind.tags).table_valued("value")
    tag = select(literal(1)).select_from(tags).where(tags.c.value.icontains(word, autoescape=True))
    return or_(kind.name.icontains(word, autoescape=True), tag.exists())


def says(dialect: str, kind: type[Labelled], key: str, text: str) -> ColumnElement[bool]:
    """Return the condition that a record's metadata has a text, or the JSON of a number, a truth.

    Numbers are compared as such: 20, 2e1 and 20.0 are the same.

    Parameters
    ----------
    dialect
        The database's, as SQLAlchemy calls it.
    key
        Of the metadata's first level.
    """
    number = _number(text)
    if dialect == "postgresql":
        meant = [text, *([] if number is None else [number]), *TRUTHS.get(text, ())]
        kept = cast(kind.user_metadata, JSONB)
        return or_(*(kept.contains({key: value}) for value in meant))
    members = func.json_each(kind.user_metadata).table_valued("key", "value", "type")
    value, is_a = members.c.value, members.c.type
    equals = (is_a == "text") & (value == text)
    if number is not None:
        equals |= is_a.in_(("integer", "real")) & (value == number)
    if text in TRUTHS:
        equals |= is_a == text
    return select(literal(1)).select_from(members).where(members.c.key == key, equals).exists()


TRUTHS = {"true": [True], "false": [False]}


def _number(text: str) -> int | float | None:
    """Return the number that a text is the JSON of; None if it is no number, or beyond all."""
    try:
        number = orjson.loads(text)  # integers beyond 64 bits as the nearest number
    except orjson.JSONDecodeError:
        return None
    if type(number) not in (int, float):
        return None
    return number if abs(number) < 2**63 else float(number)  # SQLite has no larger integers
