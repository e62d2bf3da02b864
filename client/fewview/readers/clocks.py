"""Times as tables have them: seconds, parts of them, clocks of the day, dates."""

import re
from datetime import UTC, datetime

import numpy as np

from fewview.capture import Float64
from fewview.readers.headers import unit_of
from fewview.readers.separated import Words

_CLOCK = re.compile(r"\A(?:(\d+):)?(\d{1,2}):(\d{1,2}(?:[.,]\d*)?)")


def seconds_in(words: Words, column: str) -> Float64 | None:
    """Return the seconds (N,) in a column of times, NaN in empty cells; None if it has others.

    Parameters
    ----------
    column
        Its name, whose end ``ms``, ``us`` or ``ns`` gives the unit. Times of day (12:00:01.5) and
        dates (ISO 8601) are read too.
    """
    unit = unit_of(column)
    try:
        known = np.array([_seconds(word, unit) for word in words.words])
    except ValueError:
        return None
    return np.asarray(known[words.codes])


def _seconds(word: str, unit: float) -> float:
    if not word:
        return np.nan
    if found := _CLOCK.fullmatch(word):
        hours, minutes, seconds = found.groups()
        return int(hours or 0) * 3600 + int(minutes) * 60 + float(seconds.replace(",", "."))
    if "-" in word[1:] and ":" in word:
        moment = datetime.fromisoformat(word)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    return float(word.replace(",", ".")) * unit
