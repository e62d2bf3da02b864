"""Waiting out outages of records and objects without losing the work in hand."""

import logging
import random
import time
from collections.abc import Callable
from typing import TypeVar

from obstore.exceptions import BaseError as ObjectStoreError
from sqlalchemy.exc import InterfaceError, OperationalError, TimeoutError

from store.errors import in_words
from store.space import is_full

logger = logging.getLogger(__name__)

T = TypeVar("T")
OUTAGE_SECONDS = 900.0
LONGEST_PAUSE_SECONDS = 5.0
OUTAGES = (OperationalError, InterfaceError, TimeoutError, ObjectStoreError, OSError)


def is_outage(error: BaseException) -> bool:
    """Return whether an error means that records or objects cannot be reached.

    That something does not exist (``FileNotFoundError``) is an answer, and no outage.
    """
    return isinstance(error, OUTAGES) and not isinstance(error, FileNotFoundError)


def patiently(
    work: Callable[[], T], *, hurry: Callable[[], bool], seconds: float = OUTAGE_SECONDS
) -> T:
    """Do work that may be done again, until records and objects let it be done.

    Parameters
    ----------
    hurry
        Whether this process is to end: then an outage is not waited out any more.
    seconds
        The longest outage that is waited out; then its error is raised, as all others are at once.
    """
    deadline, pause = time.monotonic() + seconds, 0.1
    while True:
        try:
            return work()
        except OUTAGES as error:
            if not is_outage(error) or hurry() or time.monotonic() > deadline:
                raise
            what = "There is no space left" if is_full(error) else "Records or objects are away"
            logger.warning("%s, trying again: %s", what, in_words(error))
        time.sleep(pause * random.uniform(0.5, 1))  # noqa: S311 (so that not all come back at once)
        pause = min(2 * pause, LONGEST_PAUSE_SECONDS)
