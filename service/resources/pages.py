"""Pages of a list: newest first, continued by a cursor."""

from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from typing import Annotated, Generic, NamedTuple, Self, TypeVar

from fastapi import Query
from pydantic import BaseModel, ConfigDict

from service.wire.schemas import Name
from store import lookup
from store.database import Store
from store.lookup import Resource

Item = TypeVar("Item", bound=BaseModel)

_MOMENT = "ISO 8601, UTC unless it names another zone."


class Asked(NamedTuple):
    """What any list can be asked for. Times are in seconds since the epoch."""

    limit: int
    cursor: str | None
    name: str | None
    created_before: float | None
    created_after: float | None


def asked_of(prefix: str) -> Callable[..., Awaitable[Asked]]:
    """Return the dependency that reads the query of a list of what has this prefix."""

    async def read_query(
        limit: Annotated[int, Query(ge=1, le=200, description="Items on a page.")] = 50,
        cursor: Annotated[
            str | None,
            Query(
                pattern=f"^{prefix}_[0-9a-z]{{26}}$",
                description="`next_cursor` of the page before; leave out for the first.",
            ),
        ] = None,
        name: Annotated[Name | None, Query(description="Those of this very name.")] = None,
        created_before: Annotated[
            datetime | None, Query(description=f"Those made before this moment: {_MOMENT}")
        ] = None,
        created_after: Annotated[
            datetime | None, Query(description=f"Those made after this moment: {_MOMENT}")
        ] = None,
    ) -> Asked:
        return Asked(limit, cursor, name, _seconds(created_before), _seconds(created_after))

    return read_query


def _seconds(moment: datetime | None) -> float | None:
    if moment is None:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


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
        asked: Asked,
        **equal: str | None,
    ) -> Self:
        """Return the page that is asked for.

        Parameters
        ----------
        equal
            What columns must hold; None allows anything.
        """
        limit = asked.limit
        found = lookup.page(
            store,
            kind,
            limit=limit + 1,
            after=asked.cursor,
            created_before=asked.created_before,
            created_after=asked.created_after,
            name=asked.name,
            **equal,
        )
        return cls(
            items=[to_wire(record) for record in found[:limit]],
            next_cursor=found[limit - 1].id if len(found) > limit else None,
        )
