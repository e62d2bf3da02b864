"""The two that carry out steps: one blocks, one awaits."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from typing import Any

import httpx2

from fewview.api.steps import Open, Read, Send, Sleep, Step, Steps, T
from fewview.errors import ConnectionFailed, FewviewError


class Blocking:
    """Carries out steps in the thread that asks for them."""

    def __init__(self, http: httpx2.Client, patience: float) -> None:
        self.http, self.patience = http, patience

    def run(self, steps: Steps[T]) -> T:
        """Return the result of the steps; raises what they raise."""
        with ExitStack() as opened:
            line = _Line(self.http, opened)
            try:
                step = next(steps)
                while True:
                    try:
                        answer = line.take(step)
                    except FewviewError as error:
                        step = steps.throw(error)
                    else:
                        step = steps.send(answer)
            except StopIteration as end:
                result: T = end.value
                return result


class _Line:
    """One run's requests and the response that it has open."""

    def __init__(self, http: httpx2.Client, opened: ExitStack) -> None:
        self._http, self._opened = http, opened
        self._pieces: Iterator[Any] = iter(())

    def take(self, step: Step) -> Any:
        if isinstance(step, Sleep):
            return time.sleep(step.seconds)
        with _reaching(self._http.base_url):
            if isinstance(step, Send):
                return self._http.send(step.request.build(self._http))
            if isinstance(step, Open):
                return self._open(step)
            return next(self._pieces, None)

    def _open(self, step: Open) -> httpx2.Response:
        self._opened.close()
        response = self._http.send(step.request.build(self._http), stream=True)
        self._opened.callback(response.close)
        if not response.is_success:
            response.read()
        elif step.events:
            self._pieces = iter(httpx2.EventSource(response))
        else:
            self._pieces = response.iter_bytes()
        return response


class Awaiting:
    """Carries out steps in an event loop: asyncio's."""

    def __init__(self, http: httpx2.AsyncClient, patience: float) -> None:
        self.http, self.patience = http, patience

    async def run(self, steps: Steps[T]) -> T:
        """Return the result of the steps; raises what they raise."""
        async with AsyncExitStack() as opened:
            line = _AsyncLine(self.http, opened)
            try:
                step = next(steps)
                while True:
                    try:
                        answer = await line.take(step)
                    except FewviewError as error:
                        step = steps.throw(error)
                    else:
                        step = steps.send(answer)
            except StopIteration as end:
                result: T = end.value
                return result


class _AsyncLine:
    """One run's requests and the response that it has open."""

    def __init__(self, http: httpx2.AsyncClient, opened: AsyncExitStack) -> None:
        self._http, self._opened = http, opened
        self._pieces: AsyncIterator[Any] | None = None

    async def take(self, step: Step) -> Any:
        if isinstance(step, Sleep):
            return await asyncio.sleep(step.seconds)
        with _reaching(self._http.base_url):
            if isinstance(step, Send):
                return await self._http.send(step.request.build(self._http))
            if isinstance(step, Open):
                return await self._open(step)
            assert isinstance(step, Read)  # noqa: S101
            assert self._pieces is not None  # noqa: S101
            return await anext(self._pieces, None)

    async def _open(self, step: Open) -> httpx2.Response:
        await self._opened.aclose()
        response = await self._http.send(step.request.build(self._http), stream=True)
        self._opened.push_async_callback(response.aclose)
        if not response.is_success:
            await response.aread()
        elif step.events:
            self._pieces = aiter(httpx2.EventSource(response))
        else:
            self._pieces = response.aiter_bytes()
        return response


@contextmanager
def _reaching(url: httpx2.URL) -> Iterator[None]:
    """Turn errors of the connection into an error with a remedy."""
    try:
        yield
    except httpx2.TimeoutException as error:
        raise ConnectionFailed(
            f"{url} did not answer in time: try again, or give the client a longer timeout"
        ) from error
    except httpx2.HTTPError as error:
        raise ConnectionFailed(
            f"{url} cannot be reached ({str(error) or type(error).__name__}): start the service "
            "with `fewview serve`, or give its address: Client(url), --url or FEWVIEW_URL"
        ) from error
