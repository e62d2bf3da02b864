"""No field of a request is without bounds, in the document or by a rule of its own."""

from collections.abc import Iterator
from typing import Any

import orjson
import pytest
from starlette.testclient import TestClient

from store.labels import MAX_METADATA
from tests.service.conftest import problem

BOUNDS = {"maxLength", "pattern", "enum", "const"}
FORMATS = {"binary", "date-time", "uri"}
# Frames, views and keypoints are counted against the limits of the settings before anything is
# made of them.
OF_CAPTURES = {"frames", "keypoints", "confidence", "points3d", "times", "points", "truth", "files"}
# 64 KiB of JSON; in a query, keys and values of a bounded length.
OF_METADATA = {"metadata"}
# Texts of a form are read as the fields of the JSON body are, and bounded as these.
FORMS = {"DatasetCreateForm", "ModelImportForm", "CalibrationForm"}


def unbounded(document: dict[str, Any]) -> Iterator[str]:
    """Yield the fields of requests that the document gives no bound."""
    seen: set[str] = set()

    def walk(schema: dict[str, Any], where: str) -> Iterator[str]:
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            if name not in seen:
                seen.add(name)
                yield from walk(document["components"]["schemas"][name], name)
            return
        for several in ("anyOf", "oneOf", "allOf", "prefixItems"):
            for part in schema.get(several, []):
                yield from walk(part, where)
        kind = schema.get("type")
        free = schema.get("additionalProperties") not in (None, False) or not schema.get(
            "properties"
        )
        if (
            (
                kind == "string"
                and not BOUNDS & schema.keys()
                and schema.get("format") not in FORMATS
            )
            or (kind == "array" and "maxItems" not in schema)
            or (kind == "object" and free)
        ):
            yield where
        for name, part in schema.get("properties", {}).items():
            yield from walk(part, f"{where}/{name}")
        if "items" in schema:
            yield from walk(schema["items"], where)

    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for parameter in operation.get("parameters", []):
                yield from walk(parameter["schema"], f"{method} {path}/{parameter['name']}")
            for body in operation.get("requestBody", {}).get("content", {}).values():
                yield from walk(body["schema"], f"{method} {path}")


def test_every_field_of_a_request_is_bounded(api: TestClient) -> None:
    found = set(unbounded(api.get("/openapi.json").json()))
    assert found, "fields of captures have no bound in the document"
    others = {
        where
        for where in found
        if where.rpartition("/")[2] not in OF_CAPTURES | OF_METADATA
        and where.partition("/")[0] not in FORMS
    }
    assert others == set()


@pytest.mark.usefixtures("unchanged")
@pytest.mark.parametrize(
    ("field", "text"),
    [
        ("name", "a" * 201),
        ("tags", orjson.dumps(["a" * 65]).decode()),
        ("tags", orjson.dumps([str(n) for n in range(33)]).decode()),
        ("metadata", orjson.dumps({"a": "b" * MAX_METADATA}).decode()),
        ("skeleton", orjson.dumps({"keypoint_names": ["a" * 201] * 16}).decode()),
        ("view_names", orjson.dumps(["a" * 201, "b"]).decode()),
    ],
)
def test_texts_of_a_form_are_bounded_as_those_of_json(
    api: TestClient, field: str, text: str
) -> None:
    files = {"files": ("a.csv", b"frame,nose_x,nose_y\n0,1,2\n")}
    answer = api.post("/datasets", data={field: text}, files=files)
    assert answer.status_code == 422, answer.text
    assert field in problem(answer, 422, "invalid_input")
