"""From frames of keypoints through a stream of the service to a program that shows them."""

import asyncio
import time
from collections import deque
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
from fewview.live.frames import WAITING, Arrival, Datagrams, Frame, Queue, follow_lines, read_frame
from fewview.live.holding import Holder, Pose
from fewview.live.targets import Target, Writer, about

REPORT_SECONDS = 1.0
IDLE_SECONDS = 1 / 30  # without an answer, after which the pose that fades is sent by itself
FRUITLESS = 8  # streams one after another that end before they answer
TRANSIENT = {408, 429, 500, 502, 503, 504}  # statuses of closed streams that are opened anew


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
    _pending: deque[tuple[int, Frame]] = field(default_factory=deque, init=False)
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
                    listening, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                        lambda: Datagrams(queue, lambda: self.figures.count("dropped")),
                        local_addr=self.source,
                    )
                host, port = listening.get_extra_info("sockname")[:2]
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
                await self._pass_on(stream, queue, first)
        except (ApiError, ConnectionFailed) as error:
            refused = isinstance(error, ApiError) and error.status not in TRANSIENT
            self._fruitless += 1
            if refused or not opened or self._fruitless > FRUITLESS:  # opening was patient already
                raise
            for _ in self._pending:
                self.figures.count("dropped")
            self._pending.clear()
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
        sequences = count()  # as the stream counts
        while True:
            arrival = arrival or await queue.get()
            if arrival.data is None:
                self._ended = True
                return
            try:
                frame = read_frame(arrival, len(self.names))
            except ValueError as error:
                self.figures.count("bad", str(error))
            else:
                self._pending.append((next(sequences), frame))
                await stream.send(frame.keypoints, confidence=frame.confidence)
            arrival = None

    def _take(self, received: "asyncio.Task[Answer | Dropped]") -> None:
        try:
            message = received.result()
        except ApiError as error:
            if error.code == "stream_closed" or not self._pending:
                raise
            self._pending.popleft()  # answers have the order of the frames
            self.figures.count("bad", error.detail)
            return
        self._fruitless = 0
        if isinstance(message, Dropped):
            for _ in message.sequences:
                self.figures.count("dropped")
            self._pending = deque(
                each for each in self._pending if each[0] not in message.sequences
            )
            return
        _, frame = self._pending.popleft()
        sds = None if message.points3d_sd is None else message.points3d_sd.astype(np.float64)
        points = message.points3d.astype(np.float64)
        self._answered = time.perf_counter()
        self._write(self.holder.take(frame.sequence, points, sds, self._answered))
        self.figures.answered(frame.come)

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
