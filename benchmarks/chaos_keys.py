"""Keys of a deployment: users get another one each round; old keys and other projects see nothing.

The service trusts no local user, so that every request needs a key.
"""

import secrets
import time
from collections.abc import Callable, Iterable

from benchmarks.chaos_api import Api
from benchmarks.chaos_ledger import KINDS, Thing

PROJECT, OTHER_PROJECT = "lab", "elsewhere"
SCOPES = ["read", "lift", "write", "delete"]
ADMIN_KEY = secrets.token_hex(32)
SETTINGS = {"FEWVIEW_TRUST_LOCAL": "false", "FEWVIEW_ADMIN_KEY": ADMIN_KEY}
FORCE_SECONDS = 1.0  # after which every process knows what became of a key


class Keys:
    """Makes keys and revokes them, and looks with those that must not work."""

    def __init__(self, addresses: list[str], report: Callable[[str], None]) -> None:
        """Prepare to ask the APIs at these addresses; `report` receives violations."""
        self._addresses, self._report = addresses, report
        self._admin = Api(addresses, report, ADMIN_KEY)
        self._outsider = Api(addresses, report)
        self._revoked = Api(addresses, report)
        self._current: str | None = None

    def begin(self) -> None:
        """Make the key of somebody of another project."""
        _, self._outsider.key = self._new("outsider", OTHER_PROJECT)

    def renew(self, users: Api) -> None:
        """Give the users another key, and revoke the one that they had."""
        before, token = self._current, users.key
        self._current, users.key = self._new("users", PROJECT)
        if before is not None:
            answer = self._admin.ask("DELETE", f"/keys/{before}")
            if answer is None or answer.status_code != 204:
                self._report(f"key {before} could not be revoked: {answer and answer.text[:300]}")
            self._revoked.key = token
        time.sleep(FORCE_SECONDS)

    def check(self, things: Iterable[Thing]) -> None:
        """Ask every API with a revoked key, with none, and with a key of another project."""
        for wrong in (self._revoked, Api(self._addresses, self._report)):
            for _ in self._addresses:
                answer = wrong.read("/datasets")
                if answer.status_code != 401:
                    what = "no key" if wrong.key is None else "a revoked key"
                    self._report(f"GET /datasets with {what}: {answer.status_code}")
        for kind in KINDS:
            if any(self._outsider.listed(kind)):
                self._report(f"another project's key lists {kind}")
        for thing in things:
            if thing.identifier and (found := self._outsider.read(thing.path)).status_code != 404:
                self._report(f"{thing.path} with another project's key: {found.status_code}")

    def _new(self, name: str, project: str) -> tuple[str, str]:
        """Make a key; return its identifier and its token."""
        body = {"name": name, "project": project, "scopes": SCOPES}
        answer = self._admin.ask("POST", "/keys", json=body)
        if answer is None or answer.status_code != 201:
            raise TimeoutError(f"no key could be made: {answer and answer.text[:300]}")
        made = answer.json()
        return made["id"], made["token"]
