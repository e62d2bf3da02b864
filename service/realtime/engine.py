"""The lifting engine: a few threads that lift the frames of many clients.

Calls of the same model with the same options that arrive while the threads are busy are lifted
together. A call that comes alone starts at once, and no call waits for others to join it. A call
with more frames than a slice is cut, and its slices take turns with all other calls, so that no
call waits for more than a slice or two of the others. Projects and keys take turns (`calls.py`).
"""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import accumulate

import numpy as np

from models.lifting.lift import LiftedFrames, join
from models.lifting.observing import ObservedFrames, join_observed
from models.numerics.threads import use_threads
from models.settings.config import Refine
from models.settings.uncertainty import Uncertainty
from service.realtime.calls import Call, Float32, Piece, WaitingCalls, Way
from service.realtime.warm_models import WarmModel, WarmModels
from store.authors import OWNER
from store.database import Store
from store.errors import NotFoundError

logger = logging.getLogger(__name__)

SLICE_FRAMES = 256  # lifted by the network alone, which takes some 20 us a frame
REFINED_FRAMES = 32  # refined, which takes some 1 ms a frame
CLOSE_SECONDS = 2.0


def _ignore(_figure: float) -> None:
    """Ignore a figure."""


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
        self._waiting = WaitingCalls()
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
        uncertainty: Uncertainty = "sd",
        key_id: str = OWNER,
    ) -> "asyncio.Future[LiftedFrames]":
        """Lift frames (N, K, P, 2) as ``FittedPrior.lift`` does, together with those of others.

        Called in the event loop, for a client with the key `key_id`. A future that is cancelled
        gives its place in the queue up. Nothing is asked of records, objects or queue.

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
            uncertainty,
        )
        return self._ask(way, key_id, keypoints, confidence, None, previous)

    def lift_observed(
        self,
        model: WarmModel,
        observed: ObservedFrames,
        *,
        refine: Refine | None = None,
        previous: LiftedFrames | None = None,
        uncertainty: Uncertainty = "sd",
        key_id: str = OWNER,
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
            uncertainty,
            observed=True,
        )
        return self._ask(way, key_id, keypoints, None, observed, previous)

    def _ask(
        self,
        way: Way,
        key_id: str,
        keypoints: Float32,
        confidence: Float32 | None,
        observed: ObservedFrames | None,
        previous: LiftedFrames | None,
    ) -> "asyncio.Future[LiftedFrames]":
        answer: asyncio.Future[LiftedFrames] = asyncio.get_running_loop().create_future()
        size, frames = _slice_size(way.model, way.refine), len(keypoints)
        call = Call(
            way,
            key_id,
            keypoints,
            confidence,
            observed,
            previous,
            size,
            answer,
            frames,
            missing=frames,
        )
        with self._changed:
            self._waiting.put(call)
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

    def _outcomes(self, pieces: list[Piece]) -> "list[tuple[Call, _Outcome]]":
        """Lift, and return the answers to whole calls."""
        return [
            (piece.call, outcome)
            for piece, part in zip(pieces, self._lift(pieces), strict=True)
            if (outcome := self._finished(piece, part)) is not None
        ]

    def _take(self) -> list[Piece]:
        """Wait for work and return what is lifted next; nothing once the engine is closed."""
        with self._changed:
            while not self._closed:
                pieces = self._waiting.take()
                if self._waiting:
                    self._changed.notify()  # another thread can go on with the rest
                if pieces:
                    return pieces
                self._changed.wait()
        return []

    def _lift(self, pieces: list[Piece]) -> list[_Outcome]:
        model = pieces[0].call.way.model
        if model.gone:
            return [NotFoundError("model", model.id)] * len(pieces)
        try:
            return _lift_together(pieces)
        except Exception as error:  # noqa: BLE001 - it is passed to the callers that wait
            if len(pieces) == 1:
                return [error]
        return [outcome for piece in pieces for outcome in self._lift([piece])]  # one is at fault

    def _finished(self, piece: Piece, part: _Outcome) -> _Outcome | None:
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

    def _deliver(self, finished: "list[tuple[Call, _Outcome]]") -> None:
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


def _lift_together(pieces: list[Piece]) -> list[_Outcome]:
    way = pieces[0].call.way
    previous = [
        c.previous.frames(slice(start, stop)) for c, start, stop in pieces if c.previous is not None
    ]
    lift = way.model.prior.lift_observed(
        _observe(pieces),
        refine=way.refine,
        previous=join(previous) if previous else None,
        uncertainty=way.uncertainty,
    )
    stops = accumulate(stop - start for _, start, stop in pieces)
    return [
        lift.frames(slice(end - stop + start, end))
        for (_, start, stop), end in zip(pieces, stops, strict=True)
    ]


def _observe(pieces: list[Piece]) -> ObservedFrames:
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
