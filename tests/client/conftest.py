"""The client against a served process, shared by the tests of a test process."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from fewview import Capture, Client
from fewview.api.forms import Dataset, Fit

from models.capture.synthetic import synthetic_capture
from tests.service.conftest import CONFIG, Live, kill_service, start_service

JOINTS = [f"{side}_{joint}" for joint in ("shoulder", "hip", "knee", "ankle") for side in "lr"]


@dataclass(frozen=True)
class Served:
    """A service with a dataset and a fit of it that has succeeded."""

    live: Live
    client: Client
    capture: Capture
    dataset: Dataset
    fit: Fit

    @property
    def model(self) -> str:
        assert self.fit.model_id is not None
        return self.fit.model_id


def a_capture(frames: int = 60, seed: int = 5) -> Capture:
    seen = synthetic_capture(frames=frames, views=3, noise=1.0, hidden_keypoints=0.08, seed=seed)
    return Capture(
        seen.keypoints.astype(np.float32),
        confidence=seen.confidence.astype(np.float32),
        image_sizes=((1280, 1024), None, (1280, 1024)),
        keypoint_names=(*JOINTS, *(f"k{index}" for index in range(8, seen.keypoints.shape[2]))),
    )


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    live = start_service(tmp_path_factory.mktemp("client"), "--lift-chunk-frames=16")
    try:
        with Client(live.url, timeout=300) as client:
            capture = a_capture()
            dataset = client.datasets.create(capture, name="figure", metadata={"subject": "M7"})
            fit = client.fits.wait(client.fits.create(dataset, **CONFIG))
            yield Served(live, client, capture, dataset, fit)
    finally:
        kill_service(live)
