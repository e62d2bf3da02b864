"""Moments that travel in queries and bodies: ISO 8601 alone."""

from datetime import datetime
from typing import Annotated, Any

from fewview.moments import EXPECTED, moment_in
from pydantic import BeforeValidator


def _read(value: Any) -> datetime:
    """Read what came; pydantic alone would take numbers for seconds since 1970."""
    if not isinstance(value, str):
        raise ValueError(f"{EXPECTED}{type(value).__name__}")
    return moment_in(value)


Moment = Annotated[datetime, BeforeValidator(_read, json_schema_input_type=datetime)]
