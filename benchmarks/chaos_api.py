"""A client that does not give up: it asks every API in turn until one has an answer."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx2

PAUSE_SECONDS = 0.3
ANSWER_SECONDS = 25.0
PATIENCE_SECONDS = 90.0


class Api:
    """The APIs of a deployment, as its users reach them: through any of them.

    Attributes
    ----------
    key
        The token that requests have, if any.
    """

    def __init__(
        self, addresses: list[str], report: Callable[[str], None], key: str | None = None
    ) -> None:
        """Prepare to ask; `report` receives answers that nothing excuses."""
        self.key = key
        self._turns = itertools.cycle(
            [httpx2.Client(base_url=a, timeout=ANSWER_SECONDS, trust_env=False) for a in addresses]
        )
        self._lock = threading.Lock()
        self._report = report

    def once(self, method: str, path: str, **options: Any) -> httpx2.Response | None:
        """Ask one API; None if it has no answer now (503 is none)."""
        with self._lock:
            client = next(self._turns)
        headers = {} if self.key is None else {"Authorization": f"Bearer {self.key}"}
        headers |= options.pop("headers", {})
        try:
            answer = client.request(method, path, headers=headers, **options)
        except httpx2.HTTPError:
            return None
        if answer.status_code == 503:
            return None
        if answer.status_code >= 500:
            self._report(f"{method} {path}: {answer.status_code} {answer.text[:300]}")
            return None
        return answer

    def ask(
        self, method: str, path: str, patience: float = PATIENCE_SECONDS, **options: Any
    ) -> httpx2.Response | None:
        """Ask until there is an answer; None if there is none for too long."""
        deadline = time.monotonic() + patience
        while (answer := self.once(method, path, **options)) is None:
            if time.monotonic() > deadline:
                return None
            time.sleep(PAUSE_SECONDS)
        return answer

    def read(self, path: str, **options: Any) -> httpx2.Response:
        """Read what must be there by now.

        Raises
        ------
        TimeoutError
            If nothing answers.
        """
        answer = self.ask("GET", path, **options)
        if answer is None:
            raise TimeoutError(f"GET {path}: no answer for {PATIENCE_SECONDS:.0f} s")
        return answer

    def listed(self, kind: str) -> Iterator[dict[str, Any]]:
        """Yield everything that a list holds."""
        cursor = None
        while True:
            query = {"limit": 200} | ({} if cursor is None else {"cursor": cursor})
            page = self.read(f"/{kind}", params=query).json()
            yield from page["items"]
            cursor = page.get("next_cursor")
            if cursor is None:
                return
