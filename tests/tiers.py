"""Which tests are of `make test-all` alone: docs/development.md has what they are, and why."""

from collections.abc import Iterable
from typing import Any

import pytest


def thorough_after(kept: int, cases: Iterable[Any]) -> list[Any]:
    """Return values of a test's parameter, of which `make test` takes the first few alone.

    Each is a value, or a tuple where the test has several parameters.
    """
    return [case if number < kept else _thorough(case) for number, case in enumerate(cases)]


def _thorough(case: Any) -> Any:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=pytest.mark.thorough)
