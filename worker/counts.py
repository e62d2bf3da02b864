"""What workers count, on whatever host they are: in the queue's server, where all can add to it.

Jobs run in processes of their own, which are gone before anybody could ask them.
"""

from contextlib import suppress
from typing import Literal, cast

from redis import Redis
from redis.exceptions import RedisError
from typing_extensions import TypeAliasType

Count = TypeAliasType(
    "Count", Literal["fit_retries", "fit_lease_losses", "lift_retries", "lift_lease_losses"]
)
_KEY = "fewview:counts"


def add(connection: Redis, name: Count) -> None:
    """Count one more, if the queue can be reached."""
    with suppress(RedisError):
        connection.hincrby(_KEY, name, 1)


def read(connection: Redis) -> dict[str, int]:
    """Return what was counted since the queue's server was set up."""
    found = cast(dict[bytes, bytes], connection.hgetall(_KEY))
    return {name.decode(): int(count) for name, count in found.items()}
