"""A full disk or account, in the errors of all that writes to one."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from obstore.exceptions import BaseError as ObjectStoreError

from store.database import Store
from store.disposal import discard
from store.errors import QuotaError

FULL = (errno.ENOSPC, errno.EDQUOT)
POSTGRESQL_FULL = "53100"  # disk_full
# Of folders and of S3; errors of objects have nothing but a text.
OBJECTS_FULL = (*(f"(os error {number})" for number in FULL), "InsufficientStorage", "StorageFull")


def is_full(error: BaseException | None) -> bool:
    """Whether an error of records, objects or files means that a disk, or a quota, is full."""
    if error is None:
        return False
    found = getattr(error, "orig", None) or error  # of the database's driver
    return (
        (isinstance(found, OSError) and found.errno in FULL)
        or getattr(found, "sqlite_errorname", None) == "SQLITE_FULL"
        or getattr(found, "sqlstate", None) == POSTGRESQL_FULL
        or (isinstance(found, ObjectStoreError) and any(w in str(found) for w in OBJECTS_FULL))
        or is_full(error.__cause__)
    )


@contextmanager
def discarded_if_full(store: Store, key: str) -> Iterator[None]:
    """Delete an object if there is no space for its record, or its author may not keep it.

    Only then: after other errors the record may have been written.
    """
    try:
        yield
    except Exception as error:
        if is_full(error) or isinstance(error, QuotaError):
            discard(store, key)
        raise
