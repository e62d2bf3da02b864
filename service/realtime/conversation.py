"""What one stream is: frames that come, lifts that are asked for, answers in their order."""

import asyncio
import time
from collections import deque
from functools import partial

import orjson
from fastapi import WebSocket

from models.lifting.lift import LiftedFrames
from models.lifting.observing import Following
from service.http.errors import ApiError
from service.http.key_rates import Rates
from service.http.keyring import caller_of
from service.realtime.engine import Engine
from service.realtime.open_streams import OpenStream
from service.realtime.smoothed_frames import SmoothedFrames
from service.realtime.sockets import error_text, receive
from service.realtime.stream_frames import (
    FilmClock,
    Frame,
    quality_bytes,
    read_frame,
    seen_bytes,
    uncertainty_bytes,
    write_answer,
)
from service.realtime.warm_models import WarmModel
from service.settings import Settings
from service.wire.stream_messages import StreamLimits, StreamReady, StreamStart
from worker.rooms import Room

FRAMES_IN_HAND = 16  # of one stream; what waits longer is out of date
MAX_DROPPED = 10_000  # frames, until a client that reads no answers is not read from either

# What is awaited of a frame: its lift, or in streams with a lag what its coming makes ready.
_Answer = asyncio.Future[LiftedFrames] | asyncio.Future[list[tuple[Frame, LiftedFrames]]]


class Conversation:
    """One stream: frames that have arrived, frames whose lift was asked for, answers in order."""

    def __init__(
        self,
        websocket: WebSocket,
        engine: Engine,
        settings: Settings,
        start: StreamStart,
        model: WarmModel,
        room: Room | None,
        following: Following | None,
    ) -> None:
        self._websocket, self._engine, self._settings = websocket, engine, settings
        self._start, self._model, self._room = start, model, room
        self._prior = prior = model.prior
        self._key_id = caller_of(websocket).author.key_id
        self._refine = start.refine or prior.config.refine
        self._continuity = start.continuity and self._refine != "off" and prior.cameras is not None
        self._latest = start.on_overload == "latest"
        self._smoothed = self._clock = None
        if following is not None:
            self._clock = FilmClock(start.fps)
            self._smoothed = SmoothedFrames(
                engine,
                partial(websocket.app.state.lift_bodies.run, websocket),
                model,
                following,
                self._refine,
                continuity=self._continuity,
                uncertainty=start.uncertainty,
                key_id=self._key_id,
            )
        one = self._latest or self._continuity or following is not None
        self._at_a_time = 1 if one else FRAMES_IN_HAND
        self._arrived: deque[Frame] = deque()
        self._asked: deque[tuple[Frame, _Answer | None]] = deque()
        self._previous: LiftedFrames | None = None
        self._something_asked = asyncio.Event()
        self._something_answered = asyncio.Event()
        self._ready = self._understood()
        self.shown = OpenStream(self._ready, caller_of(websocket).author)

    def ready(self) -> str:
        """Return the first message of the server."""
        left_out = {"lag", "fps"} if self._ready.lag is None else None
        return self._ready.model_dump_json(exclude=left_out)

    def _understood(self) -> StreamReady:
        return StreamReady(
            model=self._model.id,
            keypoints=self._prior.keypoints_per_frame,
            views=self._start.views,
            refine=self._refine,
            on_overload=self._start.on_overload,
            continuity=self._continuity,
            frame=self._start.frame,
            up=self._start.up,
            uncertainty=self._start.uncertainty,
            lag=self._start.lag,
            fps=self._start.fps,
            seen_bytes=seen_bytes(self._prior.keypoints_per_frame),
            uncertainty_bytes=uncertainty_bytes(
                self._prior.keypoints_per_frame, self._start.uncertainty
            ),
            quality_bytes=quality_bytes(self._start.uncertainty),
            limits=StreamLimits(
                message_bytes=self._settings.max_stream_bytes,
                frames_in_hand=FRAMES_IN_HAND,
                idle_seconds=self._settings.stream_idle_seconds,
            ),
        )

    async def read(self, silence: asyncio.Timeout) -> None:
        """Take frames as they arrive, as many as may be in hand, until the client leaves."""
        now, patience = asyncio.get_running_loop().time, self._settings.stream_idle_seconds
        while True:
            silence.reschedule(now() + patience)
            message = await receive(self._websocket)
            arrived = time.perf_counter()
            frame = read_frame(
                message, self._prior, self._room, self._start.views, self._settings, self._clock
            )
            frame.arrived = arrived
            await self._count(frame)
            self._arrived.append(frame)
            self._ask()
            if self._latest:
                self._drop_stale()
            while self._is_full():
                self._something_answered.clear()
                await self._something_answered.wait()

    async def _count(self, frame: Frame) -> None:
        """Count a frame among those that the key may have lifted in a second."""
        rates: Rates = self._websocket.app.state.rates
        if frame.capture is None:
            return
        try:
            await rates.take_frames(caller_of(self._websocket), 1)
        except ApiError as error:
            frame.error = error

    def _is_full(self) -> bool:
        if self._latest:
            arrived = self._arrived
            dropping = bool(arrived) and len(arrived[-1].dropped) >= MAX_DROPPED
            return dropping or len(arrived) >= FRAMES_IN_HAND
        return len(self._arrived) + len(self._asked) >= FRAMES_IN_HAND

    def _drop_stale(self) -> None:
        """Let the newest frame take the place of one that waits, unless a flush parts them.

        A frame with an error takes no place and gives none up: each error is sent.
        """
        waiting = [frame for frame in self._arrived if frame.error is None]
        if len(waiting) < 2 or waiting[-1].flush or waiting[-2].flush:
            return
        stale, newest = waiting[-2:]
        self._arrived.remove(stale)
        if stale.sequence is not None:
            stale.dropped.append(stale.sequence)
        newest.dropped = stale.dropped
        self.shown.dropped += 1

    def _ask(self) -> None:
        """Ask for the lifts of frames that have arrived, as many as may be asked for at a time."""
        while self._arrived and len(self._asked) < self._at_a_time:
            frame = self._arrived.popleft()
            self._asked.append((frame, self._lift(frame)))
            self._something_asked.set()

    def _lift(self, frame: Frame) -> _Answer | None:
        if frame.error is not None:
            return None
        if self._smoothed is not None:
            return asyncio.ensure_future(self._smoothed.take(frame))
        assert frame.capture is not None  # noqa: S101
        keypoints = frame.capture.keypoints
        before = self._previous
        if before is not None and before.scales.shape[1] != keypoints.shape[1]:
            before = None  # of other views
        return self._engine.lift(
            self._model,
            keypoints,
            confidence=frame.capture.confidence,
            refine=self._refine,
            views=self._start.views,
            previous=before,
            uncertainty=self._start.uncertainty,
            key_id=self._key_id,
        )

    async def write(self) -> None:
        """Answer the frames in their order."""
        while True:
            while not self._asked:
                self._something_asked.clear()
                await self._something_asked.wait()
            frame, answer = self._asked[0]
            answered = [] if answer is None else await answer
            if isinstance(answered, LiftedFrames):
                if self._continuity:
                    self._previous = answered
                answered = [(frame, answered)]
            messages = [(frame, self._message(frame, lift)) for frame, lift in answered]
            if frame.error is not None:
                messages = [(frame, error_text(frame.error, frame.sequence))]
                self.shown.refused += 1
            self._asked.popleft()
            self._ask()
            self._something_answered.set()
            for frame, message in messages:
                await self._send(frame, message)

    def _message(self, frame: Frame, lift: LiftedFrames) -> str | bytes:
        if self._room is not None:
            lift = self._room.place(lift, self._start.views)
        self.shown.note(frame, lift)
        return write_answer(frame, lift, self._prior, self._start.uncertainty)

    async def _send(self, frame: Frame, message: str | bytes) -> None:
        if frame.dropped:
            notice = {"type": "dropped", "sequences": frame.dropped}
            await self._websocket.send_text(orjson.dumps(notice).decode())
        form = "text" if isinstance(message, str) else "bytes"
        await self._websocket.send({"type": "websocket.send", form: message})

    def give_up(self) -> None:
        """Leave the engine's queue."""
        for _, answer in self._asked:
            if answer is not None:
                answer.cancel()
