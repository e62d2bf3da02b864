"""How far the points of a lift may be off: how much of that is wanted, and the arrays of it."""

from collections.abc import Mapping
from typing import Literal, TypeVar

from typing_extensions import TypeAliasType

Uncertainty = TypeAliasType("Uncertainty", Literal["off", "sd", "full"])
Value = TypeVar("Value")

SYMMETRIC = 6  # numbers of a symmetric matrix (3, 3)
MODES = 12  # of a structure: how its points are off together
# Arrays by their names in files and on the wire, with their numbers of each point.
ARRAYS: dict[Uncertainty, dict[str, int]] = {
    "off": {},
    "sd": {"points3d_sd": 1},
    "full": {"points3d_sd": 1, "points3d_covariance": SYMMETRIC, "points3d_modes": 3 * MODES},
}


def numbers_of(uncertainty: Uncertainty) -> int:
    """Return how many numbers there are of each point."""
    return sum(ARRAYS[uncertainty].values())


def of_uncertainty(arrays: Mapping[str, Value], uncertainty: Uncertainty) -> dict[str, Value]:
    """Return the arrays of a lift without those that are not wanted."""
    unwanted = ARRAYS["full"].keys() - ARRAYS[uncertainty].keys()
    return {name: array for name, array in arrays.items() if name not in unwanted}
