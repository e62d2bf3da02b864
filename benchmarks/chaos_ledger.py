"""The resources that the service has acknowledged, and so must keep, with their contents."""

import hashlib
import threading
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from safetensors.numpy import load

Kind = Literal["datasets", "fits", "models", "lifts"]
KINDS: tuple[Kind, ...] = ("datasets", "fits", "models", "lifts")


@dataclass
class Thing:
    """A dataset, a fit, a model or a lift.

    Attributes
    ----------
    recipe
        What it was made of: things of the same recipe hold the same, to the bit.
    identifier
        None until an answer has it: then it may exist or not.
    may_be_lost
        The queue that it was put on was wiped before anything was recorded.
    """

    kind: Kind
    name: str
    recipe: Hashable
    round: int
    identifier: str | None = None
    job_id: str | None = None
    may_be_lost: bool = False
    outcome: str = "succeeded"  # that is expected
    cancel: Literal["", "tried", "accepted"] = ""
    deletion: Literal["", "tried", "accepted"] = ""

    @property
    def path(self) -> str:
        """Its URL; only of a thing whose identifier is known."""
        assert self.identifier is not None
        return f"/{self.kind}/{self.identifier}"

    @property
    def is_kept(self) -> bool:
        """Whether the service has to have it."""
        return self.identifier is not None and not self.deletion


@dataclass
class Ledger:
    """All things of a run, and what those of each recipe held when they were first read."""

    things: list[Thing] = field(default_factory=list)
    first: dict[Hashable, str] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, thing: Thing) -> Thing:
        """Note a thing that is about to be asked for."""
        with self.lock:
            self.things.append(thing)
        return thing

    def kept(self, *kinds: Kind) -> list[Thing]:
        """Return what the service has to have of some kinds."""
        return [thing for thing in self.things if thing.kind in kinds and thing.is_kept]

    def differs(self, recipe: Hashable, digest: str) -> bool:
        """Return whether a thing holds something else than others of its recipe did."""
        with self.lock:
            return self.first.setdefault(recipe, digest) != digest


def digest_of(file: bytes) -> str:
    """Return the digest of the arrays in a safetensors file, without its header."""
    digest = hashlib.sha256()
    for name, array in sorted(load(file).items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
