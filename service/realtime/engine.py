"""The lifting engine: a few threads that lift the frames of many clients.

Calls of the same model with the same options that arrive while the threads are busy are lifted
together. A call that comes alone starts at once, and no call waits for others to join it. A call
with more frames than a slice is cut, and its slices take turns with all other calls, so that no
call waits for more than a slice or two of the others.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.lifting.lift import LiftedFrames, join
from models.lifting.observing import ObservedFrames, join_observed
from models.numerics.threads import use_threads
from models.settings.config import Refine
from service.realtime.warm_models import WarmModel, WarmModels
from store.database import Store
from store.errors import NotFoundError

logger = logging.getLogger(__name__)

SLICE_FRAMES = 256  # lifted by the network alone, which takes some 20 us a frame
REFINED_FRAMES = 32  # refined, which takes some 1 ms a frame
CLOSE_SECONDS = 2.0

Float32 = NDArray[np.float32]


class Way(NamedTuple):
    """How frames are lifted. Only those of one way, and of one shape, can be lifted together."""

    model: WarmModel
    refine: Refine | None
    views: tuple[int, ...] | None
    shape: tuple[int, ...]  # (K, P, 2) of a frame
    weighted: bool  # whether there is a confidence
    follows: bool  # whether there are answers to frames before
    observed: bool = False  # whether the frames were observed, and need only be lifted


def _ignore(_figure: float) -> None:
    """Ignore a figure."""


@dataclass(eq=False, slots=True)
class _Call:
    """One client's frames, on their way through the engine."""

    way: Way
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


class _Piece(NamedTuple):
    """What of a call is lifted in one go."""

    call: _Call
    start: int
    stop: int


_Outcome = LiftedFrames | Exception


class Engine:
    """Lifts with warm models in threads of its own."""

    def __init__(
        self,
        store: Store,
        *,
        max_bytes: int,
        threads: int = 1,
        on_batch: Callable[[int], object] = _ignore,
        on_answer: Callable[[float], object] = _ignore,
    ) -> None:
        """Keep up to ``max_bytes`` of weights warm, and lift with that many threads.

        Parameters
        ----------
        on_batch, on_answer
            Called with the frames of each batch, in any of the threads, and with the seconds that
            each answer took, in the event loop.
        """
        self._on_batch, self._on_answer = on_batch, on_answer
        self.models = WarmModels(store, max_bytes=max_bytes)
        # Calls of up to a slice, by their ways, which take turns. Larger ones take turns singly.
        self._small: dict[Way, deque[_Call]] = {}
        self._large: deque[_Call] = deque()
        self._large_next = False
        self._closed = False
        self._changed = threading.Condition()
        use_threads(1)  # batches are spread over the cores, not the parts of one
        self._threads = [
            threading.Thread(target=self._work, name=f"lift-{n}", daemon=True)
            for n in range(threads)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop the threads; they finish what they have in hand, if it does not take long."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(CLOSE_SECONDS)
        self.models.close()

    def lift(
        self,
        model: WarmModel,
        keypoints: Float32,
        *,
        confidence: Float32 | None = None,
        refine: Refine | None = None,
        views: Sequence[int] | None = None,
        previous: LiftedFrames | None = None,
    ) -> "asyncio.Future[LiftedFrames]":
        """Lift frames (N, K, P, 2) as ``FittedPrior.lift`` does, together with those of others.

        Called in the event loop. A future that is cancelled gives its place in the queue up.
        Nothing is asked of records, objects or queue.

        Raises
        ------
        NotFoundError
            From the future: if the model was deleted.
        """
        way = Way(
            model,
            refine,
            None if views is None else tuple(views),
            keypoints.shape[1:],
            confidence is not None,
            previous is not None,
        )
        return self._ask(way, keypoints, confidence, None, previous, len(keypoints))

    def lift_observed(
        self,
        model: WarmModel,
        observed: ObservedFrames,
        *,
        refine: Refine | None = None,
        previous: LiftedFrames | None = None,
    ) -> "asyncio.Future[LiftedFrames]":
        """Lift frames that ``model`` observed as ``FittedPrior.lift_observed`` does; see `lift`."""
        keypoints, judged = observed.observations.keypoints, observed.outlier_probability
        way = Way(
            model,
            refine,
            observed.views,
            keypoints.shape[1:],
            judged is not None,
            previous is not None,
            observed=True,
        )
        return self._ask(way, keypoints, None, observed, previous, len(keypoints))

    def _ask(
        self,
        way: Way,
        keypoints: Float32,
        confidence: Float32 | None,
        observed: ObservedFrames | None,
        previous: LiftedFrames | None,
        frames: int,
    ) -> "asyncio.Future[LiftedFrames]":
        answer: asyncio.Future[LiftedFrames] = asyncio.get_running_loop().create_future()
        size = _slice_size(way.model, way.refine)
        call = _Call(
            way, keypoints, confidence, observed, previous, size, answer, frames, missing=frames
        )
        with self._changed:
            if frames > size:
                self._large.append(call)
            else:
                self._small.setdefault(way, deque()).append(call)
            self._changed.notify()
        return answer

    # In the threads:

    def _work(self) -> None:
        """Lift until the engine is closed; no error, whatever it is, ends the thread before."""
        while pieces := self._take():
            try:
                finished = self._outcomes(pieces)
            except BaseException:  # also those that end a thread, which must go on lifting
                logger.exception("A batch of lifts failed")
                fault = RuntimeError("a batch of lifts failed")
                finished = [(piece.call, fault) for piece in pieces]
            self._on_batch(sum(piece.stop - piece.start for piece in pieces))
            if finished:
                with suppress(RuntimeError):  # the loop is closed: no caller waits any more
                    finished[0][0].answer.get_loop().call_soon_threadsafe(self._deliver, finished)

    def _outcomes(self, pieces: list[_Piece]) -> "list[tuple[_Call, _Outcome]]":
        """Lift, and return the answers to whole calls."""
        return [
            (piece.call, outcome)
            for piece, part in zip(pieces, self._lift(pieces), strict=True)
            if (outcome := self._finished(piece, part)) is not None
        ]

    def _take(self) -> list[_Piece]:
        """Wait for work and return what is lifted next; nothing once the engine is closed."""
        with self._changed:
            while not self._closed:
                if not self._large and not self._small:
                    self._changed.wait()
                    continue
                large = bool(self._large) and (self._large_next or not self._small)
                self._large_next = not large
                pieces = self._take_large() if large else self._take_small()
                if self._large or self._small:
                    self._changed.notify()  # another thread can go on with the rest
                if pieces:
                    return pieces
        return []

    def _take_large(self) -> list[_Piece]:
        """Take a slice of the call whose turn it is."""
        call = self._large.popleft()
        if call.answer.done():  # given up
            return []
        start, call.taken = call.taken, min(call.taken + call.slice_size, call.frames)
        if call.taken < call.frames:
            self._large.append(call)
        return [_Piece(call, start, call.taken)]

    def _take_small(self) -> list[_Piece]:
        """Take the calls of the way whose turn it is, up to a slice."""
        way = next(iter(self._small))
        waiting = self._small.pop(way)
        pieces: list[_Piece] = []
        room = waiting[0].slice_size
        while waiting and waiting[0].frames <= room:
            call = waiting.popleft()
            if not call.answer.done():
                pieces.append(_Piece(call, 0, call.frames))
                room -= call.frames
        if waiting:
            self._small[way] = waiting  # at the end
        return pieces

    def _lift(self, pieces: list[_Piece]) -> list[_Outcome]:
        model = pieces[0].call.way.model
        if model.gone:
            return [NotFoundError("model", model.id)] * len(pieces)
        try:
            return _lift_together(pieces)
        except Exception as error:  # noqa: BLE001 - it is passed to the callers that wait
            if len(pieces) == 1:
                return [error]
        return [outcome for piece in pieces for outcome in self._lift([piece])]  # one is at fault

    def _finished(self, piece: _Piece, part: _Outcome) -> _Outcome | None:
        """Return the outcome of a whole call if this was the last part of it, or an error."""
        call = piece.call
        frames = piece.stop - piece.start
        if isinstance(part, Exception) or frames == call.frames:
            return part
        with self._changed:
            call.parts[piece.start] = part
            call.missing -= frames
            if call.missing:
                return None
        return join([call.parts[start] for start in sorted(call.parts)])

    # In the event loop:

    def _deliver(self, finished: "list[tuple[_Call, _Outcome]]") -> None:
        now = time.perf_counter()
        for call, outcome in finished:
            if call.answer.done():  # given up meanwhile
                continue
            if isinstance(outcome, Exception):
                call.answer.set_exception(outcome)
            else:
                call.answer.set_result(outcome)
                self._on_answer(now - call.asked_at)


def _slice_size(model: WarmModel, refine: Refine | None) -> int:
    prior = model.prior
    if prior.cameras is None or (refine or prior.config.refine) == "off":
        return SLICE_FRAMES
    return REFINED_FRAMES


def _lift_together(pieces: list[_Piece]) -> list[_Outcome]:
    way = pieces[0].call.way
    previous = [
        c.previous.frames(slice(start, stop)) for c, start, stop in pieces if c.previous is not None
    ]
    lift = way.model.prior.lift_observed(
        _observe(pieces), refine=way.refine, previous=join(previous) if previous else None
    )
    stops = accumulate(stop - start for _, start, stop in pieces)
    return [
        lift.frames(slice(end - stop + start, end))
        for (_, start, stop), end in zip(pieces, stops, strict=True)
    ]


def _observe(pieces: list[_Piece]) -> ObservedFrames:
    way = pieces[0].call.way
    observed = [
        c.observed.frames(slice(start, stop)) for c, start, stop in pieces if c.observed is not None
    ]
    if observed:
        return join_observed(observed)
    confidence = [c.confidence[start:stop] for c, start, stop in pieces if c.confidence is not None]
    return way.model.prior.observe(
        np.concatenate([call.keypoints[start:stop] for call, start, stop in pieces]),
        confidence=np.concatenate(confidence) if confidence else None,
        views=way.views,
    )
