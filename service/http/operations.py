"""Parts of the OpenAPI document on operations that FastAPI cannot derive from the code."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from service.http.negotiation import OCTETS

_REFERENCE = "#/components/schemas/{model}"
_registered: set[type[BaseModel]] = set()
_forms: dict[str, Any] = {}


def request_body(
    json: type[BaseModel] | None = None,
    *,
    form: type[BaseModel] | None = None,
    binary: str | None = None,
    files: str | None = None,
    folders: str | None = None,
) -> dict[str, Any]:
    """Return the ``openapi_extra`` of an operation that reads its body itself.

    Parameters
    ----------
    json
        The JSON body, if it takes one.
    form
        Text fields beside the file in ``multipart/form-data``.
    binary
        What the file holds, if it takes one.
    files
        What other files may come in its place in a form, if they may.
    folders
        What a zip in place of these may hold, if there may be one.
    """
    content: dict[str, Any] = {}
    if json is not None:
        _registered.add(json)
        content["application/json"] = {"schema": {"$ref": _REFERENCE.format(model=json.__name__)}}
    bytes_of_file = {"type": "string", "format": "binary"}
    properties: dict[str, Any] = {}
    if binary is not None:
        properties["file"] = bytes_of_file | {"description": binary}
        content["application/octet-stream"] = {"schema": properties["file"]}
    if files is not None:
        properties["files"] = {"type": "array", "items": bytes_of_file, "description": files}
    if folders is not None:
        properties["folders"] = bytes_of_file | {"description": folders}
    if properties:
        name = f"{(json or form or BaseModel).__name__}Form".replace("FormForm", "Form")
        required = list(properties) if len(properties) == 1 else []
        properties = {**properties, **_form_fields(form)}
        # The order in which a document that is committed lists them.
        _forms[name] = {"type": "object", "title": name, "properties": properties}
        if required:
            _forms[name]["required"] = required
        content["multipart/form-data"] = {"schema": {"$ref": _REFERENCE.format(model=name)}}
    return {"requestBody": {"required": True, "content": content}}


def _form_fields(form: type[BaseModel] | None) -> dict[str, Any]:
    """Return the text fields of a form: what is neither text nor a number is written as JSON."""
    if form is None:
        return {}
    fields = form.model_json_schema(ref_template=_REFERENCE)["properties"]
    return {
        name: {
            "type": "string",
            "description": schema.get("description", "")
            + ("" if schema.get("type") == "string" else " As JSON."),
        }
        for name, schema in fields.items()
    }


# The response to a client that has what it asks for (RFC 9110, 13.1.2).
UNCHANGED: dict[int | str, dict[str, Any]] = {
    304: {"description": "It is still what `If-None-Match` names."}
}


def binary_responses(description: str, *media_types: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI response of an operation that also answers with bytes of these types."""
    file = {"schema": {"type": "string", "format": "binary"}}
    return {200: {"description": description, "content": dict.fromkeys(media_types, file)}}


def file_responses(description: str, *media_types: str) -> dict[int | str, dict[str, Any]]:
    """Return those of a download, whole, in part or unchanged (RFC 9110, 13 and 14)."""
    # Clients are generated only for types that they know. To all of them a part is bytes.
    part = binary_responses("The bytes that `Range` names.", *media_types, OCTETS)[200]
    return binary_responses(description, *media_types) | {206: part} | UNCHANGED


def register(*models: type[BaseModel]) -> None:
    """Have the OpenAPI document describe models that no operation refers to."""
    _registered.update(models)


def registered_schemas() -> dict[str, Any]:
    """Return the schemas that were registered, by name."""
    _, definitions = models_json_schema(
        [(model, "validation") for model in sorted(_registered, key=lambda m: m.__name__)],
        ref_template=_REFERENCE,
    )
    schemas: dict[str, Any] = definitions["$defs"]
    return schemas | dict(sorted(_forms.items()))
