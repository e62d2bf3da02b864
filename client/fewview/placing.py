"""Where the frames of a lift are in a room whose cameras at rest are known."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Array = NDArray[Any]

AGREE = np.cos(np.radians(2))  # poses of two views of a frame that contradict each other


class Places(NamedTuple):
    """What leads N frames to the room, `X_room = s Q X + p`; NaN where a frame has no place."""

    scales: Float64  # (N,) s
    turns: Float64  # (N, 3, 3) Q, rotations
    shifts: Float64  # (N, 3) p
    contradicted: int  # frames in which views contradict each other

    def of(self, points: Array) -> Float64:
        """Return the points (N, P, 3) in the room."""
        placed: Float64 = self.scales[:, None, None] * (points @ self.turns.transpose(0, 2, 1))
        placed += self.shifts[:, None]
        return placed


def find_places(
    turns: Float64,
    shifts: Float64,
    known: Bool,
    rig_turns: Float64,
    rig_shifts: Float64,
    lone: float | None = None,
) -> Places:
    """Return the places of frames by their V views at rest, the one that is believed first.

    `X_room = C_v^T (s (R_v X + t_v) - d_v)` for each of them; the rotations agree, and so do the
    baselines between the cameras, in direction: their lengths give s.

    Parameters
    ----------
    turns, shifts, known
        R (N, V, 3, 3), t (N, V, 3) from canonical frames to cameras, and where (N, V) they are.
    rig_turns, rig_shifts
        C (V, 3, 3), d (V, 3) from the room to the cameras.
    lone
        The s of frames that show no baseline; None takes the median of the others, or 1.
    """
    frames, views = known.shape
    if not views:
        nowhere = np.full((frames, 3, 3), np.nan)
        return Places(nowhere[:, 0, 0], nowhere, nowhere[:, 0], 0)
    seen = np.where(known[..., None, None], rig_turns.transpose(0, 2, 1) @ turns, np.nan)
    there = np.where(known[..., None], _turned_back(rig_turns, shifts), np.nan)
    here = _turned_back(rig_turns, rig_shifts)
    found, true = there[:, :, None] - there[:, None], here[:, None] - here[None]
    lengths, true_lengths = np.linalg.norm(found, axis=-1), np.linalg.norm(true, axis=-1)
    apart = true_lengths > 1e-9 * max(float(np.abs(here).max()), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike: Bool = (np.einsum("nuij,nvij->nuv", seen, seen) - 1) / 2 > AGREE
        alike &= (np.sum(found * true, -1) / (lengths * true_lengths) > AGREE) | ~apart
        ratios = np.where(alike & apart, true_lengths / lengths, np.nan)
    chosen = alike.sum(2).argmax(1)  # the first of equals
    each = np.arange(frames)
    trusted = alike[each, chosen]
    scales = _nanmedian(ratios[each, chosen])
    if lone is None:
        usual = float(_nanmedian(scales[None])[0])
        lone = usual if np.isfinite(usual) else 1.0
    scales = np.where(np.isnan(scales), lone, scales)
    count = trusted.sum(1).astype(np.float64)
    count[count == 0] = np.nan
    mean_turn = np.where(trusted[..., None, None], seen, 0).sum(1) / count[:, None, None]
    shift = np.where(trusted[..., None], scales[:, None, None] * there - here, 0).sum(1)
    return Places(
        scales,
        nearest_rotation(mean_turn),
        shift / count[:, None],
        int((trusted.sum(1) < known.sum(1)).sum()),
    )


def in_room(
    lift: Mapping[str, Array], rig_turns: Float64, rig_shifts: Float64, lone: float
) -> dict[str, Array]:
    """Return the arrays of a lift of N frames of K views, said in the room.

    Every frame has cameras of its own, so that points project to where they did: by `R X + t` and
    the lens in perspective, by `s (R X)_xy + t_xy` in weak perspective. In a frame without a place
    points and cameras are NaN, and `camera_models` -1.

    Parameters
    ----------
    lift
        Canonical, by the names that :class:`~fewview.Lift` has; others are left as they are.
    rig_turns, rig_shifts
        (K, 3, 3) and (K, 3) from the room to the cameras, NaN for those that move.
    lone
        As in :func:`find_places`.
    """
    turns, shifts = (np.asarray(lift[name], np.float64) for name in ("rotations", "translations"))
    models, rests = lift["camera_models"], np.isfinite(rig_shifts).all(1)
    places = find_places(
        turns[:, rests],
        shifts[:, rests],
        models[:, rests] > 0,
        rig_turns[rests],
        rig_shifts[rests],
        lone,
    )
    somewhere = np.isfinite(places.scales + places.shifts[:, 0])
    size = np.where(somewhere, places.scales, np.nan)[:, None]
    scales = lift["scales"] / size
    turned = turns @ places.turns.transpose(0, 2, 1)[:, None]
    moved = np.einsum("nkij,nj->nki", turned, places.shifts)
    weak = shifts - scales[..., None] * moved
    deep = size[..., None] * shifts - moved
    said = {
        "points3d": places.of(lift["points3d"]),
        "rotations": np.where(somewhere[:, None, None, None], turned, np.nan),
        "scales": scales,
        "translations": np.where((models == 0)[..., None], weak, deep),
    }
    return {
        **lift,
        **{name: array.astype(lift[name].dtype) for name, array in said.items()},
        "camera_models": np.where(somewhere[:, None], models, -1).astype(models.dtype),
    }


def nearest_rotation(matrices: Float64) -> Float64:
    """Return the rotations (..., 3, 3) nearest to matrices in the Frobenius norm; NaN of NaN."""
    finite = np.asarray(np.isfinite(matrices).all((-2, -1)))[..., None, None]
    u, _, vt = np.linalg.svd(np.where(finite, matrices, np.eye(3)))
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.where(finite, u @ vt, np.nan)


def _turned_back(turns: Float64, vectors: Float64) -> Float64:
    """Return C^T v of turns (V, 3, 3) and vectors (..., V, 3)."""
    return np.asarray((vectors[..., None, :] @ turns)[..., 0, :], dtype=np.float64)


def _nanmedian(values: Float64) -> Float64:
    """Return the medians (N,) of the finite numbers of rows (N, M), NaN where there are none."""
    count = np.isfinite(values).sum(1)
    if not count.any():
        return np.full(len(values), np.nan)
    ordered = np.sort(values, axis=1)  # NaN comes last
    each = np.arange(len(values))
    return np.asarray((ordered[each, (count - 1) // 2] + ordered[each, count // 2]) / 2)
