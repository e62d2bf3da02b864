"""How much a JSON body may hold beside its arrays: counted before each item is validated."""

from itertools import islice
from typing import Any

from pydantic import BaseModel

from service.http.errors import invalid, of_mistakes
from store.mistakes import MOST, Mistake, pointer, unknown

MOST_ITEMS = 50_000  # of one field's lists and objects in all: 64 KiB of metadata have fewer


def check_bounds(body: Any, kind: type[BaseModel]) -> None:
    """Refuse a body of which a field holds too much, or that has too many fields.

    Validation takes a microsecond or more, and keeps hundreds of bytes, for each item that is
    wrong. Fields that become arrays (``Any``) have limits of their own.

    Raises
    ------
    ApiError
        422 with a pointer to each field.
    """
    if not isinstance(body, dict):  # is refused as a whole
        return
    if len(body) > len(kind.model_fields) + MOST:
        known = kind.model_fields
        strange = islice((str(name) for name in body if name not in known), MOST)
        raise of_mistakes([Mistake(pointer(n), unknown("field", n, known)) for n in strange])
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
