"""Checks that only advise: one that fails is logged, and finds nothing; nothing else depends on it.

Keypoints can be odd in more ways than anybody foresees. What an upload, a fit or a lift needs none
of must not end it.
"""

import logging
from collections.abc import Callable, Generator, Iterable
from typing import ParamSpec, TypeVar

from models.findings.finding import Finding

logger = logging.getLogger(__name__)

Given = ParamSpec("Given")
Found = TypeVar("Found")

# What arithmetic and our own mistakes raise. A time limit of the process is none of these.
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
    """Return what a check returns for its arguments; if it fails, log that and return `otherwise`.

    A check that is a generator has to be consumed by who calls this: see `noticed`.
    """
    try:
        return check(*args, **kwargs)
    except FAULTS:
        _log_failure(check.__qualname__)
        return otherwise


def attempt_steps(
    check: Generator[None, None, Found], otherwise: Found
) -> Generator[None, None, Found]:
    """Do as `attempt` does for a check that works in steps, and yields between them."""
    try:
        return (yield from check)
    except FAULTS:
        _log_failure(repr(check))
        return otherwise


def noticed(
    check: Callable[Given, Iterable[Finding]], /, *args: Given.args, **kwargs: Given.kwargs
) -> tuple[Finding, ...]:
    """Return the findings that a check yields for its arguments; if it fails, log that: none."""
    try:
        return tuple(check(*args, **kwargs))
    except FAULTS:
        _log_failure(check.__qualname__)
        return ()


def _log_failure(name: str) -> None:
    logger.exception("The check %s failed and is left out", name)
