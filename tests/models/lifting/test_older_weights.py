"""Weights that an older version wrote are read, and lift as they did (see tests/fixtures)."""

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from models.lifting.fitted_prior import FittedPrior
from models.settings.config import Refine

FIXTURES = Path(__file__).parents[2] / "fixtures"
NAMES = ["resting", "plain", "denoised", "fisheye"]
TOLERANCE: dict[Refine, float] = {"off": 1e-5, "auto": 1e-3, "full": 1e-3}  # relative


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("refine", list(TOLERANCE))
def test_older_weights_lift_as_they_did(name: str, refine: Refine) -> None:
    prior = FittedPrior.from_bytes((FIXTURES / f"{name}.safetensors").read_bytes())
    then = load_file(FIXTURES / f"{name}_lifts.safetensors")
    lift = prior.lift(then["keypoints"], refine=refine)
    assert set(lift.status) == {"ok"}
    for name_then, before in then.items():
        if not name_then.startswith(f"{refine}."):
            continue
        array = name_then.partition(".")[2]
        now = getattr(lift, array)
        assert (now.dtype, now.shape) == (before.dtype, before.shape), array
        if before.dtype.kind == "i":
            np.testing.assert_array_equal(now, before, err_msg=array)
        else:
            size = (
                np.sqrt(np.nanmean(before.astype(float) ** 2)) if np.isfinite(before).any() else 1
            )
            atol = TOLERANCE[refine] * size
            np.testing.assert_allclose(now, before, rtol=0, atol=atol, err_msg=array)


@pytest.mark.parametrize("name", NAMES)
def test_the_cameras_of_older_weights_are_kept(name: str) -> None:
    data = (FIXTURES / f"{name}.safetensors").read_bytes()
    prior = FittedPrior.from_bytes(data)
    if name == "plain":
        assert prior.cameras is None
        return
    assert prior.cameras is not None
    assert prior.cameras.arrangement == "static"
    assert ("noise were removed" in prior.cameras.reason) == (name == "denoised")
    first = "fisheye" if name == "fisheye" else "perspective"
    assert prior.cameras.camera_models == (first, "perspective", "perspective")
    if name == "fisheye":
        np.testing.assert_allclose(prior.cameras.focals[0], 500)
        np.testing.assert_allclose(prior.cameras.distortions[0, :3], [0.05, -0.01, 0.002])
    again = FittedPrior.from_bytes(prior.to_bytes())
    frames = load_file(FIXTURES / f"{name}_lifts.safetensors")["keypoints"]
    np.testing.assert_array_equal(again.lift(frames).points3d, prior.lift(frames).points3d)
