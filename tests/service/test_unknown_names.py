"""Parameters and fields that nobody knows are refused, with the one that may be meant."""

from typing import Any

import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from tests.service.conftest import problem

pytestmark = pytest.mark.usefixtures("unchanged")


@pytest.mark.parametrize(
    ("method", "url", "pointer", "message"),
    [
        ("GET", "/datasets?limt=5", "/limt", "did you mean 'limit'?"),
        ("GET", "/fits?colour=red", "/colour", "expected some of"),
        ("GET", "/fits?limit=2&datset_id=x", "/datset_id", "did you mean 'dataset_id'?"),
        ("GET", "/fits/fit_none?a=1", "/a", "there are none here"),
        ("GET", "/lifts/lift_none/result?fromat=npz", "/fromat", "did you mean 'format'?"),
        ("GET", "/fits/fit_none/events?follow", "/follow", "there are none here"),
        ("GET", "/health/live?a/b~c=", "/a~1b~0c", "there are none here"),
        ("POST", "/lift?modle=x", "/modle", "did you mean 'model'?"),
        ("POST", "/datasets?nam=x", "/nam", "did you mean 'name'?"),
        ("DELETE", "/models/mdl_none?force=1", "/force", "there are none here"),
        ("GET", "/lift/stream?model=mdl_x", "/model", "there are none here"),
        ("GET", f"/datasets?{'x' * 5000}=1", f"/{'x' * 5000}", "expected some of"),
    ],
)
def test_unknown_query_parameters(
    api: TestClient, method: str, url: str, pointer: str, message: str
) -> None:
    assert message in problem(api.request(method, url), 422, "invalid_input", pointer)


def test_unknown_query_parameters_of_a_stream(api: TestClient) -> None:
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        api.websocket_connect("/lift/stream?model=mdl_x"),
    ):
        pass
    problem(refused.value, 422, "invalid_input", "/model")


def test_pages_of_documentation_take_any_query(api: TestClient) -> None:
    for url in ("/docs?a=1", "/openapi.json?v=2"):
        assert api.get(url).status_code == 200


@pytest.mark.parametrize(
    ("url", "body", "pointer", "meant"),
    [
        ("/datasets", {"keypoint": []}, "/keypoint", "keypoints"),
        ("/datasets", {"skeleton": {"edgess": []}}, "/skeleton/edgess", "edges"),
        ("/fits", {"config": {"stepz": 5}}, "/config/stepz", "steps"),
        (
            "/fits",
            {"config": {"calibration": [None, {"intrinsics": {"f_x": 1}}]}},
            "/config/calibration/1/intrinsics/f_x",
            "fx",
        ),
        ("/lifts", {"datasetid": "ds"}, "/datasetid", "dataset_id"),
        ("/lift", {"model": "mdl", "fraames": []}, "/fraames", "frames"),
    ],
)
def test_unknown_fields(
    api: TestClient, url: str, body: dict[str, Any], pointer: str, meant: str
) -> None:
    response = api.post(url, json=body)
    problem(response, 422, "invalid_input", pointer)
    details = {item["pointer"]: item["detail"] for item in response.json()["errors"]}
    assert details[pointer] == f"unknown field: did you mean {meant!r}?"


def test_more_mistakes_than_anybody_reads(api: TestClient) -> None:
    response = api.post("/fits", json=dict.fromkeys(map(str, range(10_000))))
    problem(response, 422, "invalid_input")
    assert len(response.json()["errors"]) == 50
    problem(api.get("/fits?" + "&".join(f"a{n}" for n in range(5000))), 422, "invalid_input")


@pytest.mark.parametrize(
    ("url", "body", "pointer"),
    [
        ("/fits", {"dataset_id": "ds_1", "config": {"cameras_alike": 5}}, "/config/cameras_alike"),
        ("/lifts", {"model_id": "m", "dataset_id": "d", "frame": "room", "up": [0, 0, 0]}, "/up"),
        ("/lifts", {"model_id": "m", "dataset_id": "d", "frame": "room", "up": [0, "x"]}, "/up"),
    ],
)
def test_what_may_be_one_of_two_kinds_is_refused_once(
    api: TestClient, url: str, body: dict[str, Any], pointer: str
) -> None:
    refused = api.post(url, json=body)
    problem(refused, 422, "invalid_input", pointer)
    assert len(refused.json()["errors"]) == 1
