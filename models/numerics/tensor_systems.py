"""Small linear systems in tensor operations."""

import torch
from torch import Tensor
from torch.linalg import cross


def solve_symmetric(matrices: Tensor, right: Tensor) -> Tensor:
    """Solve A X = B for symmetric A (..., 3, 3) and B (..., 3, C).

    By cofactors where the operations are exported: ONNX has no solver of linear systems.
    """
    if not torch.onnx.is_in_onnx_export():
        solved: Tensor = torch.linalg.solve(matrices, right)
        return solved
    a, b, c = matrices.unbind(-2)
    rows = (cross(b, c, dim=-1), cross(c, a, dim=-1), cross(a, b, dim=-1))
    cofactors = torch.stack(rows, -2)
    determinant: Tensor = (a * rows[0]).sum(-1)[..., None, None]
    return torch.matmul(cofactors.transpose(-1, -2), right) / determinant
