"""How many bytes files may unpack to: all of those that are read together have one budget.

Small files can hold much: zips, npz, and chunks of HDF5 are compressed. Whatever unpacks asks here
first, with the size that it is about to take, on disk or in memory.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from fewview.errors import FormatError


@dataclass
class _Budget:
    left: int
    bound: str


_budget: ContextVar[_Budget | None] = ContextVar("budget", default=None)


@contextmanager
def unpacking(most: int | None, bound: str = "") -> Iterator[None]:
    """Have everything that is read within unpack to so many bytes at most; None: to any number.

    Parameters
    ----------
    bound
        What sets this bound, in words that can follow "than", for the message.
    """
    before = _budget.set(None if most is None else _Budget(most, bound))
    try:
        yield
    finally:
        _budget.reset(before)


def take(size: int, place: object) -> None:
    """Take so many bytes of the budget, before they are unpacked.

    Raises
    ------
    FormatError
        If there are not so many left.
    """
    budget = _budget.get()
    if budget is None:
        return
    if size > budget.left:
        raise FormatError(
            f"unpacks to {size:,} bytes, and together the files then have more than "
            f"{budget.bound}; send fewer frames at a time, or have more allowed",
            place=place,
        )
    budget.left -= size
