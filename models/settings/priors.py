"""The shape priors that a fit can train: their names and sizes in a configuration.

Their computations are in `models.network.priors`.
"""

from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

PriorName = TypeAliasType("PriorName", Literal["hierarchical", "mlp"])
Decoder = TypeAliasType("Decoder", Literal["linear", "mlp"])
DictionarySizes = tuple[Annotated[int, Field(ge=1, le=4096)], ...]

MAX_DICTIONARY_ENTRIES = 16_000_000  # the paper's {4096, 2048, ..., 8} needs 11 million


class PriorSettings(NamedTuple):
    """The properties of a prior that a configuration needs."""

    sizes: str  # the field of `FitConfig` that holds its sizes
    learning_rate: float  # its default


PRIOR_SETTINGS: dict[PriorName, PriorSettings] = {
    "hierarchical": PriorSettings("dictionary_sizes", 1e-2),
    "mlp": PriorSettings("mlp", 2e-3),
}
# Fields of `FitConfig` in which a fit and the model that it starts from must agree.
ARCHITECTURE = ("prior", *(settings.sizes for settings in PRIOR_SETTINGS.values()))


class MlpSizes(BaseModel):
    """Sizes of the prior `mlp`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: int = Field(
        default=128, ge=4, le=1024, description="Numbers in every hidden layer of a view."
    )
    blocks: int = Field(
        default=2, ge=0, le=8, description="Residual blocks of the encoder, of two layers each."
    )
    code: int = Field(
        default=32, ge=1, le=1024, description="Length of the code that describes a structure."
    )
    decoder: Decoder = Field(
        default="mlp",
        description=(
            "How a code becomes a structure: `linear`, a weighted sum of basis structures; `mlp`,"
            " with one hidden layer."
        ),
    )


def check_dictionary_sizes(sizes: DictionarySizes) -> None:
    """Raise ValueError for dictionaries that widen or do not fit in memory."""
    pairs = list(pairwise(sizes))
    if any(outer < inner for outer, inner in pairs):
        raise ValueError(f"dictionary_sizes must never increase, got {list(sizes)}")
    entries = sum(outer * inner for outer, inner in pairs)
    if entries > MAX_DICTIONARY_ENTRIES:
        raise ValueError(
            f"dictionary_sizes {list(sizes)} hold {entries} entries,"
            f" more than the {MAX_DICTIONARY_ENTRIES} allowed; make the layers narrower"
        )
