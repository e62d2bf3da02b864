"""How tests compare lifts."""

import numpy as np

from models.lifting.lift import Lift


def same(a: Lift, b: Lift, tolerance: float = 0) -> None:
    """Compare all that two lifts say."""
    assert a.status == b.status
    others = b._asdict()
    for name, found in a._asdict().items():
        np.testing.assert_allclose(found, others[name], tolerance, tolerance, err_msg=name)
