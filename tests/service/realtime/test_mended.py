"""A model undoes what its fit undid, in every lift of the same cameras."""

import httpx2
import numpy as np
import orjson
import pytest
from safetensors.numpy import load
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from models.causes.cause import Cause
from models.causes.pixel_map import PixelMap
from models.lifting.fitted_prior import FittedPrior
from tests.service.conftest import BYTES, JSON, Live, frames_of, job_events, to_safetensors
from tests.service.realtime.conftest import as_bytes, read_bytes, started

CORNER = (560.0, 180.0)
CROP = Cause("cropped", 1, {"x": 560}, {"x": 3}, 50.0, PixelMap(c=CORNER[0], f=CORNER[1]))


@pytest.fixture(scope="module")
def mending(api: TestClient, weights: bytes) -> str:
    prior = FittedPrior.from_bytes(weights).mending((CROP,))
    response = api.post("/models?name=cropped", content=prior.to_bytes(), headers=BYTES)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def test_lifts_of_cropped_keypoints_are_those_of_whole_images(
    api: TestClient, model: str, mending: str, capture: SyntheticCapture
) -> None:
    whole = capture.keypoints[:6].astype(np.float32)
    cropped = whole.copy()
    cropped[:, 1] -= np.array(CORNER, np.float32)

    def lifted(of: str, keypoints: np.ndarray, **more: object) -> np.ndarray:
        body = {"model": of, "frames": frames_of(keypoints), **more}
        response = api.post("/lift", content=orjson.dumps(body), headers=JSON)
        assert response.status_code == 200, response.text
        return np.array([frame["points3d"] for frame in response.json()["frames"]])

    np.testing.assert_allclose(lifted(mending, cropped), lifted(model, whole), atol=1e-3)
    assert np.abs(lifted(model, cropped) - lifted(model, whole)).max() > 0.01
    # The view is known by its number, wherever it stands.
    turned = lifted(mending, cropped[:, [2, 1]], views=[2, 1])
    np.testing.assert_allclose(turned, lifted(model, whole[:, [2, 1]], views=[2, 1]), atol=1e-3)


def test_streams_undo_it_frame_by_frame(
    http: httpx2.Client, model: str, mending: str, capture: SyntheticCapture
) -> None:
    whole = capture.keypoints[20].astype(np.float32)
    cropped = whole.copy()
    cropped[1] -= np.array(CORNER, np.float32)
    answers = []
    for of, keypoints in ((mending, cropped), (model, whole)):
        with started(http, of) as socket:
            socket.send(as_bytes(0, keypoints))
            answers.append(read_bytes(socket.recv(timeout=300)).points)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-3)


def test_jobs_undo_it(live: Live, weights: bytes, capture: SyntheticCapture) -> None:
    whole = capture.keypoints[:6].astype(np.float32)
    cropped = whole.copy()
    cropped[:, 1] -= np.array(CORNER, np.float32)
    prior = FittedPrior.from_bytes(weights)
    made = live.http.post("/models", content=prior.mending((CROP,)).to_bytes(), headers=BYTES)
    data = live.http.post("/datasets", content=to_safetensors(keypoints=cropped), headers=BYTES)
    asked = {"model_id": made.json()["id"], "dataset_id": data.json()["id"]}
    lift = live.http.post("/lifts", json=asked)
    assert lift.status_code == 202, lift.text
    url = f"/lifts/{lift.json()['id']}"
    list(job_events(live, url))  # until it has ended
    found = load(live.http.get(f"{url}/result?format=safetensors").content)
    np.testing.assert_allclose(found["points3d"], prior.lift(whole).points3d, atol=1e-3)
