"""Changing names, tags and metadata of stored resources, and what else a kind of them allows."""

from collections.abc import Callable
from typing import Annotated, Any, ClassVar

from fastapi import APIRouter, Path, Response
from pydantic import BaseModel, ConfigDict, Field

from service.http.dependencies import StoreDep
from service.http.errors import BODY_PROBLEMS, problems
from service.http.operations import request_body
from service.http.preconditions import etag_of
from service.http.uploads import UploadBody
from service.wire.json_bodies import read_json
from service.wire.schemas import Name
from store import lookup
from store.labels import METADATA, TAGS, Metadata, Tags
from store.lookup import Resource

LABELS = ("name", "tags", "metadata")


class Change(BaseModel):
    """What to change; what is left out, or null, stays as it is."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {"name": "macaque, second try", "tags": ["pilot"], "metadata": {"day": 2}}
        },
    )

    emptied: ClassVar = ", which null removes"  # what null does with fields that are no labels
    codes: ClassVar[tuple[str, ...]] = ()  # of the problems that `check` ends in

    name: Name | None = None
    tags: Tags | None = Field(None, description=f"They replace the present ones. {TAGS}")
    metadata: Metadata | None = Field(None, description=f"It replaces the present one. {METADATA}")

    def columns(self) -> dict[str, Any]:
        """Return the record's columns that change, with their new values."""
        given = {"name": self.name, "tags": self.tags, "user_metadata": self.metadata}
        return {column: value for column, value in given.items() if value is not None}

    def check(self, record: Any) -> None:
        """Raise ``ApiError`` for what this record cannot be changed to; labels suit every one."""


# What changes columns of a record, and returns it, as `store.lookup.change` does.
Write = Callable[[Any, Any, str, dict[str, Any]], Any]


def add_change_route(
    router: APIRouter,
    kind: type[Resource],
    form: type[BaseModel],
    to_wire: Callable[[Resource], BaseModel],
    *,
    change: type[Change] = Change,
    write: Write = lookup.change,
) -> None:
    """Add ``PATCH`` of one resource.

    Parameters
    ----------
    form, to_wire
        The JSON form of a resource, and what makes it of a record.
    change, write
        The JSON form of what can be changed, and what does so.
    """
    noun = kind.noun
    others = [name for name in change.model_fields if name not in LABELS]
    named = ", ".join(f"`{name}`" for name in others)
    more = f" And {named}{change.emptied}." * bool(others)

    @router.patch(
        f"/{{{noun}_id}}",
        name=f"change_{noun}",
        response_model=form,
        description=f"Change the labels of a {noun}: `name`, `tags`, `metadata`. Fields that are "
        f"left out stay as they are.{more}",
        responses=problems(*BODY_PROBLEMS, "not_found", *change.codes),
        openapi_extra=request_body(change),
    )
    def change_resource(
        identifier: Annotated[str, Path(alias=f"{noun}_id", max_length=200)],
        upload: UploadBody,
        store: StoreDep,
        response: Response,
    ) -> Any:
        asked = read_json(upload, change)
        asked.check(lookup.get(store, kind, identifier))
        changed = write(store, kind, identifier, asked.columns())
        response.headers["ETag"] = etag_of(changed)
        return to_wire(changed)
