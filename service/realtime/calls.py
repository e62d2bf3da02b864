"""The calls that wait for the lifting engine, and which of them are lifted next.

Projects take turns, in each its keys, and of a key its large calls and its small ones: so nobody
waits longer because one key asks for much. Small calls of one way are lifted together, whichever
key of the project they are of.
"""

import asyncio
import time
from collections import deque
from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.settings.config import Refine
from models.settings.uncertainty import Uncertainty
from service.http.fair_queue import FairQueue
from service.realtime.warm_models import WarmModel

Float32 = NDArray[np.float32]


class Way(NamedTuple):
    """How frames are lifted. Only those of one way, and of one shape, can be lifted together."""

    model: WarmModel
    refine: Refine | None
    views: tuple[int, ...] | None
    shape: tuple[int, ...]  # (K, P, 2) of a frame
    weighted: bool  # whether there is a confidence
    follows: bool  # whether there are answers to frames before
    uncertainty: Uncertainty
    observed: bool = False  # whether the frames were observed, and need only be lifted


@dataclass(eq=False, slots=True)
class Call:
    """One client's frames, on their way through the engine."""

    way: Way
    key_id: str
    keypoints: Float32
    confidence: Float32 | None
    observed: ObservedFrames | None  # in place of these
    previous: LiftedFrames | None
    slice_size: int  # frames that are lifted in one go
    answer: "asyncio.Future[LiftedFrames]"
    frames: int
    missing: int  # frames without an answer yet
    asked_at: float = field(default_factory=time.perf_counter)
    taken: int = 0  # frames that a thread has taken
    parts: dict[int, LiftedFrames] = field(default_factory=dict)  # answers by their first frame

    @property
    def is_large(self) -> bool:
        """Whether it is cut."""
        return self.frames > self.slice_size

    @property
    def waits(self) -> bool:
        """Whether frames of it are to be lifted; none are once it was given up."""
        return self.taken < self.frames and not self.answer.done()


class Piece(NamedTuple):
    """What of a call is lifted in one go."""

    call: Call
    start: int
    stop: int


class WaitingCalls:
    """The calls that wait. To be used under a lock."""

    def __init__(self) -> None:
        # A small call may be taken with another of its way, before its own turn comes.
        self._calls: FairQueue[Call] = FairQueue()
        self._small: dict[Way, deque[Call]] = {}

    def __bool__(self) -> bool:
        """Whether there may be any."""
        return bool(self._calls)

    def put(self, call: Call) -> None:
        """Have a call wait."""
        if not call.is_large:
            self._small.setdefault(call.way, deque()).append(call)
        self._put(call)

    def _put(self, call: Call) -> None:
        lane = None if call.is_large else call.way
        self._calls.put((call.way.model.project, call.key_id, call.is_large, lane), call)

    def take(self) -> list[Piece]:
        """Return what is lifted next; nothing if no call waits."""
        while (call := self._calls.pop()) is not None:
            if call.is_large and call.waits:
                return [self._take_slice(call)]
            pieces = [] if call.is_large else self._take_with_others(call)
            if pieces:
                return pieces
        return []

    def _take_slice(self, call: Call) -> Piece:
        start, call.taken = call.taken, min(call.taken + call.slice_size, call.frames)
        if call.taken < call.frames:
            self._put(call)
        return Piece(call, start, call.taken)

    def _take_with_others(self, call: Call) -> list[Piece]:
        """Take a small call, unless it was taken or given up, and others of its way to a slice."""
        others = self._small.get(call.way, deque())
        pieces: list[Piece] = []
        left = call.slice_size
        for one in chain((call,), others) if call.waits else ():
            if one.waits and one.frames > left:
                break
            if one.waits:
                one.taken = one.frames
                pieces.append(Piece(one, 0, one.frames))
                left -= one.frames
        while others and not others[0].waits:
            others.popleft()
        if not others:
            self._small.pop(call.way, None)
        return pieces
