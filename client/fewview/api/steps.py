"""What operations are made of: requests and pauses that a driver carries out.

An operation is a generator. It yields a step, gets back what came of it, and returns its result; a
:class:`~fewview.errors.ConnectionFailed` is raised where the step was yielded. It never waits
itself, so that the same code serves clients that block and clients that await.
"""

import json
import uuid
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Generic, TypeVar
from urllib.parse import quote

import httpx2
import numpy as np

T = TypeVar("T")


def nothing(_response: httpx2.Response) -> None:
    """Read a response that has no body."""


@dataclass(frozen=True)
class Request(Generic[T]):
    """One request, and how its answer is read.

    Attributes
    ----------
    path
        Below the client's URL.
    params
        The query; None is left out, a tuple is repeated, moments are written as ISO 8601.
    body
        ``json``, ``content``, or ``files`` and ``data``, as httpx2 takes them; arrays of NumPy in
        ``json`` are lists.
    read
        Makes the result of a successful response.
    """

    method: str
    path: str
    read: Callable[[httpx2.Response], T]
    params: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: Mapping[str, Any] = field(default_factory=dict)

    def build(self, http: "httpx2.Client | httpx2.AsyncClient") -> httpx2.Request:
        """Return it as httpx2 sends it."""
        params = {
            name: value.isoformat() if isinstance(value, datetime) else value
            for name, value in self.params.items()
            if value is not None
        }
        headers, body = dict(self.headers), dict(self.body)
        if "json" in body:
            body["content"] = json.dumps(body.pop("json"), default=_plain, allow_nan=False)
            headers["Content-Type"] = "application/json"
        return http.build_request(self.method, self.path, params=params, headers=headers, **body)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"expected a value that JSON can represent, got {type(value).__name__}")


@dataclass(frozen=True)
class Send:
    """Send a request; gives the whole response, whatever its status."""

    request: Request[Any]


@dataclass(frozen=True)
class Open:
    """Send a request whose response is read piece by piece; gives it with its headers.

    It takes the place of the one that was open before. Only errors have been read already.

    Attributes
    ----------
    events
        Whether :class:`Read` gives server-sent events, else it gives bytes.
    """

    request: Request[Any]
    events: bool = False


@dataclass(frozen=True)
class Read:
    """Read on in the response that is open; gives None at its end."""


@dataclass(frozen=True)
class Sleep:
    """Wait so many seconds."""

    seconds: float


Step = Send | Open | Read | Sleep
Steps = Generator[Step, Any, T]


def path(*parts: str) -> str:
    """Return the path of these parts, which may hold any characters.

    Raises
    ------
    ValueError
        One is empty, as the identifier in a variable of the shell that was never set.
    """
    if not all(parts):
        raise ValueError("expected an identifier, got an empty text")
    return "/" + "/".join(quote(part, safe="") for part in parts)


def once() -> dict[str, str]:
    """Return the header that keeps a request from being carried out twice, however often sent."""
    return {"Idempotency-Key": uuid.uuid4().hex}
