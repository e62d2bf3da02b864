"""Aliases of models: names such as `walk@production` that can be moved."""

from datetime import UTC, datetime
from typing import Annotated, Any, Self

from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from service.http.dependencies import Identifier, StoreDep
from service.http.errors import BODY_PROBLEMS, invalid, problems
from service.http.operations import request_body
from service.http.uploads import UploadBody
from service.realtime.dependencies import EngineDep
from service.resources.lists import LimitQuery
from service.wire.json_bodies import read_json
from store import aliases, lookup
from store.labels import Text
from store.records import ModelAlias, ModelRecord

router = APIRouter(tags=["models"])

EXAMPLE: dict[str, Any] = {
    "alias": "walk@production",
    "model_id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
    "moved_at": "2026-03-01T09:30:00Z",
}
_ALIAS: TypeAdapter[str] = TypeAdapter(aliases.Alias)


class AliasChange(BaseModel):
    """What an alias is to point to."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"model_id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr"}},
    )

    model_id: Text = Field(max_length=200, description="A model, or another alias of it.")


class Alias(BaseModel):
    """An alias of a model."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE})

    alias: str = Field(description="What may stand wherever an identifier of a model may.")
    model_id: str
    moved_at: datetime

    @classmethod
    def of(cls, record: ModelAlias) -> Self:
        """Return the wire form of a record."""
        return cls(
            alias=record.name,
            model_id=record.model_id,
            moved_at=datetime.fromtimestamp(record.moved_at, UTC),
        )


class AliasPage(BaseModel):
    """Aliases, by their names."""

    model_config = ConfigDict(json_schema_extra={"example": {"items": [EXAMPLE]}})

    items: list[Alias]
    next_cursor: str | None = None


@router.get("/aliases", responses=problems())
def list_aliases(
    store: StoreDep,
    model_id: Annotated[str | None, Query(max_length=200, description="Of this model.")] = None,
    limit: LimitQuery = 50,
    cursor: Annotated[
        str | None, Query(max_length=200, description="`next_cursor` of the page before.")
    ] = None,
) -> AliasPage:
    """List the aliases of models, by their names."""
    found = aliases.page(store, limit=limit + 1, after=cursor, model_id=model_id)
    more = found[limit - 1].name if len(found) > limit else None
    return AliasPage(items=[Alias.of(record) for record in found[:limit]], next_cursor=more)


@router.put(
    "/models/{model_id}",
    responses=problems(*BODY_PROBLEMS, "not_found"),
    openapi_extra=request_body(AliasChange),
)
def set_alias(
    model_id: Identifier, upload: UploadBody, store: StoreDep, engine: EngineDep
) -> Alias:
    """Have an alias, `PUT /models/walk@production`, point to a model, whatever it pointed to.

    An alias may stand wherever an identifier of a model may: in paths, lifts, streams, and in what
    fits and lifts of datasets are asked for, whose records keep the model that it pointed to then.
    It is moved in one step: every request gets either the old model or the new one, and within a
    second all processes use the new one. Streams that are open go on with the model that they
    began with. `DELETE /models/walk@production` deletes the alias and leaves the model.
    """
    try:
        name = _ALIAS.validate_python(model_id)
    except ValidationError:
        lookup.get(store, ModelRecord, model_id)  # or 404: there may be no such model
        raise invalid(
            "/model_id",
            f"expected an alias such as walk@production, of a-z, 0-9, '.', '_' and '-'; "
            f"got {model_id!r}",
        ) from None
    record = aliases.put(store, name, read_json(upload, AliasChange).model_id)
    engine.models.look()
    return Alias.of(record)
