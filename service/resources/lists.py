"""What is stored as lists: filtered, continued by a cursor, deleted many at a time."""

from collections.abc import Awaitable, Callable
from typing import Annotated, Any, Generic, NamedTuple, Protocol, Self, TypeVar

from fastapi import APIRouter, Depends, Query, Request
from pydantic import BaseModel, ConfigDict, Field

from service.http.dependencies import FREE_QUERY, StoreDep
from service.http.errors import ApiError, invalid, problems
from service.wire.moments import Moment
from service.wire.schemas import Name
from store import lookup
from store.database import Store
from store.errors import ConflictError, NotFoundError
from store.labels import Tag, Text
from store.lookup import Filters, Resource


class _Identified(Protocol):
    @property
    def id(self) -> str: ...


Item = TypeVar("Item", bound=BaseModel)
Record = TypeVar("Record", bound=_Identified)
Columns = dict[str, str | None]

MOST_LISTED = 200
MOST_LABELS = 8  # tags, and keys of metadata, to filter by
MOST_WORDS = 8  # to search for
LONGEST_VALUE = 1000

LimitQuery = Annotated[int, Query(ge=1, le=MOST_LISTED, description="Items on a page.")]

_MOMENT = (
    "a date or a moment as ISO 8601 writes it, such as `2026-01-31` or `2026-01-31T09:30:00Z`; UTC "
    "unless it names another zone."
)

# Parameters of arbitrary names, in the form of OpenAPI: an object whose members are the parameters.
_METADATA_QUERY = {
    "name": FREE_QUERY,
    "in": "query",
    "style": "form",
    "explode": True,
    "description": f"`?{FREE_QUERY}.subject=M7`: those whose metadata has this value under this "
    f"key of its first level; numbers, `true` and `false` as in JSON. {MOST_LABELS} keys at most.",
    "schema": {
        "type": "object",
        "propertyNames": {"pattern": rf"^{FREE_QUERY}\."},
        "additionalProperties": {"type": "string", "maxLength": LONGEST_VALUE},
    },
}


class Asked(NamedTuple):
    """What of a list is asked for."""

    limit: int
    cursor: str | None
    filters: Filters


class Refusal(BaseModel):
    """What was not deleted, and why."""

    id: str
    code: str = Field(description="`conflict` or `not_found`.")
    detail: str


class Deleted(BaseModel):
    """What was deleted of those that were asked for, and what was not."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "deleted": ["ds_01m7yspdypmt22jq6npfg62xe5"],
                "refused": [
                    {
                        "id": "ds_01m7yspf3gqz6cz1v8e7ch3y7c",
                        "code": "conflict",
                        "detail": "Dataset 'ds_01m7yspf3gqz6cz1v8e7ch3y7c' is in use by "
                        "fit_01m7yspf3gqz6cz1v8e7ch3y7c: cancel these fits or wait for them to "
                        "end.",
                    }
                ],
                "found": 12,
                "next_cursor": "ds_01m7yspf3gqz6cz1v8e7ch3y7c",
            }
        }
    )

    deleted: list[str]
    refused: list[Refusal]
    found: int = Field(
        description="How many the query found before anything was deleted, on this page and on "
        "those after it: what `expected_count` must be."
    )
    next_cursor: str | None = Field(
        description="Where it goes on if there are more: send the same again with this `cursor`, "
        "and an `expected_count` that is less by what this page had."
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
        asked: Asked,
    ) -> Self:
        """Return the page that is asked for."""
        found = lookup.page(store, kind, asked.filters, limit=asked.limit + 1, after=asked.cursor)
        page, cursor = cut(found, asked.limit)
        return cls(items=[to_wire(record) for record in page], next_cursor=cursor)


def cut(found: list[Record], limit: int) -> tuple[list[Record], str | None]:
    """Return a page of what was found with one more than it has, and where the list goes on."""
    return found[:limit], found[limit - 1].id if len(found) > limit else None


async def no_columns() -> Columns:
    """Return no filters, for a list without filters of its own."""
    return {}


def add_list_routes(
    router: APIRouter,
    kind: type[Resource],
    page: type[Page[Any]],
    to_wire: Callable[[Resource], BaseModel],
    *,
    prefix: str,
    delete: Callable[[Store, str], None],
    columns: Callable[..., Awaitable[Columns]] = no_columns,
    codes: tuple[str, ...] = (),
) -> None:
    """Add the list of what is stored of a kind, and the deletion of what it shows.

    Parameters
    ----------
    page, to_wire
        The JSON form of a page, and the function that makes an item from a record.
    prefix
        Of the identifiers.
    delete
        Deletes one; raises ``ConflictError`` if it is in use.
    columns
        A dependency: required values of the record's columns, from the query.
    codes
        Of the problems that it may end in.
    """
    nouns = f"{kind.noun}s"
    asked_for = Depends(_asked_of(prefix, columns))
    extra = {"parameters": [_METADATA_QUERY]}

    @router.get(
        "",
        name=f"list_{nouns}",
        response_model=page,
        description=f"List {nouns}, newest first. Those that all filters allow are shown.",
        responses=problems(*codes),
        openapi_extra=extra,
    )
    def list_resources(store: StoreDep, asked: Annotated[Asked, asked_for]) -> Any:
        return page.read(store, kind, to_wire, asked)

    @router.delete(
        "",
        name=f"delete_{nouns}",
        response_model=Deleted,
        description=f"Delete the {nouns} that the list with the same query shows, for example "
        "those of some `id` or of a `tag`. Without any filter nothing is deleted. Those in use "
        "stay and are listed in `refused`. Send `dry_run=true` first, which deletes nothing and "
        "returns how many are `found`; then send this number as `expected_count`. If it no longer "
        "agrees, nothing is deleted (409).",
        responses=problems("conflict", *codes),
        openapi_extra=extra,
    )
    def delete_resources(
        store: StoreDep,
        asked: Annotated[Asked, asked_for],
        dry_run: Annotated[
            bool, Query(description="Delete nothing, and answer how many are `found`.")
        ] = False,
        expected_count: Annotated[
            int | None,
            Query(ge=0, description="How many the query finds; required unless `dry_run`."),
        ] = None,
    ) -> Any:
        if not asked.filters:
            raise invalid(
                "/id", f"expected a filter, such as id, name or tag: this would delete all {nouns}"
            )
        if expected_count is None and not dry_run:
            raise invalid(
                "/expected_count",
                f"expected how many {nouns} the query finds: send the same with dry_run=true, "
                "which deletes nothing, and then `found` of its answer as expected_count",
            )
        return _delete(store, kind, asked, delete, None if dry_run else expected_count)


def _asked_of(
    prefix: str, columns: Callable[..., Awaitable[Columns]]
) -> Callable[..., Awaitable[Asked]]:
    """Return the dependency that reads the query of a list."""

    async def read_query(
        request: Request,
        equal: Annotated[Columns, Depends(columns)],
        limit: LimitQuery = 50,
        cursor: Annotated[
            str | None,
            Query(
                pattern=f"^{prefix}_[0-9a-z]{{26}}$",
                description="`next_cursor` of the page before; leave out for the first.",
            ),
        ] = None,
        identifiers: Annotated[
            list[Annotated[str, Field(max_length=200)]],
            Query(alias="id", max_length=MOST_LISTED, description="These; may be repeated."),
        ] = [],  # noqa: B006 (never changed)
        name: Annotated[Name | None, Query(description="Those of this very name.")] = None,
        tags: Annotated[
            list[Tag],
            Query(
                alias="tag",
                max_length=MOST_LABELS,
                description="Those with this tag; may be repeated, for those with all of them.",
            ),
        ] = [],  # noqa: B006
        search: Annotated[
            Text | None,
            Query(
                min_length=1,
                max_length=200,
                description=f"Those with each of these words in their name or in a tag, as a part "
                f"of it, capital or small; {MOST_WORDS} words at most.",
            ),
        ] = None,
        created_before: Annotated[
            Moment | None, Query(description=f"Those made before this moment: {_MOMENT}")
        ] = None,
        created_after: Annotated[
            Moment | None, Query(description=f"Those made after this moment: {_MOMENT}")
        ] = None,
    ) -> Asked:
        filters = Filters(
            ids=identifiers,
            created_before=created_before.timestamp() if created_before else None,
            created_after=created_after.timestamp() if created_after else None,
            tags=tags,
            metadata=_metadata_in(request),
            equal={"name": name, **equal},
            words=_words_in(search),
        )
        return Asked(MOST_LISTED if identifiers else limit, cursor, filters)

    return read_query


def _words_in(search: str | None) -> list[str]:
    words = (search or "").split()
    if len(words) > MOST_WORDS:
        raise invalid("/search", f"expected {MOST_WORDS} words at most, got {len(words)}")
    return words


def _metadata_in(request: Request) -> dict[str, str]:
    start = f"{FREE_QUERY}."
    found = {
        name.removeprefix(start): value
        for name, value in request.query_params.items()
        if name.startswith(start)
    }
    if len(found) > MOST_LABELS:
        raise invalid(f"/{FREE_QUERY}", f"expected {MOST_LABELS} keys at most, got {len(found)}")
    for key, value in found.items():
        if len(value) > LONGEST_VALUE:
            raise invalid(f"/{start}{key[:100]}", f"expected {LONGEST_VALUE} characters at most")
    return found


def _delete(
    store: Store,
    kind: type[Resource],
    asked: Asked,
    delete: Callable[[Store, str], None],
    expected: int | None,
) -> Deleted:
    """Delete a page if as many are found as expected; nothing if that is None.

    Page and count are of one moment, and what is made after it is not on the page.
    """
    known, found = lookup.identifiers(
        store, kind, asked.filters, limit=asked.limit, after=asked.cursor
    )
    answer = Deleted(deleted=[], refused=[], found=found, next_cursor=None)
    if expected is None:
        return answer
    if found != expected:
        raise ApiError(
            "conflict",
            f"The query finds {found} {kind.noun}s, not {expected} as expected_count has it: "
            "nothing was deleted. Look at the list with the same query.",
        )
    for identifier in known:
        try:
            delete(store, identifier)
            answer.deleted.append(identifier)
        except ConflictError as error:
            answer.refused.append(Refusal(id=identifier, code="conflict", detail=str(error)))
        except NotFoundError:  # somebody else was faster
            answer.deleted.append(identifier)
    answer.refused += [
        Refusal(id=wanted, code="not_found", detail=f"The query finds no {kind.noun} of this id.")
        for wanted in dict.fromkeys(asked.filters.ids)
        if wanted not in known
    ]
    answer.next_cursor = known[-1] if found > len(known) else None
    return answer
