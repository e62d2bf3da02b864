"""From frames of keypoints through a stream of the service to a program that shows them."""

import asyncio
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from fewview.api.retries import pause_before
from fewview.api.stream import AsyncStream, Start
from fewview.api.stream_messages import Answer, Dropped
from fewview.client import AsyncClient
from fewview.errors import ApiError, ConnectionFailed
from fewview.live.figures import Figures
from fewview.live.frames import (
    WAITING,
    Arrival,
    Datagrams,
    Frame,
    Order,
    Queue,
    follow_lines,
    read_frame,
)
from fewview.live.holding import Holder, Pose
from fewview.live.targets import Target, Writer, about, usual_address

REPORT_SECONDS = 1.0
IDLE_SECONDS = 1 / 30  # without an answer, after which the pose that fades is sent by itself
FRUITLESS = 8  # streams one after another that end before they answer
TRANSIENT = {408, 429, 500, 502, 503, 504}  # statuses of closed streams that are opened anew
IN_HAND = 16  # frames without an answer: more would wait on the way, where none replaces them


@dataclass
class Bridge:
    """One run of a bridge.

    Attributes
    ----------
    client, model, start
        Whose stream is opened, and with which options.
    source
        Host and port to listen on for datagrams; None: standard input, to its end.
    names
        P names of the keypoints.
    fps
        Frames per second of a stream with a lag; None: each frame has its time.
    """

    client: AsyncClient
    model: str
    start: Start
    source: tuple[str, int] | None
    names: Sequence[str]
    writer: Writer
    target: Target
    holder: Holder
    figures: Figures
    fps: float | None = None
    _pending: dict[int, Frame] = field(default_factory=dict, init=False)
    _fewer: asyncio.Event = field(default_factory=asyncio.Event, init=False)  # pending than before
    _order: Order = field(default_factory=Order, init=False)
    _ended: bool = field(default=False, init=False)
    _answered: float = field(default=-np.inf, init=False)
    _fruitless: int = field(default=0, init=False)

    async def run(self) -> None:
        """Pass frames on until standard input ends, or the task is cancelled.

        Raises
        ------
        ApiError
            The service refuses the model or the options.
        ConnectionFailed
            It is away for longer than the client is patient, or stream after stream ends at once.
        OSError
            The address to listen on is taken.
        """
        queue: Queue = asyncio.Queue(WAITING)
        listening: asyncio.DatagramTransport | None = None
        beside = [asyncio.create_task(self._report()), asyncio.create_task(self._fade())]
        try:
            if self.source is None:
                follow_lines(queue)
            else:
                with about("--from", *self.source):
                    family, address = usual_address(*self.source)
                    listening, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                        lambda: Datagrams(queue, lambda: self.figures.count("dropped")),
                        local_addr=address[:2],
                        family=family,
                    )
                host, port = listening.get_extra_info("sockname")[:2]
                host = f"[{host}]" if ":" in host else host
                self.figures.show(f"listening on udp://{host}:{port}")
            await self._stream(queue, None)  # at once, so that what is wrong is said at once
            while not self._ended:
                await self._stream(queue, await queue.get())
        finally:
            if listening is not None:
                listening.close()
            for task in beside:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
            self.figures.report()

    async def _stream(self, queue: Queue, first: Arrival | None) -> None:
        """Open a stream and pass frames on until one of both ends."""
        opened = False
        try:
            async with self.client.stream(self.model, **self.start) as stream:
                opened = True
                if first is not None and self.source is not None and not queue.empty():
                    self.figures.count("dropped")  # opening took long, and newer ones have come
                    first = None
                await self._pass_on(stream, queue, first)
        except (ApiError, ConnectionFailed) as error:
            refused = isinstance(error, ApiError) and error.status not in TRANSIENT
            self._fruitless += 1
            if refused or not opened or self._fruitless > FRUITLESS:  # opening was patient already
                raise
            for _ in self._pending:
                self.figures.count("dropped")
            self._pending.clear()
            self._fewer.set()
            self.figures.count("reconnects", str(error))
            await asyncio.sleep(pause_before(self._fruitless))

    async def _pass_on(self, stream: AsyncStream, queue: Queue, first: Arrival | None) -> None:
        sending = asyncio.create_task(self._send(stream, queue, first))
        receiving: asyncio.Task[Answer | Dropped] | None = None
        try:
            while not sending.done() or self._pending:
                receiving = receiving or asyncio.create_task(stream.receive())
                waiting = {receiving} if sending.done() else {receiving, sending}
                await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                if receiving.done():
                    ended, receiving = receiving, None
                    self._take(ended)
            await sending
        finally:
            for task in (sending, receiving):
                if task is not None:
                    task.cancel()
                    with suppress(asyncio.CancelledError, ConnectionFailed, ApiError):
                        await task

    async def _send(self, stream: AsyncStream, queue: Queue, arrival: Arrival | None) -> None:
        sequences, last = count(), -np.inf  # as the stream counts; the time of the frame before
        lag = self.start.get("lag")
        while True:
            while len(self._pending) >= IN_HAND + (lag or 0):
                self._fewer.clear()
                await self._fewer.wait()
            arrival = arrival or await queue.get()
            if arrival.data is None:
                self._ended = True
                if lag is not None:
                    await stream.flush()
                return
            frame, arrival = self._read(arrival), None
            if frame is None:
                continue
            if frame.time is not None:
                if frame.time <= last:  # its sender has begun anew
                    await stream.flush()
                last = frame.time
            self._pending[next(sequences)] = frame
            await stream.send(frame.keypoints, confidence=frame.confidence, time=frame.time)

    def _read(self, arrival: Arrival) -> Frame | None:
        """Return the frame that came, with its time if the stream has a lag; None if it is bad."""
        try:
            frame = read_frame(arrival, len(self.names))
            frame = frame._replace(time=self._time(frame))
        except ValueError as error:
            self.figures.count("bad", str(error))
            return None
        if self.source is not None and self._order.is_overtaken(frame):
            self.figures.count("dropped")
            return None
        return frame

    def _time(self, frame: Frame) -> float | None:
        if self.start.get("lag") is None:
            return None
        if self.fps is not None:
            return frame.sequence / self.fps
        if frame.time is None:
            raise ValueError("time: expected seconds, which --lag needs; or give --fps")
        return frame.time

    def _take(self, received: "asyncio.Task[Answer | Dropped]") -> None:
        try:
            message = received.result()
        except ApiError as error:
            if error.sequence is None:
                raise
            self._done(error.sequence)
            self.figures.count("bad", error.detail)
            return
        self._fruitless = 0
        if isinstance(message, Dropped):
            for sequence in message.sequences:
                self._done(sequence)
                self.figures.count("dropped")
            return
        frame = self._done(message.sequence)
        sds = None if message.points3d_sd is None else message.points3d_sd.astype(np.float64)
        points = message.points3d.astype(np.float64)
        self._answered = time.perf_counter()
        self._write(self.holder.take(frame.sequence, points, sds, self._answered))
        self.figures.answered(frame.come)

    def _done(self, sequence: int) -> Frame:
        self._fewer.set()
        return self._pending.pop(sequence)

    def _write(self, pose: Pose) -> None:
        try:
            for datagram in self.writer(pose):
                self.target.send(datagram)
        except OSError as error:
            self.figures.count("unsent", str(error))

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(REPORT_SECONDS)
            self.figures.report()

    async def _fade(self) -> None:
        """Send the last pose again and again while no frame comes, until all of it is gone."""
        shown = False
        while True:
            await asyncio.sleep(IDLE_SECONDS)
            now = time.perf_counter()
            if now - self._answered < 2 * IDLE_SECONDS:
                shown = True
            elif shown:
                pose = self.holder.pose(now)
                self._write(pose)
                shown = bool(pose.weights.any())
