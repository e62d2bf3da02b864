"""What is wrong with what somebody sent, in words: the same over HTTP and from the queue."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel

MOST = 50  # mistakes that are reported: a body may have a million
LONGEST = 100  # characters of a name that others are compared with


class Mistake(NamedTuple):
    """One field that is not valid."""

    pointer: str  # JSON pointer (RFC 6901); empty for the whole
    detail: str


def mistakes(
    errors: Sequence[Mapping[str, Any]], kind: type[BaseModel] | None = None
) -> list[Mistake]:
    """Return what pydantic found first, each with a pointer to its field.

    Parameters
    ----------
    errors
        As ``ValidationError.errors()`` gives them.
    kind
        What was to be made; a field that it does not know is answered with one that it does.
    """
    found = []
    for item in errors[:MOST]:
        place = item["loc"]
        detail = item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden" and kind is not None:
            detail = unknown("field", str(place[-1]), _fields(kind, place[:-1]))
        found.append(Mistake(pointer(*place), detail))
    return found


def pointer(*place: int | str) -> str:
    """Return the JSON pointer to a place."""
    return "".join("/" + str(part).replace("~", "~0").replace("/", "~1") for part in place)


def summary(found: Sequence[Mistake]) -> str:
    """Return the first few mistakes in one line."""
    return "; ".join(
        f"{mistake.pointer.lstrip('/') or 'body'}: {mistake.detail}" for mistake in found[:5]
    )


def unknown(noun: str, name: str, known: Collection[str]) -> str:
    """Return that a field or parameter is unknown, and which one may be meant."""
    if not known:
        return f"unknown {noun}: there are none here"
    near = get_close_matches(name[:LONGEST], known, n=1)
    if near:
        return f"unknown {noun}: did you mean {near[0]!r}?"
    return f"unknown {noun}: expected some of {', '.join(known)}"


def _fields(kind: type[BaseModel], place: Sequence[int | str]) -> list[str]:
    """Return the fields known at a place in ``kind``: of all that it may be, where it is a union.

    A part of the place that is no field is an index, or pydantic's name of a union's member.
    """
    kinds = [kind]
    for part in place:
        inner = [
            model
            for outer in kinds
            if part in outer.model_fields
            for model in _models(outer.model_fields[str(part)].annotation)
        ]
        kinds = inner or kinds
    return list(dict.fromkeys(name for model in kinds for name in model.model_fields))


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation names, however wrapped."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)
