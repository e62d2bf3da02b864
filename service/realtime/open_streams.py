"""The streams that are open in all processes of the API, known to each other through Redis.

Streams wait for none of this: a task of their process writes once a second which there are and how
they go, and sends frames of those that somebody watches. While Redis is away it sends nothing.
"""

import asyncio
import logging
import secrets
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from typing import Any, cast

import orjson
from redis.asyncio import Redis
from redis.asyncio.client import PubSub
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff

from models.lifting.lift import LiftedFrames
from service.realtime.stream_frames import Frame, write_watched
from service.wire.stream_messages import StreamReady
from service.wire.watch_messages import LiftStream
from store.authors import Author
from store.ids import new_id

logger = logging.getLogger(__name__)

BEAT_SECONDS = 1.0  # between two looks at how streams go, and whether they are watched
KEPT_SECONDS = 5  # that a process is known to have its streams after it fell silent
FRAME_SECONDS = 1 / 30  # between two frames of a stream that is watched
PATIENCE_SECONDS = 0.25  # for Redis
LATENCIES = 1000  # of a second, the last of them
PROCESSES = "fewview:streams"  # the set of processes that have streams
ENDED = b""  # the last message about a stream


def _key(process: str) -> str:
    return f"{PROCESSES}:{process}"


def _channel(stream_id: str) -> str:
    return f"fewview:stream:{stream_id}"


class OpenStream:
    """What others may see of a stream: its options, its figures and its newest frame."""

    def __init__(self, ready: StreamReady, author: Author) -> None:
        """Begin, with what was understood of the stream and who opened it."""
        self.id, self.project = new_id("stream"), author.project
        self.watched, self._uncertainty = False, ready.uncertainty
        self.answered = self.dropped = self.refused = self.not_lifted = 0
        self._latencies: deque[float] = deque(maxlen=LATENCIES)  # seconds
        self._newest: tuple[Frame, LiftedFrames] | None = None
        self._beat_at, self._answered_then = time.monotonic(), 0
        self._about = {
            **ready.model_dump(include=set(LiftStream.model_fields)),
            **{"id": self.id, "key_id": author.key_id, "since": time.time()},
            **{"frames_per_second": 0.0, "latency_ms": None, "latency_p95_ms": None},
        }

    def note(self, frame: Frame, lift: LiftedFrames) -> None:
        """Note the answer to a frame as it is sent."""
        self.answered += 1
        self.not_lifted += bool(lift.status[0] != "ok")
        self._latencies.append(time.perf_counter() - frame.arrived)
        if self.watched:
            self._newest = frame, lift

    def state(self) -> dict[str, Any]:
        """Return the stream as it is listed; rates are those of the last beat."""
        now = time.monotonic()
        if now - self._beat_at >= BEAT_SECONDS / 2:
            lately = sorted(self._latencies)
            self._latencies.clear()
            rate = (self.answered - self._answered_then) / (now - self._beat_at)
            self._about["frames_per_second"] = round(rate, 1)
            self._about["latency_ms"] = _milliseconds(lately, 0.5)
            self._about["latency_p95_ms"] = _milliseconds(lately, 0.95)
            self._beat_at, self._answered_then = now, self.answered
        counted = ("answered", "dropped", "refused", "not_lifted")
        return self._about | {name: getattr(self, name) for name in counted}

    def take_newest(self) -> bytes | None:
        """Return the newest frame with its answer, as who watches gets it; None: it was taken."""
        if self._newest is None:
            return None
        (frame, lift), self._newest = self._newest, None
        return write_watched(frame, lift, self._uncertainty)


def _milliseconds(seconds: list[float], share: float) -> float | None:
    """Return a quantile of sorted seconds."""
    if not seconds:
        return None
    return round(1000 * seconds[int(share * (len(seconds) - 1))], 2)


class OpenStreams:
    """The streams of this process, which it shows to all, and those that others show."""

    def __init__(self, redis_url: str) -> None:
        self._redis: Redis = Redis.from_url(
            redis_url,
            retry=Retry(NoBackoff(), 1),  # a connection from before Redis began anew is closed
            socket_timeout=PATIENCE_SECONDS,
            socket_connect_timeout=PATIENCE_SECONDS,
        )
        self._process = secrets.token_hex(8)
        self._streams: set[OpenStream] = set()
        self._ended: list[str] = []
        self._changed = asyncio.Event()
        self._showing: asyncio.Task[None] | None = None

    async def close(self) -> None:
        """Announce that the streams of this process have ended, if that takes no time."""
        if self._showing is not None:
            await asyncio.wait([self._showing], timeout=PATIENCE_SECONDS)
            self._showing.cancel()
        await self._redis.aclose()

    @contextmanager
    def listed(self, stream: OpenStream) -> Iterator[None]:
        """Show a stream to all processes as long as it is open."""
        self._streams.add(stream)
        self._changed.set()
        if self._showing is None or self._showing.done():
            self._showing = asyncio.create_task(self._show())
        try:
            yield
        finally:
            self._streams.discard(stream)
            self._ended.append(stream.id)
            self._changed.set()

    async def of(self, project: str) -> list[dict[str, Any]]:
        """Return the streams of a project, in all processes, those opened last first.

        Raises
        ------
        RedisError
            If Redis cannot be asked.
        """
        members = cast(set[bytes], await self._redis.smembers(PROCESSES))
        processes = [name.decode() for name in members]
        shown = await self._redis.mget([_key(name) for name in processes]) if processes else []
        gone = [name for name, found in zip(processes, shown, strict=True) if found is None]
        if gone:  # they were killed
            await self._redis.srem(PROCESSES, *gone)
        everything = [each for found in shown if found is not None for each in orjson.loads(found)]
        mine = [state for owner, state in everything if owner == project]
        return sorted(mine, key=lambda state: str(state["id"]), reverse=True)

    async def get(self, project: str, stream_id: str) -> dict[str, Any] | None:
        """Return a stream of a project; None if no such stream is open."""
        return next((s for s in await self.of(project) if s["id"] == stream_id), None)

    @asynccontextmanager
    async def subscribed(self, stream_id: str) -> AsyncIterator[PubSub]:
        """Give the messages about a stream: its frames, its states as JSON, `ENDED`."""
        async with self._redis.pubsub(ignore_subscribe_messages=True) as messages:
            await messages.subscribe(_channel(stream_id))
            yield messages

    async def _show(self) -> None:
        """Show the streams until none is open; whatever goes wrong, they go on."""
        due, away, watched = 0.0, False, False
        while self._streams or self._ended:
            try:
                if self._changed.is_set() or time.monotonic() >= due:
                    self._changed.clear()
                    await self._beat()
                    due = time.monotonic() + BEAT_SECONDS
                watched = await self._send_frames()
                away = False
            except Exception:  # whatever it is
                if not away:
                    logger.exception("Streams are neither listed nor watched")
                away, watched, due = True, False, time.monotonic() + BEAT_SECONDS
                self._ended.clear()  # who watched them notices the silence
                for stream in self._streams:
                    stream.watched = False
            with suppress(TimeoutError):
                async with asyncio.timeout(FRAME_SECONDS if watched else due - time.monotonic()):
                    await self._changed.wait()
                    await asyncio.sleep(FRAME_SECONDS)  # for others that begin or end just now

    async def _beat(self) -> None:
        """Write which streams there are, send who watches how they go, and see who does."""
        streams, ended = list(self._streams), list(self._ended)
        states = [stream.state() for stream in streams]
        commands = self._redis.pipeline(transaction=False)
        for stream, state in zip(streams, states, strict=True):
            commands.publish(_channel(stream.id), orjson.dumps(state))
        for stream_id in ended:
            commands.publish(_channel(stream_id), ENDED)
        if streams:
            shown = [(s.project, state) for s, state in zip(streams, states, strict=True)]
            commands.set(_key(self._process), orjson.dumps(shown), ex=KEPT_SECONDS)
            commands.sadd(PROCESSES, self._process)
        else:
            commands.delete(_key(self._process))
            commands.srem(PROCESSES, self._process)
        watchers = await commands.execute()
        for stream, many in zip(streams, watchers, strict=False):
            stream.watched = many > 0
        del self._ended[: len(ended)]

    async def _send_frames(self) -> bool:
        """Send the newest frames of those that are watched; return whether any is."""
        watched = [stream for stream in self._streams if stream.watched]
        commands = self._redis.pipeline(transaction=False)
        for stream in watched:
            frame = stream.take_newest()
            if frame is not None:
                commands.publish(_channel(stream.id), frame)
        await commands.execute()
        return bool(watched)
