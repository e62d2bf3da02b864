"""The network as ONNX, run by onnxruntime, answers as lifts without refinement do."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_capture import whole_capture
from models.lifting.fitted_prior import FittedPrior
from models.lifting.onnx_file import INPUTS, OUTPUTS, onnx_file
from models.network.priors.registry import make_prior
from models.network.settling import SETTLE_NONE, SettlingPolicy, settle_beyond
from models.settings.config import FitConfig
from tests.tiers import thorough_after

FIXTURES = Path(__file__).parents[2] / "fixtures"
ATOL = 1e-4  # of structures and rotations; pixels are a few hundred times that
PIXELS = 0.02
CONFIGS = {
    "hierarchical": FitConfig(dictionary_sizes=(24, 8)),
    "mlp": FitConfig.model_validate(
        {"prior": "mlp", "mlp": {"width": 32, "blocks": 2, "code": 6, "decoder": "mlp"}}
    ),
}


def untrained(config: FitConfig, foreshortening: float, known: int) -> FittedPrior:
    """Return a prior of 16 keypoints, of which the first `known` were ever seen."""
    network = make_prior(config, known)
    network.initialise(3)
    capture = whole_capture(16)._replace(known=np.arange(16) < known)
    weights = {name: value.detach() for name, value in network.named_parameters()}
    return FittedPrior(config, weights, (), foreshortening, capture=capture)


def fitted(foreshortening: float, settling: SettlingPolicy) -> FittedPrior:
    """Return a fitted prior with another foreshortening and policy of settling."""
    prior = FittedPrior.from_bytes((FIXTURES / "resting.safetensors").read_bytes())
    found = prior.self_calibration
    assert found is not None
    return FittedPrior(
        prior.config,
        prior.weights,
        prior.curve,
        foreshortening,
        replace(found, settling=settling),
        capture=prior.capture,
    )


PRIORS: dict[str, Callable[[], FittedPrior]] = {
    "mlp": lambda: untrained(CONFIGS["mlp"], 0.05, 14),
    # Fits choose which frames are settled, with either sign.
    "unusual frames settled": lambda: fitted(-0.056, settle_beyond(0.05)),
    "none settled": lambda: fitted(0.056, SETTLE_NONE),
    "mirrored": lambda: untrained(CONFIGS["hierarchical"], -0.06, 16),
    "not settled": lambda: untrained(CONFIGS["hierarchical"], 0.0, 16),
}


@pytest.mark.parametrize("name", thorough_after(1, PRIORS))
def test_onnx_answers_as_lifts_do(name: str) -> None:
    prior = PRIORS[name]()
    file = onnx_file(prior)
    assert len(file) < 2_000_000
    network = onnxruntime.InferenceSession(file)
    for frames, views in ((12, 3), (5, 1), (7, 5)):
        seen = synthetic_capture(
            frames=frames, views=views, noise=1.0, hidden_keypoints=0.15, seed=frames
        )
        keypoints = seen.keypoints.astype(np.float32)
        confidence = np.random.default_rng(0).uniform(0.2, 1, keypoints.shape[:3])
        confidence[0], confidence[1, :, 3] = 1, 0
        keypoints[2, 0] = np.nan  # a view that is missing
        keypoints[3, 0, 3:] = np.nan  # one that shows too little
        keypoints[4] = np.nan  # nothing at all
        keypoints[0, -1, 5, 1] = np.nan
        trust = confidence.astype(np.float32)
        lift = prior.lift(keypoints, confidence=trust, refine="off")
        given = dict(zip(INPUTS, (keypoints, trust), strict=True))
        answers = dict(zip(OUTPUTS, network.run(None, given), strict=True))
        for output, atol in zip(OUTPUTS, (ATOL, ATOL, PIXELS, PIXELS), strict=True):
            expected = getattr(lift, output)[..., :2] if output == "translations" else None
            expected = getattr(lift, output) if expected is None else expected
            np.testing.assert_allclose(answers[output], expected, rtol=0, atol=atol, err_msg=output)
        assert np.isfinite(answers["points3d"][0]).any()


def test_a_prior_that_removes_noise_first_has_no_network_of_its_own() -> None:
    prior = FittedPrior.from_bytes((FIXTURES / "denoised.safetensors").read_bytes())
    with pytest.raises(ValueError, match="denoising"):
        onnx_file(prior)
