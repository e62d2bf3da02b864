"""Streams: frames over a WebSocket, lifted as they come; for both clients."""

import asyncio
import json
import logging
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack, contextmanager
from itertools import count
from types import TracebackType
from typing import Any, Self, TypedDict

from numpy.typing import ArrayLike
from websockets.asyncio.client import ClientConnection as AsyncConnection
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from fewview.api.drivers import Awaiting, Blocking
from fewview.api.forms import Model
from fewview.api.lifting import identifier
from fewview.api.retries import pause_before
from fewview.api.stream_messages import (
    FLUSH,
    Answer,
    Dropped,
    Ready,
    read_message,
    read_ready,
    write_frame,
)
from fewview.errors import (
    ConnectionFailed,
    FewviewError,
    TooManyRequests,
    Unavailable,
    api_error,
)
from fewview.keys import Key, is_loopback

AWAY_OR_BUSY = (ConnectionFailed, TooManyRequests, Unavailable)  # for which opening is patient
LONGEST_PAUSE = 1.0  # seconds: frames come meanwhile, which nobody sees


def _conceal(record: logging.LogRecord) -> bool:
    """Take the key out of what is logged of a handshake, which is all of its headers."""
    if isinstance(record.args, tuple) and str(record.args[:1]).lower() == "('authorization',)":
        record.args = (record.args[0], "[concealed]")
    return True


_logger = logging.getLogger("websockets.client.fewview")
_logger.addFilter(_conceal)


class Start(TypedDict, total=False):
    """The options of a stream; all are optional.

    Attributes
    ----------
    views
        Which views of the fit every frame has; None if any.
    refine
        ``auto``, ``full`` or ``off``; None as in the fit.
    on_overload
        ``all``: no frame is lost, and sending blocks. ``latest``: a new frame replaces one that
        waits.
    continuity
        Whether frames follow each other, so that refinement may start from the previous answer.
    frame, up
        The frame of reference of the answers; see :meth:`~fewview.Client.lift`.
    uncertainty
        ``off``, ``sd`` (the default) or ``full``: how much of it answers have.
    lag
        Smooth frames in time, each by up to so many later ones, 0 to 50, for which its answer
        waits. Only for models that were fitted to noisy frames with times.
    fps
        With ``lag``: frames per second; without it every frame is sent with its time.
    """

    views: Sequence[int] | None
    refine: str | None
    on_overload: str
    continuity: bool
    frame: str
    up: Sequence[float] | str | None
    uncertainty: str
    lag: int | None
    fps: float | None


class Line:
    """Where streams are opened, and how patiently."""

    def __init__(self, driver: Blocking | Awaiting) -> None:
        http = driver.http
        self.base = f"ws{str(http.base_url).removeprefix('http').rstrip('/')}"
        self.url = f"{self.base}/lift/stream"
        self.timeout, self.patience = http.timeout.read, driver.patience
        self._http = http

    def options(self) -> dict[str, Any]:
        """Return the options of a connection that is opened now."""
        own = {
            name: value
            for name, value in self._http.headers.items()
            if name not in ("accept", "accept-encoding", "connection", "user-agent")
        }
        key = self._http.auth.headers() if isinstance(self._http.auth, Key) else {}
        return {
            "compression": None,
            "open_timeout": self._http.timeout.connect,
            "additional_headers": own | key,
            "logger": _logger,
            "proxy": None if is_loopback(self._http.base_url.host) else True,
        }

    def pauses(self) -> Iterator[float]:
        """Give the seconds to wait before each further try to open, until patience is at an end."""
        begun = time.monotonic()
        for attempt in count(1):
            pause = min(pause_before(attempt), LONGEST_PAUSE)
            if time.monotonic() + pause > begun + self.patience:
                return
            yield pause


class Stream:
    """Frames in, answers out, in order; to be used in a ``with``.

    One thread may send while another receives. ``ready`` has what the service understood.
    """

    def __init__(self, line: Line, model: Model | str, start: Start) -> None:
        self._line, self._start = line, json.dumps({"model": identifier(model), **start})
        self._sequences = count()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        pauses = self._line.pauses()
        while True:
            try:
                with opening(self._line.url):
                    connection = connect(self._line.url, **self._line.options())
                    self._socket: ClientConnection = self._stack.enter_context(connection)
                break
            except AWAY_OR_BUSY:
                if (pause := next(pauses, None)) is None:
                    raise
                time.sleep(pause)
        try:
            with talking():
                self._socket.send(self._start)
                self.ready: Ready = read_ready(self._socket.recv(self._line.timeout))
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(
        self, _k: type[BaseException] | None, _e: BaseException | None, _t: TracebackType | None
    ) -> None:
        self._stack.close()

    def send(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        time: float | None = None,
    ) -> int:
        """Send a frame (K, P, 2), pixels, NaN where not observed; return its sequence number.

        ``time`` is when it was taken, in seconds, in streams with ``lag`` and without ``fps``.

        Raises
        ------
        ConnectionFailed
            The stream was closed.
        """
        sequence = next(self._sequences)
        with talking():
            self._socket.send(write_frame(sequence, keypoints, confidence, time))
        return sequence

    def flush(self) -> None:
        """Ask for the answers to all frames so far, in a stream with ``lag``.

        The next frame has none before it to be smoothed with.
        """
        with talking():
            self._socket.send(FLUSH)

    def receive(self) -> Answer | Dropped:
        """Return the next answer.

        Raises
        ------
        ApiError
            A frame is wrong, the one of its ``sequence``, and the stream goes on; or, if that is
            None, the stream ends.
        ConnectionFailed
            The stream was closed.
        """
        with talking():
            return read_message(self._socket.recv(), self.ready.keypoints, self.ready.uncertainty)

    def lift(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        time: float | None = None,
    ) -> Answer:
        """Send a frame and wait for its answer; for when no other is under way.

        Raises ValueError in a stream with a ``lag``, whose answers wait for later frames.
        """
        _check_waits_for_nothing(self.ready)
        sequence = self.send(keypoints, confidence=confidence, time=time)
        while True:
            answer = self.receive()
            if isinstance(answer, Answer) and answer.sequence == sequence:
                return answer

    def __iter__(self) -> Iterator[Answer | Dropped]:
        """Receive answers for ever."""
        while True:
            yield self.receive()


class AsyncStream:
    """The same to be awaited, in an ``async with``; one task may send while another receives."""

    def __init__(self, line: Line, model: Model | str, start: Start) -> None:
        self._line, self._start = line, json.dumps({"model": identifier(model), **start})
        self._sequences = count()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        pauses = self._line.pauses()
        while True:
            try:
                with opening(self._line.url):
                    connection = connect_async(self._line.url, **self._line.options())
                    self._socket: AsyncConnection = await self._stack.enter_async_context(
                        connection
                    )
                break
            except AWAY_OR_BUSY:
                if (pause := next(pauses, None)) is None:
                    raise
                await asyncio.sleep(pause)
        try:
            with talking():
                await self._socket.send(self._start)
                async with asyncio.timeout(self._line.timeout):
                    self.ready: Ready = read_ready(await self._socket.recv())
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(
        self, _k: type[BaseException] | None, _e: BaseException | None, _t: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def send(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        time: float | None = None,
    ) -> int:
        """Send a frame, as :meth:`Stream.send` does."""
        sequence = next(self._sequences)
        with talking():
            await self._socket.send(write_frame(sequence, keypoints, confidence, time))
        return sequence

    async def flush(self) -> None:
        """Ask for the answers to all frames so far, as :meth:`Stream.flush` does."""
        with talking():
            await self._socket.send(FLUSH)

    async def receive(self) -> Answer | Dropped:
        """Return the next answer, as :meth:`Stream.receive` does."""
        with talking():
            return read_message(
                await self._socket.recv(), self.ready.keypoints, self.ready.uncertainty
            )

    async def lift(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        time: float | None = None,
    ) -> Answer:
        """Send a frame and wait for its answer; for when no other is under way.

        Raises ValueError in a stream with a ``lag``, whose answers wait for later frames.
        """
        _check_waits_for_nothing(self.ready)
        sequence = await self.send(keypoints, confidence=confidence, time=time)
        while True:
            answer = await self.receive()
            if isinstance(answer, Answer) and answer.sequence == sequence:
                return answer

    async def __aiter__(self) -> AsyncIterator[Answer | Dropped]:
        """Receive answers for ever."""
        while True:
            yield await self.receive()


def _check_waits_for_nothing(ready: Ready) -> None:
    if ready.raw.get("lag"):
        raise ValueError("answers wait for later frames here: send them, receive answers, flush")


@contextmanager
def opening(url: str) -> Iterator[None]:
    """Raise what a connection is refused with as an error of ours."""
    try:
        yield
    except InvalidStatus as error:
        try:
            problem = json.loads(error.response.body or b"")
        except ValueError:
            problem = {}
        raise api_error(error.response.status_code, problem) from error
    except (OSError, WebSocketException) as error:  # TimeoutError is an OSError
        raise ConnectionFailed(
            f"{url} cannot be reached ({error}): start the service with `fewview serve`, or give "
            "where it is: Client(url) or FEWVIEW_URL"
        ) from error


@contextmanager
def talking() -> Iterator[None]:
    """Raise what a connection ends with as an error of ours."""
    try:
        yield
    except ConnectionClosed as error:
        raise _closed(error) from error
    except TimeoutError as error:
        raise ConnectionFailed("the service did not answer in time: open another stream") from error


def _closed(error: ConnectionClosed) -> FewviewError:
    if error.rcvd is None:
        return ConnectionFailed("the connection was lost: open another stream")
    reason = error.rcvd.reason or f"code {error.rcvd.code}"
    if error.rcvd.code >= 4000:
        title = "The service closed the stream"
        problem = {"code": "stream_closed", "title": title, "detail": reason}
        return api_error(error.rcvd.code - 4000, problem)
    return ConnectionFailed(f"the stream is closed ({reason}): open another")
