"""Requests that are tried again while the service is away or busy."""

import random
import time
from itertools import count
from typing import Any

import httpx2

from fewview.api.steps import Open, Request, Send, Sleep, Steps, T
from fewview.errors import ApiError, ConnectionFailed, TooManyRequests, Unavailable, api_error

FIRST_PAUSE, LONGEST_PAUSE = 0.2, 10.0  # seconds


def call(request: Request[T], patience: float) -> Steps[T]:
    """Send a request, patiently, and read its answer.

    Raises
    ------
    ApiError
        The service refused.
    ConnectionFailed
        It could not be reached for as long as ``patience``, or what answers is no Fewview.
    """
    response = yield from patiently(Send(request), patience)
    try:
        return request.read(response)
    except (ValueError, KeyError, TypeError) as error:
        raise ConnectionFailed(
            f"{response.url} does not answer as this Fewview client expects ({error}): look at "
            "the URL and at the service's version"
        ) from error


def patiently(step: Send | Open, patience: float) -> Steps[httpx2.Response]:
    """Send a request again while the service is away or busy; return a response that is a success.

    Pauses grow exponentially, with jitter, and are never shorter than ``Retry-After`` asks for.

    Parameters
    ----------
    patience
        Seconds after which it is given up; also at once if the next pause would go beyond them.

    Raises
    ------
    ApiError
        What the service answered, of 429 and 503 the last.
    ConnectionFailed
        The last of them.
    """
    begun = time.monotonic()
    for attempt in count():
        pause = pause_before(attempt + 1)
        try:
            response: httpx2.Response = yield step
            if response.is_success or _gone_already(response, attempt):
                return response
            error: ApiError | ConnectionFailed = problem_of(response)
            if not isinstance(error, TooManyRequests | Unavailable):
                raise error
            pause = max(pause, _retry_after(response))
        except ConnectionFailed as failed:
            error = failed
        if time.monotonic() + pause > begun + patience:
            raise error
        yield Sleep(pause)
    raise AssertionError  # count() does not end


def pause_before(attempt: int) -> float:
    """Return the seconds to wait before an attempt, which grow and are drawn at random."""
    longest: float = min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** min(attempt, 16))
    return random.uniform(longest / 2, longest)  # noqa: S311


def problem_of(response: httpx2.Response) -> ApiError:
    """Return the error in a response that has been read."""
    problem: Any
    try:
        problem = response.json()
    except ValueError:  # for example from a proxy
        problem = None
    if not isinstance(problem, dict):
        problem = {"detail": f"{response.status_code} {response.reason_phrase}: {response.url}"}
    return api_error(response.status_code, problem)


def _gone_already(response: httpx2.Response, attempt: int) -> bool:
    """Return whether an earlier attempt, whose answer was lost, has deleted the resource."""
    return attempt > 0 and response.status_code == 404 and response.request.method == "DELETE"


def _retry_after(response: httpx2.Response) -> float:
    try:
        return float(response.headers.get("Retry-After", 0))
    except ValueError:  # a date
        return 0.0
