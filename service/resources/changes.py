"""Changing what may be changed of what is stored: mostly its name."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Path
from pydantic import BaseModel, ConfigDict

from service.http.dependencies import StoreDep
from service.http.errors import BODY_PROBLEMS, problems
from service.http.operations import request_body
from service.http.uploads import UploadBody
from service.wire.schemas import Name
from store import lookup
from store.lookup import Resource


class NameChange(BaseModel):
    """What to change; what is left out, or null, stays as it is."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"name": "macaque, second try"}}
    )

    name: Name | None = None

    def columns(self) -> dict[str, Any]:
        """Return the record's columns that change, with what they are to hold."""
        return {} if self.name is None else {"name": self.name}


def add_change_route(
    router: APIRouter,
    kind: type[Resource],
    form: type[BaseModel],
    to_wire: Callable[[Resource], BaseModel],
    change: type[NameChange] = NameChange,
) -> None:
    """Add ``PATCH`` of one resource.

    Parameters
    ----------
    form, to_wire
        The JSON form of a resource, and what makes it of a record.
    change
        What the body may say.
    """
    noun = kind.noun

    @router.patch(
        f"/{{{noun}_id}}",
        name=f"change_{noun}",
        response_model=form,
        description=f"Change a {noun}: {', '.join(f'`{name}`' for name in change.model_fields)}. "
        "What is left out stays as it is.",
        responses=problems(*BODY_PROBLEMS, "not_found"),
        openapi_extra=request_body(change),
    )
    def change_resource(
        identifier: Annotated[str, Path(alias=f"{noun}_id", max_length=200)],
        upload: UploadBody,
        store: StoreDep,
    ) -> Any:
        return to_wire(lookup.change(store, kind, identifier, upload.json(change).columns()))
