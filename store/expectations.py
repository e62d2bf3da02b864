"""What whoever changes a record expects it to be: compared in the transaction that changes it."""

from collections.abc import Callable
from typing import Any, NamedTuple

from sqlalchemy.orm import Session


class Expected(NamedTuple):
    """That a record is still what it was.

    Attributes
    ----------
    kind, identifier
        Which record; of a model its alias will do.
    check
        Raises if the record, which is locked, is another than expected; it gets None where there
        is none.
    """

    kind: type[Any]
    identifier: str
    check: Callable[[Any], None]


def compare(session: Session, kind: type[Any], identifier: str, record: Any) -> None:
    """Raise what the check of a session's expectation does, if that is of this record."""
    expected: Expected | None = session.info["expected"]
    if expected is not None and (expected.kind, expected.identifier) == (kind, identifier):
        expected.check(record)
