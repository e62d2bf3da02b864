"""Placing the frames of a lift in a room whose static cameras are known."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Array = NDArray[Any]

# A symmetric matrix (3, 3) as six numbers xx, xy, xz, yy, yz, zz, and back.
UPPER = np.triu_indices(3)
FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
AGREE = np.cos(np.radians(2))  # poses of two views of a frame that contradict each other


class Places(NamedTuple):
    """Similarities of N frames into the room, `X_room = s Q X + p`; NaN if a frame has no place."""

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
    """Compute the places of frames from their V static views, the preferred view first.

    `X_room = C_v^T (s (R_v X + t_v) - d_v)` for each of them. The rotations agree, and so do the
    directions of the baselines between the cameras; their lengths give s.

    Parameters
    ----------
    turns, shifts, known
        R (N, V, 3, 3), t (N, V, 3) from canonical frames to cameras, and whether (N, V) they are
        known.
    rig_turns, rig_shifts
        C (V, 3, 3), d (V, 3) from the room to the cameras.
    lone
        The s of frames without a baseline; None: the median of the others, or 1.
    """
    frames, views = known.shape
    if not views:
        nowhere = np.full((frames, 3, 3), np.nan)
        return Places(nowhere[:, 0, 0], nowhere, nowhere[:, 0], 0)
    seen = np.where(known[..., None, None], rig_turns.transpose(0, 2, 1) @ turns, np.nan)
    there = np.where(known[..., None], _turned_back(rig_turns, shifts), np.nan)
    here = _turned_back(rig_turns, rig_shifts)
    found, true = there[:, :, None] - there[:, None], here[:, None] - here[None]
    lengths, true_lengths = (np.sqrt(np.sum(steps * steps, -1)) for steps in (found, true))
    apart = true_lengths > 1e-9 * max(float(np.abs(here).max()), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike: Bool = (np.einsum("nuij,nvij->nuv", seen, seen) - 1) / 2 > AGREE
        alike &= (np.sum(found * true, -1) / (lengths * true_lengths) > AGREE) | ~apart
        ratios = np.where(alike & apart, true_lengths / lengths, np.nan)
    chosen = alike.sum(2).argmax(1)  # the first of equals
    each = np.arange(frames)
    trusted = alike[each, chosen]
    scales = row_medians(ratios[each, chosen])
    if lone is None:
        usual = float(row_medians(scales[None])[0])
        lone = usual if np.isfinite(usual) else 1.0
    scales = np.where(np.isnan(scales), lone, scales)
    count = trusted.sum(1).astype(np.float64)
    count[count == 0] = np.nan
    turn = np.where(trusted[..., None, None], seen, 0).sum(1) / count[:, None, None]
    for _ in range(
        2
    ):  # to the nearest rotation (Newton and Schulz), which is 2 degrees off at most
        turn = 1.5 * turn - 0.5 * turn @ turn.transpose(0, 2, 1) @ turn
    shift = np.where(trusted[..., None], scales[:, None, None] * there - here, 0).sum(1)
    return Places(
        scales,
        turn,
        shift / count[:, None],
        int((trusted.sum(1) < known.sum(1)).sum()),
    )


def _places_by_first(
    turns: Float64, shifts: Float64, known: Bool, rig_turns: Float64, rig_shifts: Float64
) -> Places:
    """Compute the places of frames from the first static view of each, in the room's unit.

    All views that were lifted with this rig give the same place.
    """
    each, first = np.arange(len(known)), known.argmax(1)
    turned_back = rig_turns[first].transpose(0, 2, 1)
    there = shifts[each, first] - rig_shifts[first]
    scales = np.where(known[each, first], 1.0, np.nan)
    moved = (turned_back @ there[..., None])[..., 0]
    return Places(scales, turned_back @ turns[each, first], moved, 0)


def in_room(lift: Mapping[str, Array], rig_turns: Float64, rig_shifts: Float64) -> dict[str, Array]:
    """Transform the arrays of a lift of N frames of K views into the room.

    The cameras of every frame are transformed too, so that points project to the same pixels: by
    `R X + t` and the lens in perspective, by `s (R X)_xy + t_xy` in weak perspective. In a frame
    without a place points and cameras are NaN, and `camera_models` -1.

    A lift has the unit of its first view. If that view is static, this is the room's unit, and a
    frame is placed by its first static view. If it moves, a frame is placed by all static views,
    whose baselines give the unit.

    Parameters
    ----------
    lift
        Canonical arrays by the names of :class:`~fewview.Lift`; others are left as they are.
    rig_turns, rig_shifts
        (K, 3, 3) and (K, 3) from the room to the cameras, NaN for those that move.
    """
    turns, shifts = (np.asarray(lift[name], np.float64) for name in ("rotations", "translations"))
    models, static = lift["camera_models"], np.asarray(np.isfinite(rig_shifts).all(1))
    poses = turns[:, static], shifts[:, static], models[:, static] > 0
    if static[0]:
        places = _places_by_first(*poses, rig_turns[static], rig_shifts[static])
    else:
        places = find_places(*poses, rig_turns[static], rig_shifts[static], lone=np.nan)
    somewhere = np.isfinite(places.scales + places.shifts[:, 0])
    size = np.where(somewhere, places.scales, np.nan)[:, None]
    scales = lift["scales"] / size
    turned = turns @ places.turns.transpose(0, 2, 1)[:, None]
    moved = np.einsum("nkij,nj->nki", turned, places.shifts)
    weak = shifts - scales[..., None] * moved
    deep = size[..., None] * shifts - moved
    in_room = {
        "points3d": places.of(lift["points3d"]),
        **_uncertainty_of(lift, size, places.turns),
        "rotations": np.where(somewhere[:, None, None, None], turned, np.nan),
        "scales": scales,
        "translations": np.where((models == 0)[..., None], weak, deep),
    }
    return {
        **lift,
        **{name: array.astype(lift[name].dtype) for name, array in in_room.items()},
        "camera_models": np.where(somewhere[:, None], models, -1).astype(models.dtype),
    }


def _uncertainty_of(lift: Mapping[str, Array], sizes: Float64, turns: Float64) -> dict[str, Array]:
    """Return how far points may be off by places of scales (N, 1) and turns Q, if it is known.

    Deviations are scaled; modes are `s Q U`, and covariances `s^2 Q C Q^T`.
    """
    found = {}
    if "points3d_sd" in lift:
        found["points3d_sd"] = sizes * lift["points3d_sd"]
    if "points3d_modes" in lift:
        turned = np.einsum("nij,npjc->npic", turns, lift["points3d_modes"])
        found["points3d_modes"] = sizes[..., None, None] * turned
    if "points3d_covariance" in lift:
        blocks = turns[:, None] @ lift["points3d_covariance"][..., FULL] @ turns[:, None].mT
        found["points3d_covariance"] = sizes[..., None] ** 2 * blocks[..., *UPPER]
    return found


def _turned_back(turns: Float64, vectors: Float64) -> Float64:
    """Return C^T v of turns (V, 3, 3) and vectors (..., V, 3)."""
    return np.asarray((vectors[..., None, :] @ turns)[..., 0, :], dtype=np.float64)


def row_medians(values: Float64) -> Float64:
    """Return the medians (N,) of the finite numbers of rows (N, M), NaN where there are none."""
    count = np.isfinite(values).sum(1)
    if not count.any():
        return np.full(len(values), np.nan)
    ordered = np.sort(values, axis=1)  # NaN comes last
    each = np.arange(len(values))
    return np.asarray((ordered[each, (count - 1) // 2] + ordered[each, count // 2]) / 2)
