"""Damaged objects are reported as such, and never lifted or served."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from store.records import ModelRecord
from tests.damage import HARMS, flip, truncate
from tests.service.conftest import (
    BYTES,
    JSON,
    frames_of,
    make_dataset,
    problem,
    served,
    to_safetensors,
)

Harm = Callable[[Path], None]


def only_file(settings: Settings, folder: str) -> Path:
    (file,) = (settings.data_dir / "objects" / folder).iterdir()
    return file


@pytest.mark.parametrize("harm", HARMS)
def test_a_damaged_capture_is_not_served(api: TestClient, settings: Settings, harm: Harm) -> None:
    dataset = make_dataset(api, frames=30)["id"]
    harm(only_file(settings, f"datasets/{dataset}"))
    message = problem(api.get(f"/datasets/{dataset}/capture"), 500, "object_damaged")
    assert f"datasets/{dataset}/chunk_" in message
    assert "backup" in message
    assert api.get(f"/datasets/{dataset}").status_code == 200
    assert api.delete(f"/datasets/{dataset}").status_code == 204
    problem(api.get(f"/datasets/{dataset}/capture"), 404, "not_found")


def test_a_range_of_a_damaged_capture_is_not_served_either(
    api: TestClient, settings: Settings
) -> None:
    dataset = make_dataset(api, frames=30)["id"]
    flip(only_file(settings, f"datasets/{dataset}"))
    part = api.get(f"/datasets/{dataset}/capture", headers={"Range": "bytes=300-400"})
    problem(part, 500, "object_damaged")


@pytest.mark.parametrize("harm", HARMS)
def test_damage_after_a_read_is_noticed_at_the_next(
    api: TestClient, settings: Settings, weights: bytes, harm: Harm
) -> None:
    dataset = make_dataset(api, frames=30)["id"]
    model = api.post("/models", content=weights, headers=BYTES).json()["id"]
    capture = f"/datasets/{dataset}/capture"
    asked = [(capture, {}), (capture, {"Range": "bytes=300-400"}), (f"/models/{model}/weights", {})]
    assert [api.get(url, headers=more).status_code for url, more in asked] == [200, 206, 200]
    harm(only_file(settings, f"datasets/{dataset}"))
    harm(only_file(settings, f"models/{model}"))
    for url, more in asked:
        problem(api.get(url, headers=more), 500, "object_damaged")


@pytest.mark.parametrize("harm", HARMS)
def test_damaged_weights_lift_nothing(
    api: TestClient, settings: Settings, weights: bytes, capture: SyntheticCapture, harm: Harm
) -> None:
    model = api.post("/models?name=damaged", content=weights, headers=BYTES).json()["id"]
    harm(only_file(settings, f"models/{model}"))
    body: dict[str, Any] = {"model": model, "frames": frames_of(capture.keypoints[:1])}
    problem(api.post("/lift", json=body, headers=JSON), 500, "object_damaged")
    problem(api.get(f"/models/{model}/weights"), 500, "object_damaged")
    assert api.get("/health/live").status_code == 200


def test_weights_that_an_older_version_stored_are_checked_too(
    api: TestClient, settings: Settings, weights: bytes
) -> None:
    model = api.post("/models?name=old", content=weights, headers=BYTES).json()["id"]
    file = only_file(settings, f"models/{model}")
    file = file.rename(file.with_name("weights.safetensors"))
    store = api.app.state.store  # type: ignore[attr-defined]
    with store.writing() as session:
        session.get(ModelRecord, model).weights_key = f"models/{model}/weights.safetensors"
    assert api.get(f"/models/{model}/weights").status_code == 200
    truncate(file)
    problem(api.get(f"/models/{model}/weights"), 500, "object_damaged")


def test_a_download_that_meets_damage_breaks_off(
    api: TestClient, settings: Settings, capture: SyntheticCapture
) -> None:
    body = to_safetensors(keypoints=np.tile(capture.keypoints, (4, 1, 1, 1))[:240])
    dataset = api.post("/datasets?name=long", content=body, headers=BYTES).json()["id"]
    (first,) = (settings.data_dir / "objects" / "datasets" / dataset).iterdir()
    added = api.post(f"/datasets/{dataset}/frames", content=body, headers=BYTES)
    assert added.status_code < 300, added.text
    (second,) = set(first.parent.iterdir()) - {first}
    flip(second)
    with served(settings) as http, pytest.raises(httpx2.RemoteProtocolError):
        http.get(f"/datasets/{dataset}/capture")
