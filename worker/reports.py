"""The report on a fit, as it is stored beside the reconstruction."""

import math
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from models.causes.cause import Cause, unmended
from models.labelling.filmed import reprojections
from models.lifting.film import Film
from models.lifting.fit_report import fit_report
from models.lifting.lift import LiftedFrames
from store.reports import Report

DIGITS = 5  # that numbers keep: more are noise
DRAWN_KEYPOINTS = 20_000  # of all views of the worst frames that are drawn, at most


def make_report(
    film: Film,
    lift: LiftedFrames,
    skeleton: dict[str, Any] | None,
) -> Report:
    """Return the report on a fit, with the keypoints of its worst frames.

    Parameters
    ----------
    film, lift
        All frames of the fit.
    skeleton
        Of the dataset, whose names the verdict has.
    """
    names = (skeleton or {}).get("keypoint_names")
    keypoints, confidence, prior = film.keypoints, film.confidence, film.prior
    _, views, count, _ = keypoints.shape
    found = fit_report(prior, lift, keypoints, confidence, names)
    drawn = found.worst_frames[: max(1, DRAWN_KEYPOINTS // (views * count))]
    document = _plain(found) | {
        "drawn": _drawn(lift, keypoints, confidence, drawn, prior.capture.mends)
    }
    return Report(found.verdict, orjson.dumps(document))


def _drawn(
    lift: LiftedFrames,
    keypoints: NDArray[np.float32],
    confidence: NDArray[np.float32] | None,
    frames: list[int],
    mends: tuple[Cause, ...],
) -> list[dict[str, Any]]:
    """Return what each view shows of some frames, and where it sees the answer; pixels."""
    if not frames:
        return []
    chosen = np.isin(np.arange(len(keypoints)), frames)
    places = {int(n): place for place, n in enumerate(np.flatnonzero(chosen))}
    answered = unmended(reprojections(lift.frames(chosen).arrays), mends)
    shown = keypoints[chosen]
    if confidence is not None:
        shown = np.where(confidence[chosen, ..., None] > 0, shown, np.nan)
    return [
        {
            "frame": n,
            "views": [
                {"detected": _points(detected), "answered": _points(seen)}
                for detected, seen in zip(shown[places[n]], answered[places[n]], strict=True)
            ],
        }
        for n in frames
    ]


def _points(pixels: NDArray[Any]) -> list[list[float] | None]:
    """Return points (P, 2) in tenths of pixels, None for those that are not known."""
    return [
        [round(x, 1), round(y, 1)] if math.isfinite(x + y) else None for x, y in pixels.tolist()
    ]


def _plain(value: Any) -> Any:
    """Return tuples with names as objects, and numbers with as many digits as they are worth."""
    if hasattr(value, "_asdict"):
        return {name: _plain(item) for name, item in value._asdict().items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value
