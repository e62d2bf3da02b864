"""How much a key may ask for in a second, over all processes of the API together."""

import logging
import math
import time
from typing import Any

from limits import RateLimitItemPerSecond
from limits.aio.storage import MemoryStorage, RedisStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter
from redis.asyncio import ConnectionPool
from redis.exceptions import RedisError

from service.http.errors import ApiError
from service.http.keyring import Caller

logger = logging.getLogger(__name__)

PATIENCE_SECONDS = 0.25  # for Redis
PAUSE_SECONDS = 5.0  # without Redis, after it was away


class Rates:
    """Counts requests and lifted frames of keys that have quotas.

    They are counted in Redis. While that is away, each process counts its own.
    """

    def __init__(self, redis_url: str) -> None:
        self._connections = ConnectionPool.from_url(
            redis_url,
            socket_timeout=PATIENCE_SECONDS,
            socket_connect_timeout=PATIENCE_SECONDS,
        )
        options: dict[str, Any] = {"connection_pool": self._connections}
        shared = RedisStorage(
            "async+redis://",  # which the connections know better
            implementation="redispy",
            key_prefix="fewview:rates",
            **options,
        )
        self._shared = SlidingWindowCounterRateLimiter(shared)
        self._own = SlidingWindowCounterRateLimiter(MemoryStorage())
        self._shared_again_at = 0.0

    async def close(self) -> None:
        """Close the connections to Redis."""
        await self._connections.aclose()

    async def take_request(self, caller: Caller) -> None:
        """Count a request; raise ``ApiError`` 429 if the caller has sent too many."""
        await self._take(caller, "requests", caller.author.quotas.requests_per_second, 1)

    async def take_frames(self, caller: Caller, count: int) -> None:
        """Count frames to lift; raise ``ApiError`` 429 if they are too many."""
        await self._take(caller, "frames", caller.author.quotas.lifted_frames_per_second, count)

    async def _take(self, caller: Caller, what: str, most: int | None, count: int) -> None:
        if most is None:
            return
        item, key = RateLimitItemPerSecond(most), (what, caller.author.key_id)
        allowed, reset, left = await self._hit(item, key, count)
        if not allowed:
            wait = max(1, math.ceil(reset - time.time()))
            beyond = f" Send {most} at most in a request." if count > most else ""
            raise ApiError(
                "quota_exceeded",
                f"This key may ask for {most} {what} a second.{beyond}",
                headers={
                    "Retry-After": str(wait),
                    "RateLimit-Policy": f'"{what}";q={most};w=1',
                    "RateLimit": f'"{what}";r={left};t={wait}',
                },
            )

    async def _hit(
        self, item: RateLimitItemPerSecond, key: tuple[str, str], count: int
    ) -> tuple[bool, float, int]:
        """Return whether so many are allowed now, when all are again, and how many are left."""
        if time.monotonic() >= self._shared_again_at:
            try:
                return await _hit(self._shared, item, key, count)
            except (RedisError, OSError) as error:
                logger.warning("Rates are counted by each process: %s", error)
                self._shared_again_at = time.monotonic() + PAUSE_SECONDS
        return await _hit(self._own, item, key, count)


async def _hit(
    limiter: SlidingWindowCounterRateLimiter,
    item: RateLimitItemPerSecond,
    key: tuple[str, str],
    count: int,
) -> tuple[bool, float, int]:
    if await limiter.hit(item, *key, cost=count):
        return True, 0.0, 0
    found = await limiter.get_window_stats(item, *key)
    return False, found.reset_time, found.remaining
