"""Keys: who may do what, in which project."""

from datetime import datetime
from typing import Annotated, Any, Self

from fastapi import APIRouter, Query, Request, Response, status
from pydantic import BaseModel, ConfigDict, Field

from service.http.dependencies import Identifier, StoreDep
from service.http.errors import BODY_PROBLEMS, ApiError, problems
from service.http.local_owner import LocalOwner
from service.http.operations import request_body
from service.http.uploads import UploadBody
from service.resources.lists import LimitQuery, cut
from service.wire.json_bodies import read_json
from service.wire.moments import Moment
from service.wire.schemas import Name
from store import access_keys
from store.access_keys import SCOPES, Project, Scope
from store.quotas import Quotas
from store.records import DEFAULT_PROJECT, AccessKey

router = APIRouter(tags=["keys"])

EXAMPLE: dict[str, Any] = {
    "id": "key_01m7yspdypmt22jq6npfg62xe5",
    "name": "capture software of room 3",
    "project": "gait",
    "scopes": ["read", "lift"],
    "quotas": Quotas(lifted_frames_per_second=1000).model_dump(),
    "created_at": "2026-03-01T09:30:00Z",
    "expires_at": "2027-03-01T00:00:00Z",
    "revoked_at": None,
}
TOKEN = "fewview_9dXvB2mKq4hWzT7rLs0PfYcE1nJgUaI6oR8tVbN3kQw"  # noqa: S105 (an example)
EXPIRES = "When it ceases to be in force; null: never."


class KeyCreate(BaseModel):
    """A key to make."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "name": "capture software of room 3",
                "project": "gait",
                "scopes": ["read", "lift"],
                "expires_at": "2027-03-01",
            }
        },
    )

    name: Name
    project: Project = DEFAULT_PROJECT
    scopes: list[Scope] = Field(
        min_length=1,
        max_length=len(SCOPES),
        description="What it allows: `read` what is stored; `lift` frames at once; `write`: store, "
        "change, fit, cancel; `delete`; `webhook`: have URLs notified when jobs end; `admin`: keys "
        "and the audit of all projects.",
    )
    expires_at: Moment | None = Field(None, description=EXPIRES)
    quotas: Quotas = Quotas()


class Key(BaseModel):
    """A key. Its token is shown once only, as the key is made."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE})

    id: str
    name: str
    project: str
    scopes: list[Scope]
    quotas: Quotas
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None

    @classmethod
    def of(cls, record: AccessKey, **more: str) -> Self:
        """Return the wire form of a record."""
        return cls.model_validate(
            {
                "id": record.id,
                "name": record.name,
                "project": record.project,
                "scopes": record.scopes,
                "quotas": record.quotas or {},
                "created_at": record.created_at,
                "expires_at": record.expires_at,
                "revoked_at": record.revoked_at,
                **more,
            }
        )


class NewKey(Key):
    """A key that was made just now, with its token."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE | {"token": TOKEN}})

    token: str = Field(description="For `Authorization: Bearer TOKEN`. It cannot be had again.")


class KeyPage(BaseModel):
    """Keys, newest first."""

    model_config = ConfigDict(json_schema_extra={"example": {"items": [EXAMPLE]}})

    items: list[Key]
    next_cursor: str | None = None


@router.post(
    "/keys",
    status_code=status.HTTP_201_CREATED,
    responses=problems(*BODY_PROBLEMS),
    openapi_extra=request_body(KeyCreate),
)
def create_key(upload: UploadBody, store: StoreDep, request: Request, response: Response) -> NewKey:
    """Make a key, for any project. The answer has its token, which is stored nowhere.

    All processes of the API know it within a second.
    """
    asked = read_json(upload, KeyCreate)
    record, token = access_keys.create(
        store,
        name=asked.name,
        project=asked.project,
        scopes=asked.scopes,
        expires_at=None if asked.expires_at is None else asked.expires_at.timestamp(),
        quotas=asked.quotas,
    )
    request.app.state.keyring.look()
    response.headers["Location"] = f"/keys/{record.id}"
    response.headers["Cache-Control"] = "no-store"
    return NewKey.of(record, token=token)


@router.get("/keys", responses=problems())
def list_keys(
    store: StoreDep,
    limit: LimitQuery = 50,
    cursor: Annotated[
        str | None,
        Query(pattern="^key_[0-9a-z]{26}$", description="`next_cursor` of the page before."),
    ] = None,
) -> KeyPage:
    """List the keys of all projects, newest first; those that were revoked, too."""
    page, more = cut(access_keys.page(store, limit=limit + 1, after=cursor), limit)
    return KeyPage(items=[Key.of(record) for record in page], next_cursor=more)


class PageKey(BaseModel):
    """What lets the page in, in a browser of the service's own user."""

    model_config = ConfigDict(json_schema_extra={"example": {"token": TOKEN}})

    token: str = Field(
        description="The page takes it from its address, `/#key=TOKEN`. It holds until the service "
        "stops, and only on connections of the service's own user or of root."
    )


@router.get("/page-key", responses=problems("not_found"))
async def get_page_key(request: Request, response: Response) -> PageKey:
    """Return the key with which a browser of the service's own user may use the page."""
    owner: LocalOwner = request.app.state.local_owner
    if owner.page_key is None:
        raise ApiError(
            "not_found",
            "This service lets nobody in without a key (FEWVIEW_TRUST_LOCAL is false): give the "
            "page one that `fewview key create` prints.",
        )
    response.headers["Cache-Control"] = "no-store"
    return PageKey(token=owner.page_key)


@router.get("/keys/{key_id}", responses=problems("not_found"))
def get_key(key_id: Identifier, store: StoreDep) -> Key:
    """Describe a key."""
    return Key.of(access_keys.get(store, key_id))


@router.delete(
    "/keys/{key_id}", status_code=status.HTTP_204_NO_CONTENT, responses=problems("not_found")
)
def revoke_key(key_id: Identifier, store: StoreDep, request: Request) -> None:
    """Revoke a key: within a second no process accepts it. It stays in the list."""
    access_keys.revoke(store, key_id)
    request.app.state.keyring.look()
