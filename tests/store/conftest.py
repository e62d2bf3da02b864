from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from store.capture import Capture
from store.database import Store
from store.settings import StoreSettings
from tests.deployments import KINDS, deployed


@pytest.fixture(params=KINDS)
def deployment(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[dict[str, Any]]:
    """Give the settings of a new deployment, of each kind."""
    with deployed(request, tmp_path) as settings:
        yield settings


@pytest.fixture
def settings(deployment: dict[str, Any]) -> StoreSettings:
    return StoreSettings(**deployment)


@pytest.fixture
def store(settings: StoreSettings) -> Iterator[Store]:
    store = Store(settings)
    yield store
    store.close()


@pytest.fixture
def capture() -> Capture:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 1000, (12, 2, 5, 2)).astype(np.float32)
    keypoints[3, 1] = np.nan
    keypoints[4, 0, 2] = np.nan
    return Capture.checked(keypoints)
