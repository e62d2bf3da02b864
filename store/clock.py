"""The time of the records: one clock for all hosts that share them.

Leases, and all other times that one host writes and another compares, are in this time, so the
clocks of hosts may be wrong.
"""

import time
from typing import Any

from sqlalchemy import Float, select
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import Session
from sqlalchemy.sql.functions import FunctionElement

PROMPT_SECONDS = 1.0  # records that take longer are not as they should be


class now(FunctionElement[float]):  # noqa: N801 (used as SQL's functions are)
    """The seconds since the epoch (UTC) by the clock of the database, in any statement."""

    type = Float(53)
    inherit_cache = True


@compiles(now, "sqlite")
def _in_sqlite(_element: now, _compiler: Any, **_options: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(now)
def _in_sql(_element: now, _compiler: Any, **_options: Any) -> str:
    return "extract(epoch from clock_timestamp())::float8"


def read(session: Session) -> float:
    """Return what :class:`now` is."""
    return float(session.scalars(select(now())).one())


def read_promptly(session: Session) -> tuple[float, bool]:
    """Begin the session's transaction; return the time :class:`now`, and whether that was prompt.

    If not, holders of leases may have had to wait as long, and a lease that ran out does not mean
    that its holder died.
    """
    asked_at = time.monotonic()
    time_now = read(session)
    return time_now, time.monotonic() - asked_at < PROMPT_SECONDS
