"""How much a JSON body may hold beside its arrays: counted before each item is validated."""

from typing import Any

from pydantic import BaseModel

from service.http.errors import invalid
from store.mistakes import MOST, pointer

MOST_ITEMS = 50_000  # of one field's lists and objects in all: 64 KiB of metadata have fewer


def check_bounds(body: Any, kind: type[BaseModel]) -> None:
    """Refuse a body of which a field holds too much, or that has too many fields.

    Validation takes a microsecond or more, and keeps hundreds of bytes, for each item that is
    wrong. Fields that become arrays (``Any``) have limits of their own.

    Raises
    ------
    ApiError
        422 with a pointer to the field.
    """
    if not isinstance(body, dict):  # is refused as a whole
        return
    if len(body) > len(kind.model_fields) + MOST:
        name = next(name for name in body if name not in kind.model_fields)
        known = ", ".join(kind.model_fields)
        raise invalid(
            pointer(str(name)[:100]), f"unknown field, one of {len(body):,}: expected {known}"
        )
    for name, field in kind.model_fields.items():
        if field.annotation is not Any and _holds_more(body.get(name), MOST_ITEMS):
            raise invalid(pointer(name), f"expected {MOST_ITEMS:,} values at most")


def _holds_more(value: Any, most: int) -> bool:
    """Whether lists and objects, and those within them, have more items than this."""
    count, containers = 0, [value]
    while containers:
        inside = containers.pop()
        if not isinstance(inside, dict | list):
            continue
        count += len(inside)
        if count > most:
            return True
        items = inside.values() if isinstance(inside, dict) else inside
        containers += [item for item in items if isinstance(item, dict | list)]
    return False
