"""Keys, which let clients in, and the audit of what was changed; both need the scope ``admin``."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from fewview.api.forms import Page, form_in, page_of
from fewview.api.lifting import identifier
from fewview.api.operations import Driver, Resource, listing, operation
from fewview.api.steps import Request, Steps, nothing, path


@dataclass(frozen=True)
class Key:
    """A key.

    Attributes
    ----------
    quotas
        Its bounds by their names; None where there is none.
    expires_at, revoked_at
        When it ceases, or has ceased, to be in force; None: never.
    """

    id: str
    name: str
    project: str
    scopes: tuple[str, ...]
    quotas: dict[str, int | None]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


@dataclass(frozen=True)
class NewKey(Key):
    """A key that was made just now; its ``token`` cannot be had again."""

    token: str = field(repr=False)


@dataclass(frozen=True)
class PageKey:
    """The key of the page, until the service stops: its address is ``/#key=TOKEN``."""

    token: str = field(repr=False)


@dataclass(frozen=True)
class AuditEntry:
    """A change: who made it (``key_id``), in which project, what (``action``) and of what."""

    id: str
    at: datetime
    project: str
    key_id: str
    action: str
    target: str
    request_id: str | None


class Keys(Resource[Driver]):
    """``/keys``."""

    @operation
    def create(
        self,
        /,
        name: str,
        scopes: Iterable[str],
        *,
        project: str | None = None,
        expires_at: datetime | None = None,
        **quotas: int,
    ) -> Steps[NewKey]:
        """Make a key. If the answer is lost on its way, a key without a known token is left.

        Parameters
        ----------
        scopes
            Some of ``read``, ``lift``, ``write``, ``delete``, ``admin``.
        quotas
            ``stored_bytes``, ``queued_jobs``, ``requests_per_second``,
            ``lifted_frames_per_second``.

        Raises
        ------
        InvalidRequest
            A field is wrong; ``errors`` name it.
        """
        given: dict[str, Any] = {
            "name": name,
            "scopes": list(scopes),
            "project": project,
            "expires_at": None if expires_at is None else expires_at.isoformat(),
            "quotas": quotas,
        }
        body = {name: value for name, value in given.items() if value is not None}
        return self._call(Request("POST", "/keys", form_in(NewKey), body={"json": body}))

    @operation
    def get(self, key: Key | str) -> Steps[Key]:
        """Describe a key; raise ``NotFound`` if there is none."""
        return self._call(Request("GET", path("keys", identifier(key)), form_in(Key)))

    @operation
    def of_page(self) -> Steps[PageKey]:
        """Return the key of the page for a browser of the service's own user; needs ``admin``.

        Raises
        ------
        NotFound
            The service lets nobody in without a key.
        """
        return self._call(Request("GET", "/page-key", form_in(PageKey)))

    @listing
    def list(self) -> Request[Page[Key]]:
        """Iterate over the keys of all projects, newest first; those that were revoked, too."""
        return Request("GET", "/keys", page_of(Key))

    @operation
    def revoke(self, key: Key | str) -> Steps[None]:
        """Revoke a key: it is refused within a second, and its streams and events end."""
        return self._call(Request("DELETE", path("keys", identifier(key)), nothing))


class Audit(Resource[Driver]):
    """``/audit``."""

    @listing
    def list(
        self, *, key: Key | str | None = None, target: str | None = None
    ) -> Request[Page[AuditEntry]]:
        """Iterate over the changes in all projects, newest first.

        Parameters
        ----------
        key
            Changes by this key only.
        target
            Changes of what has this identifier only.
        """
        by = None if key is None else identifier(key)
        query = {"key_id": by, "target": target}
        return Request("GET", "/audit", page_of(AuditEntry), params=query)
