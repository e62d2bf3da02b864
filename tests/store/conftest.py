from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from store.capture import Capture
from store.database import Store
from store.settings import StoreSettings


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(StoreSettings(data_dir=tmp_path))
    yield store
    store.close()


@pytest.fixture
def capture() -> Capture:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 1000, (12, 2, 5, 2)).astype(np.float32)
    keypoints[3, 1] = np.nan
    keypoints[4, 0, 2] = np.nan
    return Capture.checked(keypoints)
