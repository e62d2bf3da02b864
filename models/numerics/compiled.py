"""Compiled functions: inner loops, turned into machine code by Numba when first used.

A compiled function releases the interpreter lock, so threads run it side by side, and costs one
call however much it does. Machine code is kept between runs, in this package's `__pycache__` or, if
that cannot be written, in the user's cache. A folder that already holds the code of these sources
is read even where it cannot be written, as in a container image. Where there is no folder at all,
every process compiles anew, which takes minutes. `NUMBA_CACHE_DIR` chooses another folder.
"""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator

P = ParamSpec("P")
R = TypeVar("R")

# Arithmetic is exact to the letter: a function may be inlined here and shared there, and whichever
# copy a process happens to run, equal fits must be equal bytes. Where sums may be reordered, which
# vectorises them, only one copy may exist. NaN and infinity keep their meaning.
REORDERED = {"contract", "reassoc", "nsz", "arcp"}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of numbers, arrays and named tuples of these on its first call."""
    result: Any = numba.njit(nogil=True, error_model="numpy")(function)
    if numba.config.CACHE_DIR:  # type: ignore[attr-defined]
        result._cache = _Cache(function)  # type: ignore[no-untyped-call]
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


class _Locator(UserProvidedCacheLocator):
    """A folder below `numba.config.CACHE_DIR`, which need not be writable."""

    def ensure_cache_path(self) -> None:
        with suppress(OSError):
            super().ensure_cache_path()  # type: ignore[no-untyped-call]


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 - as Numba has it


class _Cache(FunctionCache):
    """The machine code of one function; Numba's own refuses folders that it cannot write."""

    _impl_class = _Implementation

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with suppress(OSError):
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


def digest_of_sources(folder: Path) -> str:
    """Return a digest of the names and contents of all Python files below a folder."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        for part in (source.relative_to(folder).as_posix().encode(), source.read_bytes()):
            digest.update(len(part).to_bytes(8, "big"))
            digest.update(part)
    return digest.hexdigest()


def _choose_cache() -> None:
    """Keep the machine code of every version of these sources apart.

    Numba notices changes of a function's own file only, not of the files whose functions it calls.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    folder = Path(__file__).parents[1]  # `models`: code of one room calls that of others
    version = f"compiled-{digest_of_sources(folder)[:16]}"
    user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111 (never raises)
    for parent in (folder / "__pycache__", user / "fewview"):
        cache = parent / version
        with suppress(OSError):
            cache.mkdir(parents=True, exist_ok=True)
        if os.access(cache, os.W_OK) or _is_filled(cache):
            numba.config.CACHE_DIR = str(cache)  # type: ignore[attr-defined]
            return


def _is_filled(cache: Path) -> bool:
    try:
        return any(cache.glob("*/*.nbi"))  # the indices of Numba's caches
    except OSError:
        return False


_choose_cache()
