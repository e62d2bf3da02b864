"""A model undoes what its fit undid, in every lift of the same cameras."""

import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from models.causes.cause import Cause
from models.causes.pixel_map import PixelMap
from models.lifting.fitted_prior import FittedPrior
from tests.service.conftest import BYTES, JSON, frames_of

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
