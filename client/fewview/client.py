"""The clients: one that blocks, one that is awaited; what they can do is in ``fewview.api``."""

import os
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, AbstractContextManager
from types import TracebackType
from typing import Any, Self, Unpack

import httpx2
from numpy.typing import ArrayLike

from fewview.api.access import Audit, Keys
from fewview.api.datasets import Datasets
from fewview.api.drivers import Awaiting, Blocking
from fewview.api.evaluations import Evaluations
from fewview.api.fits import Fits
from fewview.api.forms import Model
from fewview.api.health import HealthChecks
from fewview.api.lifting import Lift, lift_request
from fewview.api.lifts import Lifts
from fewview.api.models import Models
from fewview.api.operations import Driver, Resource, operation
from fewview.api.steps import Steps
from fewview.api.stream import AsyncStream, Line, Start, Stream
from fewview.api.watching import OpenStream, Streams, WatchedFrame, watch, watch_async
from fewview.api.webhooks import Webhooks
from fewview.capture import Capture
from fewview.keys import is_loopback, key_for

DEFAULT_URL = "http://127.0.0.1:8000"
CONNECT_SECONDS = 10.0


class Api(Resource[Driver]):
    """What both clients can do.

    Attributes
    ----------
    url
        Where the service is.
    datasets, fits, models, lifts, streams, evaluations, health, keys, audit, webhooks
        What it has.
    """

    def __init__(self, driver: Driver) -> None:
        super().__init__(driver)
        self.url = str(driver.http.base_url).rstrip("/")
        self.datasets = Datasets(driver)
        self.fits = Fits(driver)
        self.models = Models(driver)
        self.lifts = Lifts(driver)
        self.streams = Streams(driver)
        self.evaluations = Evaluations(driver)
        self.health = HealthChecks(driver)
        self.keys = Keys(driver)
        self.audit = Audit(driver)
        self.webhooks = Webhooks(driver)

    @operation
    def lift(
        self,
        model: Model | str,
        keypoints: Capture | ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        times: ArrayLike | None = None,
        refine: str | None = None,
        views: Iterable[int] | None = None,
        frame: str | None = None,
        up: ArrayLike | None = None,
        uncertainty: str | None = None,
    ) -> Steps[Lift]:
        """Lift frames with a fitted model.

        Parameters
        ----------
        keypoints
            (N, K, P, 2) pixels, NaN where not observed; or a capture.
        confidence
            (N, K, P) in [0, 1]; 0 is not observed.
        times
            Times of the frames, (N,) or (N, K) seconds, rising: they are then one film, and
            smoothed in time if the model was fitted to one. None: those of the capture, if it has
            times or a rate; else each frame is lifted on its own.
        refine
            ``auto``, ``full`` or ``off``: where frames are refined in perspective. None: as in
            the fit.
        views
            Which K views of the fit these are; None if they are all, or unknown.
        frame
            The frame of reference of points and cameras: ``canonical``, the default, is centred and
            turns with the subject; ``room`` is that of the model's static cameras.
        up
            The direction of up in the room, which becomes y: ``auto`` or a vector (3,) in the room
            without `up`. Feet, if keypoints are named so, are then on the floor, y = 0.
        uncertainty
            How far points may be off: ``sd``, the default, gives ``points3d_sd``; ``full``
            covariances and modes, too, by which :meth:`~fewview.Lift.lengths`, ``angles`` and
            ``ratios`` have deviations; ``off`` nothing.

        Raises
        ------
        NotFound
            There is no such model.
        Conflict
            It has no room, because none of its cameras is static, or up could not be estimated.
        InvalidRequest
            The keypoints are not those of the model; ``errors`` have what is expected.
        """
        return self._call(
            lift_request(
                model,
                keypoints,
                confidence=confidence,
                times=times,
                refine=refine,
                views=views,
                frame=frame,
                up=up,
                uncertainty=uncertainty,
            )
        )

    def _line(self) -> Line:
        return Line(self._driver)


class Client(Api[Blocking]):
    """Talks to a Fewview service; threads may share it. Used in a ``with``, or closed at the end.

    Parameters
    ----------
    url
        The address of the service; default: ``FEWVIEW_URL``, else http://127.0.0.1:8000.
    key
        Lets the client in, as ``fewview key create`` prints it. None: the one in ``FEWVIEW_KEY``,
        else the token in the data folder of a service on this machine, if there is one. An empty
        text: no key is sent.
    timeout
        Seconds that the service may stay silent.
    patience
        Seconds for which requests are repeated while it is away or busy; 0: never.
    headers
        Sent with every request. An ``Authorization`` among them, for a proxy, replaces the key, and
        so do a user and a password in the URL.

    Raises
    ------
    ValueError
        The URL is invalid, or the key has characters that a header cannot have.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        timeout: float = 60.0,
        patience: float = 20.0,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        http = httpx2.Client(**_options(url, key, timeout, headers))
        super().__init__(Blocking(http, patience))

    def stream(self, model: Model | str, **start: Unpack[Start]) -> Stream:
        """Return a stream of single frames, to be used in a ``with``.

        Parameters
        ----------
        start
            What :class:`~fewview.api.stream.Start` names.

        Raises
        ------
        ApiError
            On entering it: the model or the options are wrong, or too many streams are open.
        ConnectionFailed
            On entering it: the service cannot be reached.
        """
        return Stream(self._line(), model, start)

    def watch(
        self, stream: OpenStream | str
    ) -> AbstractContextManager[Iterator[OpenStream | WatchedFrame]]:
        """Return states and frames of a stream until it ends, to be iterated over in a ``with``.

        Raises
        ------
        NotFound
            With the first of them: no such stream is open.
        Unavailable
            Streams cannot be watched just now.
        """
        return watch(self._line(), stream)

    def close(self) -> None:
        """Close the connections."""
        self._driver.http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _k: type[BaseException] | None, _e: BaseException | None, _t: TracebackType | None
    ) -> None:
        self.close()


class AsyncClient(Api[Awaiting]):
    """The same to be awaited, in asyncio: used in an ``async with``, or closed at the end.

    Its parameters are those of :class:`Client`. Arrays are written and read in the event loop's
    thread, which takes a millisecond per megabyte or so.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        timeout: float = 60.0,
        patience: float = 20.0,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        http = httpx2.AsyncClient(**_options(url, key, timeout, headers))
        super().__init__(Awaiting(http, patience))

    def stream(self, model: Model | str, **start: Unpack[Start]) -> AsyncStream:
        """Return a stream of single frames, to be used in an ``async with``."""
        return AsyncStream(self._line(), model, start)

    def watch(
        self, stream: OpenStream | str
    ) -> AbstractAsyncContextManager[AsyncIterator[OpenStream | WatchedFrame]]:
        """Return states and frames of a stream until it ends, for an ``async with``."""
        return watch_async(self._line(), stream)

    async def close(self) -> None:
        """Close the connections."""
        await self._driver.http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, _k: type[BaseException] | None, _e: BaseException | None, _t: TracebackType | None
    ) -> None:
        await self.close()


def _options(
    url: str | None, key: str | None, timeout: float, headers: Mapping[str, str] | None
) -> dict[str, Any]:
    """Return the options of httpx2's clients."""
    where = (url or os.environ.get("FEWVIEW_URL") or DEFAULT_URL).rstrip("/")
    if not where.startswith(("http://", "https://")):
        raise ValueError(f"expected a URL such as {DEFAULT_URL}, got {where!r}")
    base, sent = httpx2.URL(where), httpx2.Headers(dict(headers or {}))
    try:
        base.host.encode("idna")
    except UnicodeError as error:
        raise ValueError(f"{where!r} names no host that there can be ({error})") from error
    options = {
        "base_url": base,
        "timeout": httpx2.Timeout(timeout, connect=min(CONNECT_SECONDS, timeout)),
        "headers": sent,
    }
    if "Authorization" in sent or base.userinfo:
        if key:
            raise ValueError("key: there is an Authorization already; a request has only one")
    else:
        options["auth"] = key_for(base, key)
    if is_loopback(base.host):  # which no proxy reaches, nor has to see
        host = f"[{base.host}]" if ":" in base.host else base.host
        options["mounts"] = {f"all://{host}": None}
    return options
