"""Storage: what is stored, how much space it takes, and how much a key has left."""

from typing import Annotated, Literal, Self

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

from service.http.dependencies import StoreDep
from service.http.errors import problems
from service.http.keyring import caller_of
from service.resources.lists import MOST_LISTED
from store.usage import Kept, usage

router = APIRouter(prefix="/storage", tags=["health"])

StoredKindName = TypeAliasType("StoredKindName", Literal["datasets", "fits", "lifts", "models"])
KeptKindName = TypeAliasType(
    "KeptKindName",
    Literal[
        "datasets",
        "fits",
        "lifts",
        "models",
        "aliases",
        "webhooks",
        "deliveries",
        "idempotency_keys",
        "audit",
    ],
)


class StoredKind(BaseModel):
    """How many there are of a kind, and what they take."""

    kind: KeptKindName = Field(
        description="What can be deleted, or goes by itself: `deliveries` to webhooks a week after "
        "they ended, `idempotency_keys` after a day, `audit` when the service has kept it for as "
        "long as it is set to."
    )
    count: int
    stored_bytes: int = Field(description="Of their records and their objects.")

    @classmethod
    def listed(cls, account: dict[str, Kept]) -> list[Self]:
        """Return all kinds of an account."""
        return [
            cls.model_validate({"kind": kind, "count": kept.records, "stored_bytes": kept.size})
            for kind, kept in account.items()
        ]


class StoredItem(BaseModel):
    """Something stored."""

    kind: StoredKindName
    id: str
    name: str
    stored_bytes: int


class Storage(BaseModel):
    """What is stored of a project."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "stored_bytes": 5120000,
                "items": [{"kind": "datasets", "count": 2, "stored_bytes": 5120000}],
                "largest": [
                    {
                        "kind": "datasets",
                        "id": "ds_01m7yspdypmt22jq6npfg62xe5",
                        "name": "macaque, morning session",
                        "stored_bytes": 4096000,
                    }
                ],
                "own_bytes": 4096000,
                "own": [{"kind": "datasets", "count": 1, "stored_bytes": 4096000}],
                "quota_bytes": 10000000,
            }
        }
    )

    stored_bytes: int = Field(description="Of all kinds.")
    items: list[StoredKind]
    largest: list[StoredItem] = Field(description="The largest of all kinds, those first.")
    own_bytes: int = Field(description="Of what was made with the key that asks.")
    own: list[StoredKind] = Field(description="The same by kind: what counts for its quota.")
    quota_bytes: int | None = Field(description="What that key may store; null: there is no bound.")


@router.get("", responses=problems())
def get_storage(
    store: StoreDep,
    request: Request,
    limit: Annotated[
        int, Query(ge=1, le=MOST_LISTED, description="How many of the largest are named.")
    ] = 20,
) -> Storage:
    """Return what is stored of the project and how much space it takes, records included.

    Of what older versions stored before bytes were counted, reconstructions and results of lifts
    count as 0.
    """
    found = usage(store, limit)
    return Storage(
        stored_bytes=sum(kept.size for kept in found.project.values()),
        items=StoredKind.listed(found.project),
        largest=[StoredItem.model_validate(item._asdict()) for item in found.largest],
        own_bytes=sum(kept.size for kept in found.own.values()),
        own=StoredKind.listed(found.own),
        quota_bytes=caller_of(request).author.quotas.stored_bytes,
    )
