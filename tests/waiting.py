"""To wait for what other processes do."""

import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

SHORTEST, LONGEST = 0.02, 0.1  # seconds from one look to the next


def wait_for(found: Callable[[], Found | None], what: str, seconds: float = 300) -> Found:
    """Return what `found` returns once that is true.

    The longer it takes, the more rarely it is looked for: each look takes time from the others.
    """
    begun = time.monotonic()
    while not (value := found()):
        waited = time.monotonic() - begun
        assert waited < seconds, f"waited {seconds} s for {what}"
        time.sleep(min(max(SHORTEST, waited / 10), LONGEST))
    return value
