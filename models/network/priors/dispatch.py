"""How the compiled network calls a prior: by the type of its weights, at compile time.

So every prior gets its own compiled network from one source, and no call is decided at run time.
Numba keeps each on disk like any other compiled function.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from models.network.priors.prior import Prior, Weights
from models.network.priors.registry import PRIORS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


def encode_into(weights: Weights, views: Float32, codes: Float32, matrices: Float64) -> None:
    """Write codes (K, B) and matrices near rotations (K, 2, 3) of normalised views (K, P, 2)."""
    raise NotImplementedError("only compiled functions call this")


def decode_into(weights: Weights, code: Float32, points: Float64) -> None:
    """Write the structure (P, 3), of any size and place, of a code (B,)."""
    raise NotImplementedError("only compiled functions call this")


@overload(encode_into, jit_options={"error_model": "numpy"})
def _choose_encoder(weights: Any, views: Any, codes: Any, matrices: Any) -> Any:
    encode = _prior_of(weights).encode_into

    def call(weights: Any, views: Any, codes: Any, matrices: Any) -> None:
        encode(weights, views, codes, matrices)

    return call


@overload(decode_into, jit_options={"error_model": "numpy"})
def _choose_decoder(weights: Any, code: Any, points: Any) -> Any:
    decode = _prior_of(weights).decode_into

    def call(weights: Any, code: Any, points: Any) -> None:
        decode(weights, code, points)

    return call


def _prior_of(weights: types.NamedTuple) -> type[Prior]:
    """Return the prior whose laid-out weights have this type of Numba's."""
    return next(prior for prior in PRIORS.values() if prior.laid_out is weights.instance_class)
