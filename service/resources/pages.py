"""Pages of a list: newest first, continued by a cursor."""

from collections.abc import Callable
from typing import Annotated, Any, Generic, Self, TypeVar

from fastapi import Query
from pydantic import BaseModel, ConfigDict

from store import lookup
from store.database import Store
from store.lookup import Resource

Item = TypeVar("Item", bound=BaseModel)

Limit = Annotated[int, Query(ge=1, le=200, description="Items on a page.")]


def cursor_of(prefix: str) -> Any:
    """Return what a page's cursor may be: the identifier of a resource with this prefix."""
    return Query(
        pattern=f"^{prefix}_[0-9a-z]{{26}}$",
        description="`next_cursor` of the page before; leave out for the first.",
    )


def page_of(item: type[BaseModel]) -> ConfigDict:
    """Return the configuration of a page's model: an example made of one item's."""
    extra = item.model_config.get("json_schema_extra")
    assert isinstance(extra, dict)  # noqa: S101
    return ConfigDict(
        json_schema_extra={"example": {"items": [extra["example"]], "next_cursor": None}}
    )


class Page(BaseModel, Generic[Item]):
    """Items of a list, and where it goes on."""

    items: list[Item]
    next_cursor: str | None

    @classmethod
    def read(
        cls,
        store: Store,
        kind: type[Resource],
        to_wire: Callable[[Resource], Item],
        *,
        limit: int,
        cursor: str | None,
        **equal: str | None,
    ) -> Self:
        """Return the page of ``limit`` records that comes after ``cursor``.

        Parameters
        ----------
        equal
            What columns must hold; None allows anything.
        """
        found = lookup.page(store, kind, limit=limit + 1, after=cursor, **equal)
        return cls(
            items=[to_wire(record) for record in found[:limit]],
            next_cursor=found[limit - 1].id if len(found) > limit else None,
        )
