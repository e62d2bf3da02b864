"""The training curve of a fit, which its prior keeps and a resumed fit continues."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from models.numerics.tensor_files import WeightsError

# A fit records 200 rows, and some more whenever its plan grows. As Python objects they take many
# times the bytes that they have in a file.
MOST_ROWS = 4000
MOST_STEPS = 2**53  # the largest count that a float64 holds exactly


class CurveRow(NamedTuple):
    """One row of a training curve."""

    step: int
    loss: float  # running mean
    reprojection_error: float  # pixels, running mean


def curve_to_tensor(curve: Sequence[CurveRow]) -> Tensor:
    """Return a curve as a tensor (rows, 3) of float64, for a file."""
    return torch.tensor(curve, dtype=torch.float64).reshape(-1, 3)


def curve_from_tensor(rows: Tensor) -> tuple[CurveRow, ...]:
    """Read what `curve_to_tensor` returned.

    Raises
    ------
    WeightsError
        When it has more rows than any fit records, or its steps do not rise from 1 on.
    """
    if len(rows) > MOST_ROWS:
        raise WeightsError(f"the training curve may have {MOST_ROWS} rows, it has {len(rows)}")
    steps = rows[:, 0].tolist()
    rising = all(before < step for before, step in pairwise([0.0, *steps]))
    if not rising or not all(step.is_integer() and step <= MOST_STEPS for step in steps):
        raise WeightsError("the training curve must have whole steps that rise from 1 on")
    return tuple(CurveRow(int(step), loss, error) for step, loss, error in rows.tolist())
