"""JSON values of another kind than expected: they are refused where pydantic would convert them."""

from collections.abc import Iterator
from itertools import islice
from typing import Any

from pydantic import BaseModel

from service.http.errors import of_mistakes
from store.mistakes import MOST, Mistake, pointer

_Place = tuple[int | str, ...]


def refuse_converted(given: Any, made: BaseModel) -> None:
    """Refuse ``true`` and ``"1"`` in place of 1, and 1 in place of ``true``.

    Parameters
    ----------
    given, made
        What came, as JSON was parsed, and what pydantic has made of it.

    Raises
    ------
    ApiError
        422 with a pointer to each value, up to so many.
    """
    if found := list(islice(_converted(given, made, ()), MOST)):
        raise of_mistakes(found)


def _converted(given: Any, made: Any, place: _Place) -> Iterator[Mistake]:
    if made is given or given is None:  # the same, or a default in its place
        return
    if isinstance(given, dict):
        for name, value in given.items():
            yield from _converted(value, _within(made, name), (*place, name))
    elif isinstance(given, list) and isinstance(made, list | tuple):
        for index, (value, kept) in enumerate(zip(given, made, strict=False)):
            yield from _converted(value, kept, (*place, index))
    elif isinstance(made, bool) and not isinstance(given, bool):
        yield Mistake(pointer(*place), f"expected true or false, got {given!r}")
    elif _is_number(made) and not _is_number(given):
        yield Mistake(pointer(*place), f"expected a number, got {given!r}")


def _within(made: Any, name: str) -> Any:
    """Return what was made of a member of an object, if it is still there."""
    if isinstance(made, BaseModel):
        field = type(made).model_fields.get(name)
        # What becomes an array (``Any``) is looked at as that is done.
        return None if field is None or field.annotation is Any else getattr(made, name)
    return made.get(name) if isinstance(made, dict) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
