import subprocess
import sys

import pytest
from pydantic import ValidationError

from models.settings.config import WARM_STEPS, FitConfig, warm


def test_importing_the_configuration_imports_no_torch() -> None:
    code = "import sys, models.settings.config; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_field_is_described_and_has_a_default() -> None:
    for field in FitConfig.model_json_schema()["properties"].values():
        assert field["description"]
        assert "default" in field


def test_the_papers_dictionaries_are_allowed() -> None:
    sizes = [4096, 2048, 1024, 512, 256, 128, 64, 32, 16, 8]
    assert FitConfig.model_validate({"dictionary_sizes": sizes}).dictionary_sizes[-1] == 8


@pytest.mark.parametrize(
    "wrong",
    [
        {"dictionary_sizes": []},
        {"dictionary_sizes": [32, 64]},
        {"dictionary_sizes": [0]},
        {"dictionary_sizes": [5000]},
        {"dictionary_sizes": [8] * 13},
        {"dictionary_sizes": [4096, 4096]},
        {"steps": 0},
        {"learning_rate": float("nan")},
        {"learning_rate": 0},
        {"pck_threshold": float("inf")},
        {"seed": -1},
        {"prior": "other"},
        {"prior": "mlp", "dictionary_sizes": [16, 8]},
        {"mlp": {"width": 16}},
        {"prior": "mlp", "mlp": {"width": 2000}},
        {"prior": "mlp", "mlp": {"blocks": -1}},
        {"prior": "mlp", "mlp": {"decoder": "cubic"}},
        {"unknown": 1},
    ],
)
def test_nonsense_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        FitConfig.model_validate(wrong)


def test_the_learning_rate_suits_the_prior_unless_it_is_given() -> None:
    assert FitConfig().learning_rate == 1e-2
    assert FitConfig(prior="mlp").learning_rate == 2e-3
    assert FitConfig(prior="mlp", learning_rate=None).learning_rate == 2e-3
    assert FitConfig(prior="mlp", learning_rate=0.5).learning_rate == 0.5


@pytest.mark.parametrize("source", [FitConfig(dictionary_sizes=(16, 8)), FitConfig(prior="mlp")])
def test_a_start_from_a_model_takes_its_prior_over(source: FitConfig) -> None:
    suited = warm(FitConfig(seed=3), source)
    assert (suited.prior, suited.sizes, suited.seed) == (source.prior, source.sizes, 3)
    assert (suited.learning_rate, suited.steps) == (source.learning_rate, WARM_STEPS)


@pytest.mark.parametrize(("frames", "batch"), [(3, 32), (255, 32), (400, 50), (5000, 64)])
def test_a_batch_has_an_eighth_of_the_frames_unless_it_is_given(frames: int, batch: int) -> None:
    assert FitConfig().batch_of(frames) == batch
    assert FitConfig(batch_size=7).batch_of(frames) == 7


def test_a_configuration_cannot_be_changed() -> None:
    with pytest.raises(ValidationError):
        FitConfig().steps = 3  # type: ignore[misc]
