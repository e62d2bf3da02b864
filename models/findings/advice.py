"""Checks that only advise: if one raises an error, it is logged, and there is no finding.

Keypoints can be odd in ways that nobody foresees. A check that an upload, a fit or a lift does not
need must not end it.
"""

import logging
from collections.abc import Callable, Generator, Iterable
from typing import ParamSpec, TypeVar

from models.findings.finding import Finding

logger = logging.getLogger(__name__)

Given = ParamSpec("Given")
Found = TypeVar("Found")

# Errors of arithmetic and of our own mistakes. A time limit of the process is none of these.
FAULTS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    SystemError,
    TypeError,
    ValueError,
)


def attempt(
    check: Callable[Given, Found],
    otherwise: Found,
    /,
    *args: Given.args,
    **kwargs: Given.kwargs,
) -> Found:
    """Return the result of a check; if it raises an error, log this and return `otherwise`.

    A check that is a generator runs only when it is consumed: see `noticed`.
    """
    try:
        return check(*args, **kwargs)
    except FAULTS:
        _log_failure(check.__qualname__)
        return otherwise


def attempt_steps(
    check: Generator[None, None, Found], otherwise: Found
) -> Generator[None, None, Found]:
    """Do the same as `attempt` for a check that works in steps and yields between them."""
    try:
        return (yield from check)
    except FAULTS:
        _log_failure(repr(check))
        return otherwise


def noticed(
    check: Callable[Given, Iterable[Finding]], /, *args: Given.args, **kwargs: Given.kwargs
) -> tuple[Finding, ...]:
    """Return the findings that a check yields; if it raises an error, log this and return none."""
    try:
        return tuple(check(*args, **kwargs))
    except FAULTS:
        _log_failure(check.__qualname__)
        return ()


def _log_failure(name: str) -> None:
    logger.exception("The check %s failed and is left out", name)
