"""The audit: who changed what."""

from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, Field

from service.http.dependencies import StoreDep
from service.http.errors import problems
from service.resources.lists import LimitQuery, cut
from store import audit, records

router = APIRouter(prefix="/audit", tags=["keys"])

EXAMPLE: dict[str, Any] = {
    "id": "audit_01m7yspdypmt22jq6npfg62xe5",
    "at": "2026-03-01T09:30:00Z",
    "project": "gait",
    "key_id": "key_01m7yspdypmt22jq6npfg62xe5",
    "action": "dataset.delete",
    "target": "ds_01m7yspf3gqz6cz1v8e7ch3y7c",
    "request_id": "4f7c2a90",
}


class AuditEntry(BaseModel):
    """A change, and who made it."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE})

    id: str
    at: datetime
    project: str
    key_id: str = Field(
        description="The key; `owner` without one, `admin` for the key of the settings."
    )
    action: str = Field(description="Such as `dataset.create`, `fit.cancel`, `key.revoke`.")
    target: str = Field(description="What was changed.")
    request_id: str | None = Field(description="The `X-Request-Id` of the request.")


class AuditPage(BaseModel):
    """Changes, newest first."""

    model_config = ConfigDict(json_schema_extra={"example": {"items": [EXAMPLE]}})

    items: list[AuditEntry]
    next_cursor: str | None = None


@router.get("", responses=problems())
def list_audit(
    store: StoreDep,
    key_id: Annotated[str | None, Query(max_length=200, description="Changes by this key.")] = None,
    target: Annotated[str | None, Query(max_length=200, description="Changes of this.")] = None,
    limit: LimitQuery = 50,
    cursor: Annotated[
        str | None,
        Query(pattern="^audit_[0-9a-z]{26}$", description="`next_cursor` of the page before."),
    ] = None,
) -> AuditPage:
    """List what was changed in all projects, newest first.

    What workers do is not in it: it follows from what they were asked for.
    """
    found = audit.page(store, limit=limit + 1, after=cursor, key_id=key_id, target=target)
    page, more = cut(found, limit)
    return AuditPage(items=[_entry(record) for record in page], next_cursor=more)


def _entry(record: records.AuditRecord) -> AuditEntry:
    return AuditEntry(
        id=record.id,
        at=datetime.fromtimestamp(record.at, UTC),
        project=record.project,
        key_id=record.key_id,
        action=record.action,
        target=record.target,
        request_id=record.request_id,
    )
