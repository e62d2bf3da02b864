"""Another prior than the default goes the whole way over HTTP."""

from typing import Any, get_args

import numpy as np
import orjson
import pytest
from fastapi.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from models.lifting.fitted_prior import FittedPrior
from models.network.priors.registry import make_prior
from models.settings.config import WARM_STEPS, FitConfig
from models.settings.priors import PriorName
from tests.service.conftest import JSON, Live, frames_of, make_dataset, problem

SIZES = {"width": 24, "blocks": 1, "code": 6}
BYTES = {"Content-Type": "application/octet-stream"}


def test_a_model_is_fitted_lifted_with_and_imported_again(
    live: Live, capture: SyntheticCapture
) -> None:
    dataset = make_dataset(live.http, frames=20)
    config = {"prior": "mlp", "mlp": SIZES, "steps": 30, "batch_size": 16}
    body = {"dataset_id": dataset["id"], "name": "mlp", "config": config}
    made = live.http.post("/fits", json=body)
    assert made.status_code == 202, made.text
    assert made.json()["config"]["mlp"] == SIZES | {"decoder": "mlp"}
    assert made.json()["config"]["learning_rate"] == 2e-3
    fit = live.finished(made.json()["id"])
    assert fit["status"] == "succeeded", fit["error"]

    first = f"/models/{fit['model_id']}"
    weights = live.http.get(f"{first}/weights").content
    imported = live.http.post("/models", content=weights, headers=BYTES).json()
    assert imported["config"] == live.get(first)["config"]
    frames = frames_of(capture.keypoints[:2])
    lifts = []
    for model in (fit["model_id"], imported["id"]):
        body = {"model": model, "frames": frames}
        lifts.append(live.http.post("/lift", content=orjson.dumps(body), headers=JSON).json())
    assert lifts[0]["frames"] == lifts[1]["frames"]
    expected = FittedPrior.from_bytes(weights).lift(capture.keypoints[:2]).points3d
    found = np.array([frame["points3d"] for frame in lifts[0]["frames"]])
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.fixture
def mlp_model(api: TestClient) -> str:
    config = FitConfig.model_validate({"prior": "mlp", "mlp": SIZES})
    network = make_prior(config, keypoints=16)
    network.initialise(0)
    weights = {name: value.detach() for name, value in network.named_parameters()}
    data = FittedPrior(config, weights, (), 0.1).to_bytes()
    identifier: str = api.post("/models", content=data, headers=BYTES).json()["id"]
    return identifier


def test_a_fit_takes_the_prior_of_the_model_it_starts_from(api: TestClient, mlp_model: str) -> None:
    body = {"dataset_id": make_dataset(api)["id"], "from_model": mlp_model}
    config = api.post("/fits", json=body).json()["config"]
    assert (config["prior"], config["steps"]) == ("mlp", WARM_STEPS)
    assert config["mlp"] == SIZES | {"decoder": "mlp"}
    assert config["learning_rate"] == 2e-3


@pytest.mark.parametrize(
    ("config", "pointer"),
    [
        ({"prior": "hierarchical"}, "/config/prior"),
        ({"prior": "mlp", "mlp": SIZES | {"width": 32}}, "/config/mlp"),
        ({"dictionary_sizes": [16, 8]}, "/config/dictionary_sizes"),
    ],
)
def test_a_fit_with_another_prior_than_its_model_is_refused(
    api: TestClient, mlp_model: str, config: dict[str, Any], pointer: str
) -> None:
    body = {"dataset_id": make_dataset(api)["id"], "from_model": mlp_model, "config": config}
    problem(api.post("/fits", json=body), 422, "invalid_input", pointer)


@pytest.mark.parametrize(
    ("config", "pointer", "fix"),
    [
        ({"prior": "transformer"}, "/config/prior", f"or {get_args(PriorName.__value__)[-1]!r}"),
        ({"prior": "mlp", "mlp": {"width": 2}}, "/config/mlp/width", "greater than or equal to 4"),
        ({"prior": "mlp", "mlp": {"depth": 2}}, "/config/mlp/depth", ""),
        ({"mlp": SIZES}, "/config", "set prior to 'mlp'"),
        ({"prior": "mlp", "dictionary_sizes": [8]}, "/config", "leave dictionary_sizes out"),
    ],
)
def test_bad_sizes_name_their_field(
    api: TestClient, config: dict[str, Any], pointer: str, fix: str
) -> None:
    body = {"dataset_id": make_dataset(api)["id"], "config": config}
    assert fix in problem(api.post("/fits", json=body), 422, "invalid_input", pointer)
