"""All priors there are, by the name in `config.prior`."""

import torch

from models.network.priors.hierarchical import HierarchicalPrior
from models.network.priors.mlp import MlpPrior
from models.network.priors.prior import Prior, Weights
from models.numerics.tensor_files import Arrays
from models.settings.config import FitConfig
from models.settings.priors import PriorName

PRIORS: dict[PriorName, type[Prior]] = {
    "hierarchical": HierarchicalPrior,
    "mlp": MlpPrior,
}


def make_prior(config: FitConfig, keypoints: int) -> Prior:
    """Make the prior that is configured, for P keypoints, its weights not yet drawn."""
    return PRIORS[config.prior](keypoints, config.sizes)


def outline(config: FitConfig, keypoints: int) -> Prior:
    """Make such a prior without memory for its weights, to know its sizes."""
    with torch.device("meta"):
        return make_prior(config, keypoints)


def parameter_shapes(config: FitConfig, keypoints: int) -> dict[str, tuple[int, ...]]:
    """Name and shape of every parameter of such a prior, without allocating any."""
    network = outline(config, keypoints)
    return {name: tuple(value.shape) for name, value in network.named_parameters()}


def lay_out(config: FitConfig, arrays: Arrays) -> Weights:
    """Lay out the parameters of such a prior, by name, for the compiled network."""
    return PRIORS[config.prior].lay_out(arrays, config.sizes)
