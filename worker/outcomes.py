"""What is recorded when an error ends an attempt at a fit, or a helper's work at a lift."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from obstore.exceptions import BaseError as ObjectStoreError
from sqlalchemy.exc import SQLAlchemyError

from store.errors import DamagedError, LeaseLostError, NotFoundError
from store.space import is_full

logger = logging.getLogger(__name__)

# The messages that users of the API get for errors that are not theirs; the log has the details.
OBJECTS_AWAY = "The objects (arrays and weights) could not be read or written for too long."
DISK_FULL = "There was no space left to store what was made."
FAULT = "This is a fault in Fewview; the worker's log has the details."


class Outcomes(NamedTuple):
    """The outcomes of some work. All do nothing, or raise, if another worker has taken it over.

    Attributes
    ----------
    fail
        End it as failed, with a code and a message: it can never succeed.
    try_again
        Give it back to be tried again, with the reason; after too many tries it fails.
    fault
        Record a fault of ours, with a message.
    unusable
        The code of input that ``models`` refuses (``ValueError``).
    """

    fail: Callable[[str, str], None]
    try_again: Callable[[str], None]
    fault: Callable[[str], None]
    unusable: str


@contextmanager
def recorded(work: str, outcomes: Outcomes) -> Iterator[None]:
    """Record what ends the work done inside; what the user cannot mend is raised again.

    ============================  ==========================================================
    the lease was lost            nothing: the work has ended, or is another's
    a record was deleted          failed, ``dataset_not_found`` or ``model_not_found``
    a stored object is damaged    failed, ``object_damaged``
    ``models`` refuses the input  failed, ``unusable``
    the records stay away         nothing can be: another goes on when the lease has run out
    the objects stay away         given back, to be tried again
    anything else                 ``fault``
    ============================  ==========================================================

    Parameters
    ----------
    work
        The identifier of the fit or the lift, for the log.
    """
    try:
        yield
    except LeaseLostError:
        logger.warning("%s is no longer ours: leaving it alone", work)
    except SQLAlchemyError:
        raise
    except BaseException as error:
        with suppress(LeaseLostError):
            if _record(error, outcomes):
                logger.warning("%s failed", work, exc_info=error)
                return
        raise


def _record(error: BaseException, outcomes: Outcomes) -> bool:
    """Record an error; return whether that is all there is to do, for it is no fault of ours."""
    match error:
        case NotFoundError():
            outcomes.fail(f"{error.kind}_not_found", str(error))
        case DamagedError():
            outcomes.fail("object_damaged", str(error))
        case ValueError():
            outcomes.fail(outcomes.unusable, str(error))
        case ObjectStoreError() | OSError():
            outcomes.try_again(DISK_FULL if is_full(error) else OBJECTS_AWAY)
            return False
        case _:
            outcomes.fault(FAULT)
            return False
    return True
