"""Whether a view is late: in step until an offset explains frames that it was not fitted to.

Every offset that may be is compared with the views in step (`models.epipolar.held_out_offsets`).
One that is clearly better than in step, and than every other, is sure. If none is, and in step is
not better than them either, the keypoints leave it open.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.held_out_offsets import Offsets, certainty_of, gain_of, of_static_cameras
from models.epipolar.offset_refinement import TrackedFrames

Float64 = NDArray[np.float64]
Verdict = Literal["in step", "late", "unknown"]

# Standard errors and nats of a keypoint by which an offset is better than in step, and than others.
# Static cameras that determine the offset are evidence of their own.
SURE, SURE_STATIC, LEAST_GAIN = 3.5, 2.5, 0.02
IN_STEP = 1.5  # standard errors by which in step is better than an offset
DROPPED = 3.0  # standard errors, at a first look, by which an offset is worse
NEAR = 2.0  # frames: nearer offsets are refined, not compared
NEARLY = 1.0  # frames: what is not sure but nearer counts as in step
MOST_SD = 0.5  # frames: static cameras determine an offset
LEAST_SD = 0.1  # frames, of a parabola's vertex


class Judged(NamedTuple):
    """What is known of a view's offset."""

    verdict: Verdict
    offset: Float64  # (N,) frames, at each moment: the likeliest
    sd: float  # frames
    certainty: float  # standard errors by which it is better than the next


def judge(
    tracked: TrackedFrames,
    others: Float64,
    proposed: Offsets,
    sd: float,
    rivals: list[int],
) -> Judged:
    """Compare offsets of a view: in step, `proposed` with its `sd` in frames, and whole `rivals`.

    The other views are read by `others` (K,) frames later.
    """
    view, still = proposed.view, np.zeros(len(proposed.of_view))
    in_step = Offsets(view, still, others)
    known = sd < MOST_SD
    leader = proposed if proposed.of_view.any() else in_step
    if leader is in_step and known and (not rivals or of_static_cameras(tracked, in_step)):
        return Judged("in step", still, sd, np.inf)
    tried = [] if leader is in_step else [leader]
    for rival in rivals:
        if min(abs(rival), np.abs(rival - proposed.of_view).min()) > NEAR:
            offsets = Offsets(view, still + rival, others)
            behind = gain_of(tracked, _whole(leader), offsets, roughly=True)
            if behind is None or certainty_of(behind) < DROPPED:
                tried.append(offsets)
    gains = [(gain_of(tracked, offsets, in_step), offsets) for offsets in tried]
    compared = [(gain, offsets) for gain, offsets in gains if gain is not None]
    if not compared:
        clear = not tried and (known or bool(rivals))
        return Judged("in step" if clear else "unknown", leader.of_view, sd, 0.0)
    gain, best = max(compared, key=lambda one: float(one[0].mean()))
    if gain.mean() <= 0:
        ahead = min(-certainty_of(gain) for gain, _ in compared)
        return Judged("in step" if ahead > IN_STEP else "unknown", best.of_view, sd, ahead)
    certainty = certainty_of(gain)
    for _, other in compared:
        if other is not best:
            against = gain_of(tracked, _whole(best), _whole(other))
            certainty = min(certainty, 0.0 if against is None else certainty_of(against))
    static = best is proposed and known and of_static_cameras(tracked, proposed)
    enough = SURE_STATIC if static else SURE
    verdict: Verdict = "late" if certainty > enough and gain.mean() > LEAST_GAIN else "unknown"
    if best is not proposed:
        best, sd = _between(tracked, best)
    if verdict == "unknown" and np.abs(best.of_view).max() + sd < NEARLY:
        verdict = "in step"
    return Judged(verdict, best.of_view, sd, certainty)


def _whole(offsets: Offsets) -> Offsets:
    """Return a constant offset in whole frames, as its rivals are.

    Of a movement that repeats, a period earlier would else be worse by a fraction of a frame.
    """
    constant = np.ptp(offsets.of_view) == 0
    return offsets._replace(of_view=np.rint(offsets.of_view)) if constant else offsets


def _between(tracked: TrackedFrames, whole: Offsets) -> tuple[Offsets, float]:
    """Return the offset between whole ones by the parabola of their costs, and its sd in frames."""
    ahead, behind = (
        gain_of(tracked, whole._replace(of_view=whole.of_view + step), whole) for step in (1, -1)
    )
    if ahead is None or behind is None:
        return whole, np.inf
    count = len(ahead)
    left_out = [
        _vertex((ahead.sum() - a) / (count - 1), (behind.sum() - b) / (count - 1))
        for a, b in zip(ahead, behind, strict=True)
    ]
    shift = _vertex(float(ahead.mean()), float(behind.mean()))
    sd = float(np.std(left_out)) * np.sqrt(count - 1)
    return whole._replace(of_view=whole.of_view + shift), max(sd, LEAST_SD)


def _vertex(ahead: float, behind: float) -> float:
    """Return where a parabola is highest that is `ahead` at 1, 0 at 0 and `behind` at -1."""
    bend = -(ahead + behind)
    return float(np.clip((ahead - behind) / (2 * bend), -1, 1)) if bend > 0 else 0.0
