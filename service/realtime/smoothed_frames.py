"""The frames of a stream with a lag: each is lifted when as many more have come."""

from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any

from models.lifting.lift import LiftedFrames
from models.lifting.observing import Following, ObservedFrames
from models.settings.config import Refine
from models.settings.uncertainty import Uncertainty
from service.realtime.engine import Engine
from service.realtime.stream_frames import Frame
from service.realtime.warm_models import WarmModel


class SmoothedFrames:
    """Takes frames one after the other, and returns which are answered by that."""

    def __init__(
        self,
        engine: Engine,
        run: Callable[..., Coroutine[Any, Any, ObservedFrames | None]],
        model: WarmModel,
        following: Following,
        refine: Refine,
        *,
        continuity: bool,
        uncertainty: Uncertainty,
        key_id: str,
    ) -> None:
        """Smooth in threads, in which `run` does work, and lift with the engine."""
        self._engine, self._run, self._model = engine, run, model
        self._following, self._refine, self._continuity = following, refine, continuity
        self._uncertainty, self._key_id = uncertainty, key_id
        self._waiting: deque[Frame] = deque()
        self._previous: LiftedFrames | None = None

    async def take(self, frame: Frame) -> list[tuple[Frame, LiftedFrames]]:
        """Return the frames, with their lifts, that a good frame or a flush makes ready.

        To be awaited before the next frame is given.
        """
        if frame.flush:
            observed = await self._run(self._following.flush)
        else:
            assert frame.capture is not None  # noqa: S101
            self._waiting.append(frame)
            keypoints, confidence = frame.capture.keypoints, frame.capture.confidence
            observed = await self._run(self._following.push, keypoints, confidence, frame.time)
        answered: list[tuple[Frame, LiftedFrames]] = []
        while observed is not None and len(answered) < len(observed.observations.weights):
            lift = await self._engine.lift_observed(
                self._model,
                observed.frames(slice(len(answered), len(answered) + 1)),
                refine=self._refine,
                previous=self._previous if self._continuity else None,
                uncertainty=self._uncertainty,
                key_id=self._key_id,
            )
            self._previous = lift
            answered.append((self._waiting.popleft(), lift))
        if frame.flush:
            self._previous = None
        return answered
