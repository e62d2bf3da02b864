"""Held-out frames: they measure the error of the network, and when it stops improving."""

import numpy as np
import torch
from numpy.typing import NDArray

from models.network.priors.prior import Prior
from models.network.settling import first_order_cameras
from models.training.batches import Data

HELD_OUT_SHARE = 0.05  # of the frames
LEAST_FRAMES, MOST_FRAMES = 10, 200  # that are held out
ROUNDS = 3  # of solving for cameras and foreshortening in turn


def split(frames: NDArray[np.int64], seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Divide frames (N,) into those to train on and those to hold out.

    If there are few frames, none is held out.
    """
    count = min(int(HELD_OUT_SHARE * len(frames)), MOST_FRAMES)
    if count < LEAST_FRAMES:
        return frames, frames[:0]
    order = np.random.default_rng([seed, 0, 4]).permutation(len(frames))
    return np.sort(frames[order[count:]]), np.sort(frames[order[:count]])


class Holdout:
    """H frames of which one view is predicted from the others, where there are others."""

    def __init__(self, data: Data, seed: int) -> None:
        self._data = data
        observed = (data.weights > 0).any(-1)  # (H, K)
        drawn = torch.from_numpy(np.random.default_rng([seed, 1, 4]).random(observed.shape))
        self._hidden = (drawn * observed).argmax(1)  # (H,) the view that is predicted
        several = observed.sum(1) > 1
        self._shown = data.weights.clone()  # (H, K, P)
        self._shown[several, self._hidden[several]] = 0

    @torch.no_grad()
    def error(self, network: Prior, foreshortening: float) -> float:
        """Return the mean reprojection error in the hidden views, as a share of their size.

        The network computes structures from the other views. The camera of the hidden view is
        estimated from its keypoints, with this foreshortening, to first order.
        """
        keypoints, weights = self._data.keypoints, self._data.weights
        points, _, matrices = network.reproject(keypoints, self._shown)
        shares = weights.numpy()
        cameras = first_order_cameras(
            points.numpy(),
            keypoints.numpy(),
            shares,
            matrices.numpy(),
            foreshortening,
            rounds=ROUNDS,
        )
        off = keypoints.numpy() - cameras.projected - foreshortening * cameras.slopes
        squared = (shares * np.square(off).sum(-1)).sum(-1) / np.maximum(shares.sum(-1), 1e-6)
        hidden = np.take_along_axis(np.sqrt(squared), self._hidden[:, None].numpy(), 1)
        return float(hidden.mean())
