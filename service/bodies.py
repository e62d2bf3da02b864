"""Request bodies in the OpenAPI document, where an operation takes several types."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

_REFERENCE = "#/components/schemas/{model}"
_registered: set[type[BaseModel]] = set()


def binary_or_json(
    json: type[BaseModel] | None, *, form: type[BaseModel] | None, binary: str
) -> dict[str, Any]:
    """Return the ``openapi_extra`` of an operation that takes JSON or an array file.

    Parameters
    ----------
    json
        The JSON body; None if the operation takes files only.
    form
        Text fields beside the file in ``multipart/form-data``.
    binary
        What the file holds.
    """
    file = {"type": "string", "format": "binary", "description": binary}
    properties: dict[str, Any] = {"file": file}
    if form is not None:
        fields = form.model_json_schema(ref_template=_REFERENCE)["properties"]
        # A form field is text: what is not a string is written as JSON.
        properties |= {
            name: {
                "type": "string",
                "description": schema.get("description", "")
                + ("" if schema.get("type") == "string" else " As JSON."),
            }
            for name, schema in fields.items()
        }
    content: dict[str, Any] = {}
    if json is not None:
        _registered.add(json)
        content["application/json"] = {"schema": {"$ref": f"#/components/schemas/{json.__name__}"}}
    content["application/octet-stream"] = {"schema": file}
    content["multipart/form-data"] = {
        "schema": {
            "type": "object",
            "title": f"{json.__name__ if json else 'Weights'}Form",
            "required": ["file"],
            "properties": properties,
        }
    }
    return {"requestBody": {"required": True, "content": content}}


def registered_schemas() -> dict[str, Any]:
    """Return the schemas that :func:`binary_or_json` refers to, by name."""
    if not _registered:
        return {}
    _, definitions = models_json_schema(
        [(model, "validation") for model in sorted(_registered, key=lambda m: m.__name__)],
        ref_template=_REFERENCE,
    )
    schemas: dict[str, Any] = definitions["$defs"]
    return schemas
