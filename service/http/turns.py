"""Turns at work that takes much memory: a few have one at a time, others wait for a while."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.http.errors import ApiError

LONGEST_WAIT = 10.0  # seconds
RETRY_SECONDS = "5"


@asynccontextmanager
async def turn(places: asyncio.Semaphore) -> AsyncIterator[None]:
    """Wait for one of the places, first come, first served, and hold it.

    Raises
    ------
    ApiError
        503 if none became free within `LONGEST_WAIT`.
    """
    try:
        async with asyncio.timeout(LONGEST_WAIT):
            await places.acquire()
    except TimeoutError:
        raise ApiError(
            "overloaded",
            f"Those that came before have taken all places for {LONGEST_WAIT:g} s; try again in "
            f"{RETRY_SECONDS} s.",
            headers={"Retry-After": RETRY_SECONDS},
        ) from None
    try:
        yield
    finally:
        places.release()
