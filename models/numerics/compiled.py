"""Compiled functions: inner loops, turned into machine code by Numba when first used.

A compiled function releases the interpreter lock, so threads run it side by side, and costs one
call however much it does. Machine code is kept between runs, in this folder's `__pycache__` or, if
that cannot be written, in the user's cache; where neither can, every process compiles anew, which
takes some seconds. `NUMBA_CACHE_DIR` chooses another place.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

# Arithmetic is exact to the letter: a function may be inlined here and shared there, and whichever
# copy a process happens to run, equal fits must be equal bytes. Where sums may be reordered, which
# vectorises them, only one copy may exist. NaN and infinity keep their meaning.
REORDERED = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of numbers, arrays and named tuples of these on its first call."""
    result: Callable[..., Any]
    try:
        result = numba.njit(nogil=True, error_model="numpy", cache=True)(function)
    except RuntimeError:  # there is no place to keep it
        result = numba.njit(nogil=True, error_model="numpy")(function)
    return cast("Callable[P, R]", result)


def inner(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that only compiled functions call, together with each of these.

    It takes half of the time, as Python needs no way to call it.
    """
    result = numba.njit(  # type: ignore[call-overload]
        nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(function)
    return cast("Callable[P, R]", result)


def reordered(function: Callable[P, R]) -> Callable[P, R]:
    """Compile like `inner` a function that a single compiled one calls, its sums in any order."""
    result = numba.njit(  # type: ignore[call-overload]
        nogil=True,
        fastmath=REORDERED,
        error_model="numpy",
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
    )(function)
    return cast("Callable[P, R]", result)


def _choose_cache() -> None:
    """Keep the code of every version of these sources apart.

    Numba notices changes of a function's own file only, not of files whose functions it calls.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    folder = Path(__file__).parents[1]  # `models`: code of one room calls that of others
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        digest.update(source.read_bytes())
    version = f"compiled-{digest.hexdigest()[:16]}"
    user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111 (never raises)
    for parent in (folder / "__pycache__", user / "fewview"):
        try:
            (parent / version).mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(parent / version, os.W_OK):
            numba.config.CACHE_DIR = str(parent / version)  # type: ignore[attr-defined]
            return


_choose_cache()
