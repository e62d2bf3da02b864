"""The training curve that a fitted prior keeps, and that a fit goes on with."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class CurvePoint(NamedTuple):
    """One row of a training curve."""

    step: int
    loss: float  # running mean
    reprojection_error: float  # pixels, running mean


def curve_to_tensor(curve: Sequence[CurvePoint]) -> Tensor:
    """Return a curve as a tensor (rows, 3) of float64, for a file."""
    return torch.tensor(curve, dtype=torch.float64).reshape(-1, 3)


def curve_from_tensor(rows: Tensor) -> tuple[CurvePoint, ...]:
    """Read what `curve_to_tensor` returned."""
    return tuple(CurvePoint(int(step), loss, error) for step, loss, error in rows.tolist())
