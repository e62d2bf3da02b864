"""Which tests are of `make test-all` alone: docs/development.md has what they are, and why."""

from collections.abc import Iterable
from typing import Any

import pytest


def thorough_after(kept: int, cases: Iterable[Any]) -> list[Any]:
    """Return values of a test's parameter, of which `make test` takes the first few alone.

    Each is a value, or a tuple of the values of several parameters; a tuple of one parameter is in
    another.
    """
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=() if number < kept else pytest.mark.thorough,
        )
        for number, case in enumerate(cases)
    ]
