"""Compiled functions: inner loops, turned into machine code by Numba when first used.

A compiled function releases the interpreter lock, so threads run it in parallel. Machine code is
kept between runs, in this package's `__pycache__` or, if that cannot be written, in the user's
cache. It is valid as long as the syntax of the function's module, and of all modules that this one
imports, stays the same (`models.numerics.source_digests`). A folder that already has machine code
is read even if it cannot be written, as in a container image. Without any folder, every process
compiles again, which takes minutes. `NUMBA_CACHE_DIR` chooses another folder.

If several processes need the same function at the same time, one compiles it and the others wait.
"""

import fcntl
import glob
import hashlib
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.registry import cpu_target

from models.numerics.source_digests import SourceDigests

P = ParamSpec("P")
R = TypeVar("R")

# Arithmetic keeps the order of operations. A function may be inlined in one place and shared in
# another, and equal fits must be equal bytes whichever copy runs. Functions whose sums may be
# reordered, which vectorises them, have only one copy. NaN and infinity keep their meaning.
REORDERED = {"contract", "reassoc", "nsz", "arcp"}
PATIENCE_SECONDS = 120.0  # for another process that compiles the same function
KEPT_VERSIONS = 4  # of the machine code of a function, for switching between versions

_functions: list[Any] = []


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of numbers, arrays and named tuples of these on its first call."""
    result: Any = numba.njit(nogil=True, error_model="numpy")(function)
    if _FOLDER is not None:
        result._cache = _Cache(function)  # type: ignore[no-untyped-call]
    _functions.append(result)
    return cast("Callable[P, R]", result)


def signatures() -> frozenset[str]:
    """Return the functions that are compiled in this process, with the types of their arguments."""
    return frozenset(
        f"{function.py_func.__module__}.{function.py_func.__qualname__}{arguments}"
        for function in _functions
        for arguments in function.signatures
    )


def load_machine_code() -> None:
    """Load the machine code of earlier processes; forks of this process share it."""
    for function in _functions:
        for arguments in getattr(function._cache, "kept", tuple)():
            function.compile(arguments)


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
    """The folder `numba.config.CACHE_DIR`, which need not be writable.

    Numba's own locator names files by a function's line, and rejects them when the source file was
    written again or moved.
    """

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)  # type: ignore[no-untyped-call]
        self._cache_path = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        self._digest = _DIGESTS.of(Path(file))[:16]

    def ensure_cache_path(self) -> None:
        with suppress(OSError):
            super().ensure_cache_path()  # type: ignore[no-untyped-call]

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return self._digest


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 - as Numba has it


class _Cache(FunctionCache):
    """The machine code of one function; Numba's own refuses folders that it cannot write."""

    _impl_class = _Implementation

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return sig, codegen.magic_tuple()  # the file's name holds the digest of the code

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return machine code; None if this process must compile it, and then call `save`."""
        found = self._read(sig, target_context)
        if found is None and _LOCKS is not None and _LOCKS.take(self._place):
            found = self._read(sig, target_context)  # which another process may just have written
            if found is not None:
                _LOCKS.release(self._place)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
            self._forget_older()
        if _LOCKS is not None:
            _LOCKS.release(self._place)
        _DIGESTS.save()

    def kept(self) -> list[Any]:
        """Return the types of arguments for which there is machine code for this processor."""
        with suppress(OSError):
            known = self._cache_file._load_index()  # type: ignore[no-untyped-call]
            here = self._index_key(None, cpu_target.target_context.codegen())[1]
            return [arguments for arguments, processor in known if processor == here]
        return []

    @property
    def _place(self) -> str:
        return f"{self.cache_path}/{self._impl.filename_base}"

    def _read(self, sig: Any, target_context: Any) -> Any:
        with suppress(OSError):
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return None

    def _forget_older(self) -> None:
        """Delete the machine code of versions of the function that came before the last few."""
        name, _, ending = self._impl.filename_base.rpartition("-")
        version = ending.partition(".")[2]
        indices = Path(self.cache_path).glob(f"{glob.escape(name)}-*.{version}.nbi")
        newest_first = sorted(indices, key=lambda path: path.stat().st_mtime, reverse=True)
        for index in newest_first[KEPT_VERSIONS:]:
            for path in index.parent.glob(f"{glob.escape(index.stem)}.*.nbc"):
                path.unlink(missing_ok=True)
            index.unlink(missing_ok=True)


class _Locks:
    """Locks that processes hold on functions, as ranges of one file's bytes (fcntl(2)).

    They end with the process that holds them, however it ends. If the file cannot be opened, no
    process is kept from compiling.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._opened: int | None = None  # once: closing it would give back every lock

    def take(self, name: str) -> bool:
        """Take a lock as soon as no other process holds it; return False if that takes too long."""
        try:
            if self._opened is None:
                self._opened = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError:
            return False
        deadline = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < deadline:
            with suppress(OSError):
                fcntl.lockf(self._opened, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._byte(name))
                return True
            time.sleep(0.02)
        return False

    def release(self, name: str) -> None:
        """Give a lock back; nothing happens if this process does not hold it."""
        if self._opened is not None:
            with suppress(OSError):
                fcntl.lockf(self._opened, fcntl.LOCK_UN, 1, self._byte(name))

    @staticmethod
    def _byte(name: str) -> int:
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:5], "big")


def _choose_folder() -> Path | None:
    """Return where machine code is kept; None if there is no such folder."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return Path(os.environ["NUMBA_CACHE_DIR"])
    user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111 (never raises)
    for parent in (Path(__file__).parents[1] / "__pycache__", user / "fewview"):
        folder = parent / "compiled"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK) or _is_filled(folder):
            return folder
    return None


def _is_filled(folder: Path) -> bool:
    try:
        return any(folder.glob("*.nbi"))  # the indices of Numba's caches
    except OSError:
        return False


_FOLDER = _choose_folder()
_LOCKS = None if _FOLDER is None else _Locks(_FOLDER / "locks")
_DIGESTS = SourceDigests(None if _FOLDER is None else _FOLDER / "syntax.json")
if _FOLDER is not None:
    numba.config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]
