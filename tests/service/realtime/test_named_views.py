"""Which views of a fit the frames of a lift show: what is wrong with them is named."""

from typing import Any

import orjson
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from tests.service.conftest import BYTES, JSON, frames_of, problem, to_npz


@pytest.mark.parametrize(
    ("more", "pointer", "message"),
    [
        ({"views": [0]}, "/views", "expected one index per view: 2, got 1"),
        ({"views": [1, 1]}, "/views", "expected different views"),
        ({"views": []}, "/views", "one index per view"),
        ({"views": [0, -1]}, "/views/1", "greater than or equal to 0"),
        ({"views": [0, 1.5]}, "/views/1", "integer"),
        ({"views": [0, "one"]}, "/views/1", "integer"),
        ({"views": [0, 2**62]}, "/views", "views of the fit, 0 to 2"),
        ({"refine": "some"}, "/refine", "'auto', 'off' or 'full'"),
    ],
)
def test_what_is_wrong_with_views_and_refine_is_named(
    api: TestClient,
    model: str,
    capture: SyntheticCapture,
    more: dict[str, Any],
    pointer: str,
    message: str,
) -> None:
    keypoints = capture.keypoints[:2, :2]
    body = orjson.dumps({"model": model, "frames": frames_of(keypoints), **more})
    response = api.post("/lift", content=body, headers=JSON)
    assert message in problem(response, 422, "invalid_input", pointer)
    if more.get("views") != []:  # a query cannot say an empty list
        response = api.post(
            "/lift",
            params={"model": model, **more},
            content=to_npz(frames=keypoints),
            headers=BYTES,
        )
        assert message in problem(response, 422, "invalid_input", pointer)


@pytest.mark.parametrize("views", [1, "0,1", {"0": 1}, [[0], [1]], [0, None], True])
def test_views_are_a_list_of_numbers(
    api: TestClient, model: str, capture: SyntheticCapture, views: Any
) -> None:
    body = {"model": model, "frames": frames_of(capture.keypoints[:2, :2]), "views": views}
    response = api.post("/lift", content=orjson.dumps(body), headers=JSON)
    problem(response, 422, "invalid_input")
    assert response.json()["errors"][0]["pointer"].startswith("/views")


def test_views_must_be_the_fits(api: TestClient, model: str, capture: SyntheticCapture) -> None:
    body = orjson.dumps(
        {"model": model, "frames": frames_of(capture.keypoints[:2, :2]), "views": [0, 3]}
    )
    response = api.post("/lift", content=body, headers=JSON)
    detail = problem(response, 422, "invalid_input", "/views")
    assert "views of the fit, 0 to 2, got 3" in detail
