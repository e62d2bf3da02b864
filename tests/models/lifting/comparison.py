"""How tests compare lifts."""

import numpy as np
from safetensors.torch import load

from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.numerics.tensor_files import pack, read_about


def same(a: LiftedFrames, b: LiftedFrames, tolerance: float = 0) -> None:
    """Compare all that two lifts say."""
    assert a.status == b.status
    others = b._asdict()
    for name, found in a._asdict().items():
        np.testing.assert_allclose(found, others[name], tolerance, tolerance, err_msg=name)


def without(prior: FittedPrior, *parts: str) -> FittedPrior:
    """Return the same prior as files have it that know nothing of these parts."""
    data = prior.to_bytes()
    about, arrays = read_about(data, kind="prior"), load(data)
    for part in parts:
        del about[part]
        arrays = {name: array for name, array in arrays.items() if f"{part}." not in name}
    return FittedPrior.from_bytes(pack(arrays, kind="prior", about=about))
