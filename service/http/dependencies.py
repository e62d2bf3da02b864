"""What endpoints ask for, as annotated dependencies.

They are asynchronous because FastAPI runs all others in threads, which takes longer than they do.
"""

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import Depends, Header, Path, Request
from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Query
from redis import Redis
from starlette.requests import HTTPConnection

from service.http.errors import ApiError, of_mistakes
from service.http.keyring import caller_of
from service.http.origins import refuse_foreign
from service.http.places import Turns
from service.http.preconditions import expected_by
from service.settings import Settings
from store.database import Store
from store.mistakes import MOST, Mistake, pointer, unknown

# Of a parameter that a route declares by this name, the dot and a key of the user's own follow.
FREE_QUERY = "metadata"
NUL = "expected text without the character NUL (%00)"


async def get_settings(request: Request) -> Settings:
    """Return the settings this app was made with."""
    settings: Settings = request.app.state.settings
    return settings


async def in_turn(request: HTTPConnection) -> AsyncIterator[None]:
    """Have a turn until the endpoint has returned.

    No key takes all threads of endpoints, or all connections to records and queues, from others.
    What a request waits for besides, its body or another turn, is asked for before.
    """
    turns: Turns = request.app.state.endpoints
    async with turns.turn(request):
        yield


InTurn = Annotated[None, Depends(in_turn, scope="function")]


async def get_store(request: HTTPConnection, _turn: InTurn) -> Store:
    """Return the store as the caller sees it: the project of the key, and nothing else.

    Where the request has ``If-Match``, what changes its record compares that.
    """
    store: Store = request.app.state.store
    identifier = request.scope["state"]["request_id"]
    author = caller_of(request).author._replace(request_id=identifier)
    return store.on_behalf_of(author, expected_by(request))


async def get_redis(request: Request, _turn: InTurn) -> Redis:
    """Return the connection to the queues."""
    redis: Redis = request.app.state.redis
    return redis


async def refuse_foreign_changes(connection: HTTPConnection) -> None:
    """Refuse changes by scripts of other web pages; browsers keep these from reading answers."""
    if connection.scope.get("method") not in ("GET", "HEAD"):
        refuse_foreign(connection)


def refuse_if_leaving(connection: HTTPConnection) -> None:
    """Refuse long requests once this process is shutting down.

    Raises
    ------
    ApiError
        503, with this reason.
    """
    if connection.app.state.leaving.is_set():
        raise ApiError(
            "draining",
            "This process of the service is stopping; another may take its place.",
            headers={"Retry-After": "2"},
        )


async def refuse_unknown_query(connection: HTTPConnection) -> None:
    """Refuse query parameters that the route does not know, before anything else is done.

    And the character NUL, which no text of the records has and PostgreSQL cannot be asked for.

    Raises
    ------
    ApiError
        422 that names them; 404 for an identifier with NUL.
    """
    if "\0" in connection.scope["path"]:
        raise ApiError("not_found", "No identifier has the character NUL (%00).")
    if not connection.scope["query_string"]:
        return
    parameters = connection.query_params.multi_items()
    if nul := [name for name, value in parameters if "\0" in name + value]:
        raise of_mistakes([Mistake(pointer(name), NUL) for name in nul[:MOST]])
    route = connection.scope["route"]
    known = [
        field.alias
        for field in get_flat_params(route.dependant)
        if isinstance(field.field_info, Query)
    ]
    free = (getattr(route, "openapi_extra", None) or {}).get("parameters", ())
    starts = tuple(f"{parameter['name']}." for parameter in free)
    others = [n for n in connection.query_params if n not in known and not n.startswith(starts)]
    if others:
        raise of_mistakes(
            [
                Mistake(pointer(name), unknown("query parameter", name, known))
                for name in others[:MOST]
            ]
        )


SettingsDep = Annotated[Settings, Depends(get_settings)]
StoreDep = Annotated[Store, Depends(get_store)]
RedisDep = Annotated[Redis, Depends(get_redis)]

IdempotencyHeader = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="Any string of your own. A request sent again with the same key within a day "
        "makes nothing new and gets the same answer.",
    ),
]
Identifier = Annotated[str, Path(max_length=200)]
