"""Moments as texts: ISO 8601, as the service and the command line take them."""

import re
from datetime import UTC, datetime

# Of what ISO 8601 allows the extended format: 2026 or 20260131 would be read as seconds elsewhere.
EXTENDED = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}"
    r"(T[0-9]{2}:[0-9]{2}(:[0-9]{2}([.,][0-9]{1,9})?)?(Z|[+-][0-9]{2}(:?[0-9]{2})?)?)?"
)
EXPECTED = (
    "expected a date or a moment as ISO 8601 writes it, such as 2026-01-31 or "
    "2026-01-31T09:30:00Z (or +02:00, as %2B02:00 in a URL), got "
)


def moment_in(text: str) -> datetime:
    """Return the moment that a text names, in UTC unless it names another zone.

    A date is the moment that it begins.

    Raises
    ------
    ValueError
        It is not ISO 8601, with hyphens and colons, or there is no such day or time.
    """
    try:
        if EXTENDED.fullmatch(text) is None:
            raise ValueError
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(f"{EXPECTED}{text[:40]!r}") from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
