"""What every prior in the registry keeps to, whatever it computes."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from models.capture.metrics import pa_mpjpe
from models.capture.observations import Observations, as_observations
from models.capture.synthetic import SyntheticCapture, synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.network.answers import make_answers, nothing_unusual
from models.network.feed_forward import feed_forward
from models.network.priors.prior import Prior
from models.network.priors.registry import (
    PRIORS,
    lay_out,
    make_prior,
    outline,
    parameter_shapes,
)
from models.network.reprojection_tensors import solve_cameras
from models.network.settling import SETTLE_NONE
from models.numerics.rotations import rotations_from_rows
from models.settings.config import FitConfig
from models.training.trainer import Trainer, fit
from tests.sharing import fitted_once
from tests.tiers import thorough_after

# Every prior in several sizes: odd ones, and the smallest there are.
CONFIGS = {
    "hierarchical, one layer": FitConfig(dictionary_sizes=(9,)),
    "hierarchical, three layers": FitConfig(dictionary_sizes=(24, 12, 5)),
    "mlp": FitConfig.model_validate({"prior": "mlp", "mlp": {"width": 22, "code": 7}}),
    "mlp, linear": FitConfig.model_validate(
        {"prior": "mlp", "mlp": {"width": 9, "blocks": 1, "code": 5, "decoder": "linear"}}
    ),
    "mlp, no blocks": FitConfig.model_validate(
        {"prior": "mlp", "mlp": {"width": 4, "blocks": 0, "code": 1}}
    ),
}
# The cameras move here; to look for static ones takes time, and is the same for all.
SMALL = {"steps": 40, "batch_size": 16, "cameras": "moving"}
SIZES = {"hierarchical": {"dictionary_sizes": (24, 8)}}  # others have small ones by themselves
DEFAULTS = [
    FitConfig.model_validate({**SMALL, "prior": name, **SIZES.get(name, {})}) for name in PRIORS
]
KEYPOINTS = 11

every_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
every_prior = pytest.mark.parametrize("config", thorough_after(1, DEFAULTS), ids=PRIORS)


@pytest.fixture(scope="module")
def capture() -> SyntheticCapture:
    return synthetic_capture(frames=300, views=4, noise=1, hidden_keypoints=0.03, seed=8)


def drawn(config: FitConfig) -> Prior:
    """Draw a network of which every parameter matters."""
    network = make_prior(config, KEYPOINTS)
    network.initialise(1)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim == 1:
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    return network.requires_grad_(requires_grad=False)


def observed(*, gaps: bool) -> Observations:
    rng = np.random.default_rng(2)
    pixels = rng.normal(500, 80, (40, 3, KEYPOINTS, 2))
    confidence = np.ones(pixels.shape[:3])
    if gaps:
        pixels[rng.random(pixels.shape[:3]) < 0.2] = np.nan
        pixels[rng.random(pixels.shape[:2]) < 0.3] = np.nan
        pixels[7] = np.nan
        confidence = rng.uniform(0.2, 1, pixels.shape[:3])
    return as_observations(pixels, confidence)


def weights_of(network: Prior) -> dict[str, Tensor]:
    return {name: value.detach() for name, value in network.named_parameters()}


def test_there_is_a_configuration_of_every_prior() -> None:
    assert {config.prior for config in CONFIGS.values()} == PRIORS.keys()


@every_config
@pytest.mark.parametrize("gaps", [False, True])
def test_it_is_lifted_with_what_was_trained(config: FitConfig, *, gaps: bool) -> None:
    network, seen = drawn(config), observed(gaps=gaps)
    keypoints, weights = torch.from_numpy(seen.keypoints), torch.from_numpy(seen.weights)
    points, _, matrices = network.reproject(keypoints, weights)
    guesses = torch.from_numpy(rotations_from_rows(matrices.numpy())).to(points.dtype)
    cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
    answers = make_answers(*seen.weights.shape)
    prepared = lay_out(config, weights_of(network))
    feed_forward(prepared, seen, 0.0, SETTLE_NONE, nothing_unusual(), 0, len(seen.sizes), answers)
    some = seen.usable.any(1)
    assert some.all() != gaps
    np.testing.assert_allclose(answers.points3d[some], points.numpy()[some], atol=5e-4)
    found = answers.rotations[seen.usable]
    np.testing.assert_allclose(found, cameras.rotations[seen.usable], atol=5e-3)
    assert np.isnan(answers.points3d[~some]).all()


@every_config
def test_its_gradients_are_those_of_finite_differences(config: FitConfig) -> None:
    network = drawn(config).double().requires_grad_()
    views = torch.from_numpy(observed(gaps=False).keypoints[:4, 0]).double()
    generator = torch.Generator().manual_seed(0)
    factors = torch.randn(4, 3 * KEYPOINTS + 6, generator=generator).double()

    def computed() -> Tensor:
        codes, matrices = network.encode(views)
        both = torch.cat((network.decode(codes).flatten(1), matrices.flatten(1)), 1)
        return (factors * both).sum()

    torch.autograd.backward(computed())
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            assert parameter.grad is not None, name
            along = torch.randn(parameter.shape, generator=generator).double()
            parameter.add_(along, alpha=1e-7)
            ahead = computed()
            parameter.sub_(along, alpha=2e-7)
            slope = (ahead - computed()) / 2e-7
            parameter.add_(along, alpha=1e-7)
            torch.testing.assert_close((parameter.grad * along).sum(), slope, rtol=1e-5, atol=1e-6)


@every_config
def test_its_sizes_are_known_without_making_it(config: FitConfig) -> None:
    network = make_prior(config, KEYPOINTS)
    shapes = {name: tuple(value.shape) for name, value in network.named_parameters()}
    assert parameter_shapes(config, KEYPOINTS) == shapes
    promised = outline(config, KEYPOINTS)
    codes, matrices = network.encode(torch.zeros(3, KEYPOINTS, 2))
    assert codes.shape == (3, promised.code_size)
    assert matrices.shape == (3, 2, 3)
    assert network.decode(codes).shape == (3, KEYPOINTS, 3)
    assert promised.width() >= max(codes.shape[1], 2 * KEYPOINTS)


@every_config
def test_it_counts_the_multiplications_of_its_encoder(config: FitConfig) -> None:
    network = make_prior(config, KEYPOINTS)
    network.initialise(0)
    with FlopCounterMode(display=False) as counter:
        network.encode(torch.randn(5, KEYPOINTS, 2))
    assert counter.get_total_flops() == 2 * 5 * outline(config, KEYPOINTS).multiplications()


@every_config
def test_the_seed_decides_its_first_weights(config: FitConfig) -> None:
    first, same, other = (make_prior(config, KEYPOINTS) for _ in range(3))
    for network, seed in ((first, 3), (same, 3), (other, 4)):
        network.initialise(seed)
    assert all(
        torch.equal(a, b) for a, b in zip(first.parameters(), same.parameters(), strict=True)
    )
    assert not all(
        torch.equal(a, b) for a, b in zip(first.parameters(), other.parameters(), strict=True)
    )


@every_config
def test_it_travels_as_bytes(config: FitConfig) -> None:
    prior = FittedPrior(config, weights_of(drawn(config)), (), 0.1)
    data = prior.to_bytes()
    read = FittedPrior.from_bytes(data)
    assert read.to_bytes() == data
    assert read.config == config
    assert read.keypoints_per_frame == KEYPOINTS
    keypoints = np.random.default_rng(0).normal(500, 80, (4, 2, KEYPOINTS, 2))
    np.testing.assert_array_equal(read.lift(keypoints).points3d, prior.lift(keypoints).points3d)


@every_prior
def test_its_machine_code_is_kept_for_other_processes(config: FitConfig) -> None:
    code = """
import sys
import numpy as np
from models.lifting.fitted_prior import FittedPrior
from models.network.feed_forward import feed_forward
FittedPrior.from_bytes(sys.stdin.buffer.read()).lift(np.random.rand(1, 2, 11, 2))
stats = feed_forward.stats
assert stats.cache_hits and not stats.cache_misses, stats
"""
    prior = FittedPrior(config, weights_of(drawn(config)), (), 0.1)
    prior.lift(np.random.default_rng(0).random((1, 2, KEYPOINTS, 2)))
    subprocess.run([sys.executable, "-c", code], input=prior.to_bytes(), check=True)


@pytest.mark.thorough
@every_prior
def test_a_fit_resumes_bit_for_bit(config: FitConfig, capture: SyntheticCapture) -> None:
    keypoints = capture.keypoints[:30, :3]
    whole = Trainer(keypoints, config)
    data = [whole.checkpoint() for _ in whole.run()]
    for checkpoint in (data[len(data) // 3], data[-2]):
        part = Trainer(keypoints, config, checkpoint=checkpoint)
        for _ in part.run():
            pass
        assert part.result().to_bytes() == whole.result().to_bytes()


@pytest.mark.thorough
@every_prior
def test_it_is_fitted_lifted_and_refined(config: FitConfig, capture: SyntheticCapture) -> None:
    sizes = FitConfig().dictionary_sizes
    longer = config.model_copy(update={"steps": 300, "batch_size": 64, "dictionary_sizes": sizes})
    prior = fitted_once(
        config.prior, lambda: fit(capture.keypoints, longer, confidence=capture.confidence)
    )
    errors = {
        mode: _error(prior.lift(capture.keypoints, refine=mode).points3d, capture)
        for mode in ("off", "full")
    }
    # Keypoints lie 470 mm from their mean; a rigid mean figure is off by about 150 mm.
    assert errors["off"] < 0.06
    assert errors["full"] < 0.015


def _error(points: NDArray[np.float32], capture: SyntheticCapture) -> float:
    return pa_mpjpe(points, capture.points3d, reflection="never").mean


@every_prior
def test_a_fit_starts_from_a_prior_of_its_own_kind(
    config: FitConfig, capture: SyntheticCapture
) -> None:
    keypoints = capture.keypoints[:40]
    start = fit(keypoints, config.model_copy(update={"refine": "off"}))
    trainer = Trainer(keypoints, config, start=start)
    for name, value in trainer.result().weights.items():
        assert torch.equal(value, start.weights[name])
    for other in DEFAULTS:
        if other.prior != config.prior:
            with pytest.raises(
                ValueError, match=f"has prior {config.prior}, the fit {other.prior}"
            ):
                Trainer(keypoints, other, start=start)
