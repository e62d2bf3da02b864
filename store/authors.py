"""On whose behalf the store is used: what they see, and what they make, is their project's.

A session of an author is confined to the author's project: whatever it selects, updates or deletes
of :class:`store.records.Owned`, the condition is added to the statement. So no query can forget it.
Workers, and what serves everybody, use the store without an author.
"""

from typing import Any, NamedTuple

from sqlalchemy import event
from sqlalchemy.orm import ORMExecuteState, Session, with_loader_criteria

from store.expectations import Expected
from store.quotas import Quotas
from store.records import DEFAULT_PROJECT, Owned

# Execution options of a statement that sees all projects: for bounds on the whole.
ALL_PROJECTS = {"all_projects": True}
OWNER = "owner"  # in place of a key's identifier: the user that the service runs as


class Author(NamedTuple):
    """Who asks.

    Attributes
    ----------
    project
        The one project that this author sees.
    key_id
        The key that the request came with, or `OWNER`.
    quotas
        Those of the key.
    request_id
        Of the request, for the audit.
    """

    project: str = DEFAULT_PROJECT
    key_id: str = OWNER
    quotas: Quotas = Quotas()
    request_id: str | None = None


class AuthoredSession(Session):
    """A session that may have an author, who may expect a record to be as it was."""

    def __init__(
        self,
        *arguments: Any,
        author: Author | None,
        expected: Expected | None = None,
        **more: Any,
    ) -> None:
        super().__init__(*arguments, **more)
        self.info["author"], self.info["expected"] = author, expected


def author_of(session: Session) -> Author | None:
    """Return on whose behalf a session is used; None: the service's own."""
    author: Author | None = session.info["author"]
    return author


def owned_by(author: Author | None) -> dict[str, Any]:
    """Return the columns of :class:`Owned` of what an author makes."""
    if author is None:
        return {"project": DEFAULT_PROJECT}
    return {"project": author.project, "key_id": author.key_id}


@event.listens_for(AuthoredSession, "do_orm_execute")
def _confine(state: ORMExecuteState) -> None:
    author = author_of(state.session)
    if author is None or state.execution_options.get("all_projects", False):
        return
    project = author.project
    state.statement = state.statement.options(
        with_loader_criteria(Owned, lambda kind: kind.project == project, include_aliases=True)
    )
