"""What is stored in the service that the page shows: fits that were made before, and kept."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import fit
from store.database import Store
from store.settings import StoreSettings
from tests.models.walk import film, walk
from tests.service.conftest import BYTES, CONFIG, Live, to_npz
from tests.service.stored_fits import put_fit
from tests.sharing import fitted_once

JOINTS = [f"{side}_{joint}" for joint in ("shoulder", "hip", "knee", "ankle") for side in "lr"]
NAMES = [*JOINTS, *(f"k{index}" for index in range(len(JOINTS), 16))]
EDGES = [[0, 1], [0, 2], [1, 3], [2, 3], [2, 4], [4, 6], [3, 5], [5, 7]]
SKELETON = {"keypoint_names": NAMES, "edges": EDGES}
MOMENTS = np.arange(0, 80, 2, dtype=np.float64)  # of the frames
KEYPOINTS = film([10, 130, 250], MOMENTS, noise=1)
KNOWN = {"keypoints": [0, 2], "length": 0.5}
LONG = 150  # times the frames: more than the page fetches at a time
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Stored:
    """Identifiers of what is stored."""

    dataset: str
    fit: str
    again: str  # another fit of the same dataset
    model: str  # of the fit
    long: str  # a fit of many frames
    failed: str

    def at(self, screen: str) -> str:
        """Return where a screen is, with the identifiers in it."""
        return screen.format(**vars(self))


def store(live: Live) -> Stored:
    """Store captures and fits of them, one of which is about to fail."""
    skeleton = {"keypoint_names": np.array(NAMES), "edges": np.array(EDGES), "fps": 50.0}
    captures: dict[str, Arrays | dict[str, Any]] = {
        "walk": {"keypoints": KEYPOINTS, "points3d": walk(MOMENTS), **skeleton},
        "long": {"keypoints": np.concatenate([KEYPOINTS] * LONG), **skeleton},
        "empty": {"keypoints": np.full((3, 2, 5, 2), np.nan)},
    }
    ids = {}
    for name, arrays in captures.items():
        made = live.http.post(f"/datasets?name={name}", content=to_npz(**arrays), headers=BYTES)
        assert made.status_code == 201, made.text
        ids[name] = made.json()["id"]
    failed = live.fit(ids["empty"])["id"]
    first = walking()
    second = fitted_once("page-again", lambda: fitted(4))
    records = Store(StoreSettings(data_dir=live.data_dir))
    try:
        put = partial(put_fit, records, keypoints=KEYPOINTS, skeleton=SKELETON)
        walked = put(ids["walk"], first, name="walk")
        again = put(ids["walk"], second, name="walk again")
        long = put(ids["long"], first, name="long walk", times=LONG)
    finally:
        records.close()
    model = live.get(f"/fits/{walked}")["model_id"]
    return Stored(ids["walk"], walked, again, model, long, failed)


def walking() -> FittedPrior:
    """Return what was fitted to the walk."""
    return fitted_once("page-walk", lambda: fitted(3))


def configuration(seed: int) -> FitConfig:
    return FitConfig.model_validate(
        CONFIG | {"cameras": "static", "known_length": KNOWN, "seed": seed}
    )


def fitted(seed: int) -> FittedPrior:
    return fit(KEYPOINTS, configuration(seed))
