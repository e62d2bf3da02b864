"""What a fit may be relied on for: errors to expect, and what would lessen them most."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.lifting.deviations import as_lifted
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frame_refinement import sub_rig
from models.lifting.lift import LiftedFrames
from models.numerics.medians import NORMAL
from models.posterior.answers import frames_as_detected
from models.posterior.quality import REASONS
from models.posterior.views_worth import (
    Direction,
    Place,
    ViewsWorth,
    directions_of,
    expected_error,
    worth_of_places,
    worth_of_views,
)

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]

HEIGHT = 4.0  # root-mean-square radii: about the height of a person
MOST_FRAMES = 40  # that the worth of views is computed from
WORST = 10  # frames that are named
BLOCKS = 20  # of frames whose errors are independent
OF_MEDIAN = math.sqrt(math.pi / 2)  # its deviation, over that of a mean
HELPS = 0.85  # of the expected error, that one more camera must leave at most to be advised
WORDS = {
    "little_evidence": "too few keypoints or views",
    "views_disagree": "views that disagree",
    "unlike_fit": "structures unlike the fit's",
    "no_evidence": "no structure",
}


class FitReport(NamedTuple):
    """What is known of the answers of a fit; lengths are in the unit of its structures.

    None stands for what is not known, as in weak perspective.
    """

    verdict: str
    size: float  # the height of the subject, four root-mean-square radii, median over frames
    expected_error: float | None  # root mean square over points
    of_keypoints: list[float | None]  # (P,)
    of_frames: list[float | None]  # (N,)
    quality: list[float | None]  # (N,) in [0, 1]
    reasons: list[str | None]  # (N,) of a low quality, of `models.posterior.quality.REASONS`
    noise_px: list[list[float | None]] | None  # (K, P)
    scale_sd: float | None  # of a known length: share by which all lengths may be off together
    worst_frames: list[int]  # the least reliable first
    of_views: list[ViewsWorth]  # the best first
    cameras: list[Direction]  # (K,) where they are; none unless all are of one static rig
    places: list[Place]  # of one more camera
    best_place: Place | None


def fit_report(
    prior: FittedPrior,
    lift: LiftedFrames,
    keypoints: ArrayLike,
    confidence: ArrayLike | None = None,
    names: Sequence[str] | None = None,
) -> FitReport:
    """Report on the answers of a fit.

    Parameters
    ----------
    lift
        Of the fit's own keypoints (N, K, P, 2), as it answers them, in canonical frames of
        reference, with `points3d_sd`.
    keypoints, confidence
        As in `FittedPrior.lift`.
    names
        Of the P keypoints, for the verdict.
    """
    there = np.isfinite(lift.points3d).any((1, 2))
    size = math.nan
    if there.any():
        spread = np.nanvar(lift.points3d[there].astype(np.float64), 1).sum(-1)
        size = HEIGHT * float(np.sqrt(np.median(spread)))
    squares = np.square(lift.points3d_sd.astype(np.float64))
    overall = _root_mean(squares)
    cameras = _of_cameras(prior, lift, keypoints, confidence, overall)
    report = FitReport(
        verdict="",
        size=size,
        expected_error=overall,
        of_keypoints=[_root_mean(column) for column in squares.T],
        of_frames=[_root_mean(row) for row in squares],
        quality=[_number(value) for value in lift.quality.tolist()],
        reasons=[REASONS[place - 1] if place else None for place in lift.quality_reason.tolist()],
        noise_px=None if prior.posterior is None else _noise(prior, prior.posterior.noise),
        scale_sd=scale_sd(prior, lift),
        worst_frames=_worst(lift),
        of_views=cameras.of_views,
        cameras=cameras.there,
        places=cameras.places,
        best_place=min(cameras.places, key=lambda place: place.expected_error, default=None),
    )
    return report._replace(verdict=verdict_of(report, names))


def verdict_of(report: FitReport, names: Sequence[str] | None = None) -> str:
    """Return in words what answers may be relied on for, to how much, and what would help most."""
    if report.expected_error is None:
        return (
            "How far points may be off is not known: structures are in weak perspective, or an"
            " older version fitted them."
        )
    share = report.expected_error / report.size
    sentences = [
        f"Points are expected within {_percent(share)} of the subject's size of where they are"
        " (root mean square)."
    ]
    known = [value for value in report.of_keypoints if value is not None]
    if known and max(known) > 1.5 * report.expected_error:
        worst = report.of_keypoints.index(max(known))
        name = f"Keypoint {worst}" if names is None else names[worst]
        sentences.append(f"{name} is the least certain: {_percent(max(known) / report.size)}.")
    doubtful = [reason for reason in report.reasons if reason is not None]
    if doubtful:
        most = max(set(doubtful), key=doubtful.count)
        sentences.append(
            f"{len(doubtful)} of {len(report.reasons)} frames are doubtful, most for {WORDS[most]}."
        )
    best = report.best_place
    if best is not None:
        left = best.expected_error / report.expected_error
        if left < HELPS:
            sentences.append(
                f"One more camera {_where(best.direction)} would leave {_percent(left)} of"
                " the error."
            )
    return " ".join(sentences)


def _where(place: Direction) -> str:
    height = "at the subject's height" if place.elevation_deg < 15 else "from above"
    if place.azimuth_deg == 0:
        return f"in the direction of the first, {height},"
    side = place.azimuth_deg if place.azimuth_deg <= 180 else 360 - place.azimuth_deg
    turn = "" if side == 180 else " to the left" if place.azimuth_deg < 180 else " to the right"
    return f"{side:.0f} degrees{turn} of the first, seen from the subject, {height},"


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _root_mean(squares: Float64) -> float | None:
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(known.mean())) if len(known) else None


def scale_sd(prior: FittedPrior, lift: LiftedFrames) -> float | None:
    """Return the deviation of the median by which a known length gives the scale, as its share.

    It is how medians of blocks of frames differ, or what the frames' own deviations leave open, if
    that is more: lifts may hold the length.
    """
    if prior.config.known_length is None:
        return None
    a, b = prior.config.known_length.ends
    lengths = np.linalg.norm(lift.points3d[:, a] - lift.points3d[:, b], axis=-1).astype(np.float64)
    variances = np.square(lift.points3d_sd[:, [a, b]].astype(np.float64)).sum(1) / 3  # along it
    known = np.isfinite(lengths + variances)
    count = int(known.sum())
    if not count:
        return None
    blocks = np.array_split(lengths[known], min(BLOCKS, count))
    medians = np.array([np.median(block) for block in blocks])
    typical = float(np.median(medians))
    spread = NORMAL * float(np.median(np.abs(medians - typical)))
    of_points = math.sqrt(float(variances[known].mean()) / count)
    return OF_MEDIAN * max(spread / math.sqrt(len(blocks)), of_points) / typical


def _worst(lift: LiftedFrames) -> list[int]:
    """Return the frames of least quality that have a structure."""
    there = np.isfinite(lift.points3d).any((1, 2)) & np.isfinite(lift.quality)
    order = np.argsort(np.where(there, lift.quality, np.inf), kind="stable")
    return [int(n) for n in order[:WORST] if there[n]]


class _Cameras(NamedTuple):
    of_views: list[ViewsWorth]
    there: list[Direction]
    places: list[Place]


def _of_cameras(
    prior: FittedPrior,
    lift: LiftedFrames,
    keypoints: ArrayLike,
    confidence: ArrayLike | None,
    expected: float | None,
) -> _Cameras:
    """Return what views and places are worth; with all views errors are as `expected`."""
    posterior, found = prior.posterior, prior.self_calibration
    known, views = prior.capture.known, lift.scales.shape[1]
    some = lift.of_keypoints(known)
    there: Bool = np.all(np.isfinite(some.points3d), axis=(1, 2))
    there &= np.all(some.camera_models > 0, axis=1)
    nothing = _Cameras([], [], [])
    if posterior is None or found is None or expected is None or not there.any():
        return nothing
    chosen = np.flatnonzero(there)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(MOST_FRAMES, len(chosen))).astype(int)]
    kept = np.isin(np.arange(len(there)), chosen)
    rig = sub_rig(found, range(views), views)
    seen = prior.observe(
        np.asarray(keypoints)[kept],
        confidence=None if confidence is None else np.asarray(confidence)[kept],
    )
    lifted = as_lifted(some.frames(kept), posterior, rig, seen)
    frames = frames_as_detected(lifted, 0, len(chosen))
    given = posterior.shapes, posterior.factor, posterior.corrections[0]
    unit = expected / expected_error(frames, *given)
    of_views = [
        ViewsWorth(worth.views, unit * worth.expected_error)
        for worth in worth_of_views(frames, *given)
    ]
    typical = float(np.median(posterior.noise))
    places = [
        Place(place.direction, unit * place.expected_error)
        for place in worth_of_places(frames, rig, *given, typical)
    ]
    return _Cameras(of_views, directions_of(rig, frames) if places else [], places)


def _noise(prior: FittedPrior, noise: Float64) -> list[list[float | None]]:
    whole = np.full((len(noise), len(prior.capture.known)), np.nan)
    whole[:, prior.capture.known] = noise
    return [[_number(value) for value in row] for row in whole.tolist()]
