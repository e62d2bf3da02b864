"""What endpoints ask for, as annotated dependencies.

They are asynchronous because FastAPI runs all others in threads, which takes longer than they do.
"""

from typing import Annotated

from fastapi import Depends, Header, Path, Request
from rq import Queue

from service.settings import Settings
from store.database import Store


async def get_settings(request: Request) -> Settings:
    """Return the settings this app was made with."""
    settings: Settings = request.app.state.settings
    return settings


async def get_store(request: Request) -> Store:
    """Return the open store."""
    store: Store = request.app.state.store
    return store


async def get_queue(request: Request) -> Queue:
    """Return the queue that carries fits."""
    queue: Queue = request.app.state.queue
    return queue


SettingsDep = Annotated[Settings, Depends(get_settings)]
StoreDep = Annotated[Store, Depends(get_store)]
QueueDep = Annotated[Queue, Depends(get_queue)]

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
