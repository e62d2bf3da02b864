"""Switching mechanisms of fits and lifts off, by replacing functions that other code calls."""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from inspect import isgeneratorfunction
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from models.numerics.steps import Steps, finished

ROOT = Path(__file__).parents[1]
LIFT, GEOMETRY, NETWORK = "lift", "geometry", "network"


class Part(NamedTuple):
    """A function as one place calls it, and what is called for it."""

    module: str
    name: str  # of the function, or "Class.function"
    instead: Any


class Mechanism(NamedTuple):
    """Something that can be left out."""

    name: str
    # `LIFT`: the same fit lifts without it. `GEOMETRY`, `NETWORK`: a fit is made without it, and
    # only the latter changes what the network learns.
    stage: str
    files: tuple[str, ...]  # of its own, under models/
    parts: tuple[Part, ...] = ()
    settings: tuple[tuple[str, Any], ...] = ()  # of the configuration

    @property
    def lines(self) -> int:
        """How many lines its own files have."""
        paths = (ROOT / "models" / file for file in self.files)
        return sum(len(path.read_text().splitlines()) for path in paths)

    @contextmanager
    def off(self) -> Iterator[None]:
        """Leave the mechanism out."""
        with _replaced(self.parts):
            yield


@contextmanager
def observed(mechanisms: Sequence[Mechanism]) -> Iterator[set[str]]:
    """Collect the names of mechanisms whose functions answer otherwise than what replaces them.

    Without the others a fit is the same. Those of lifts and of settings are always collected.
    """
    acting = {one.name for one in mechanisms if one.stage == LIFT or one.settings}
    parts = []
    for mechanism in mechanisms:
        if mechanism.name not in acting:
            for part in mechanism.parts:
                known = getattr(*place_of(part))
                watch = _watched_steps if isgeneratorfunction(known) else _watched
                note = functools.partial(acting.add, mechanism.name)
                parts.append(part._replace(instead=watch(known, part.instead, note)))
    with _replaced(parts):
        yield acting


def _watched(
    known: Callable[..., Any], instead: Callable[..., Any], note: Callable[[], None]
) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        result = known(*args, **kwargs)
        if not _same(result, instead(*args, **kwargs)):
            note()
        return result

    return call


def _watched_steps(
    known: Callable[..., Steps[Any]], instead: Callable[..., Steps[Any]], note: Callable[[], None]
) -> Callable[..., Steps[Any]]:
    def call(*args: Any, **kwargs: Any) -> Steps[Any]:
        result = yield from known(*args, **kwargs)
        if not _same(result, finished(instead(*args, **kwargs))):
            note()
        return result

    return call


def _same(one: Any, other: Any) -> bool:
    if one is other:
        return True
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    plain = (int, float, str, set)
    return isinstance(one, plain) and isinstance(other, plain) and one == other


@contextmanager
def _replaced(parts: Sequence[Part]) -> Iterator[None]:
    before: list[tuple[Any, str, Any]] = []
    try:
        for part in parts:
            owner, name = place_of(part)
            before.append((owner, name, owner.__dict__[name]))
            setattr(owner, name, part.instead)
        yield
    finally:
        for owner, name, known in reversed(before):
            setattr(owner, name, known)


def place_of(part: Part) -> tuple[ModuleType | type, str]:
    """Return what holds the function that a part replaces, and its name there."""
    module, (*classes, name) = import_module(part.module), part.name.split(".")
    owner: Any = module
    for each in classes:
        owner = getattr(owner, each)
    return owner, name
