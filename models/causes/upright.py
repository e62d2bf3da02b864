"""Which way images are turned: most cameras stand upright, or on a side by a quarter turn."""

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

TILTS = np.radians(np.arange(-60, 90, 15))  # of cameras, for directions that may be upwards
ROLL, TILT = np.radians((12.0, 30.0))  # standard deviations, of a roll about quarter turns
QUARTER, ANY = 3.5, 6.0  # nats against a quarter turn, and against any roll or tilt


def quarter_turns(rotations: Float64) -> tuple[Int64, float]:
    """Return by how many quarter turns clockwise the image of each camera is turned.

    `rotations` are (K, 3, 3), with y downwards in the images. The direction upwards is that in
    which the turns (K,) are likeliest; with nats against them.
    """
    ups = np.concatenate([_upwards(rotation) for rotation in rotations])  # (C, 3)
    costs = _costs(rotations, ups)  # (C, K, 4)
    best = int(costs.min(2).sum(1).argmin())
    return costs[best].argmin(1), float(costs[best].min(1).sum())


def _upwards(rotation: Float64) -> Float64:
    """Return directions (40, 3) that are upwards if a camera is tilted and turned so."""
    quarters = np.pi / 2 * np.arange(4)[:, None]
    tilts = TILTS[None]
    across = np.sin(quarters) * np.cos(tilts)
    down = -np.cos(quarters) * np.cos(tilts)
    ahead = np.broadcast_to(np.sin(tilts), across.shape)
    return np.asarray(np.stack((across, down, ahead), -1).reshape(-1, 3) @ rotation)


def _costs(rotations: Float64, ups: Float64) -> Float64:
    """Return nats (C, K, 4) against each turn of each camera, if `ups` (C, 3) are upwards."""
    x, y, z = np.moveaxis(ups @ rotations.mT, -1, 0)  # (K, C)
    quarters = np.arange(4)
    rolls = np.arctan2(x, -y)[..., None] - np.pi / 2 * quarters
    rolls = (rolls + np.pi) % (2 * np.pi) - np.pi
    turns = np.minimum(np.square(rolls / ROLL) / 2, ANY) + QUARTER * (quarters > 0)
    tilts = np.minimum(np.square(np.arcsin(z.clip(-1, 1)) / TILT) / 2, ANY)
    return np.asarray((turns + tilts[..., None]).swapaxes(0, 1))
