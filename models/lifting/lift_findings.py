"""Findings of lifts: which frames differ from those of the fit, in what, and by how much."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from models.findings.advice import noticed
from models.findings.finding import Finding
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import FINDING_BITS, LiftedFrames
from models.network.answers import NOT_IN_ROOM, OTHER_SCALE, RIG_NOT_USED, UNLIKE_FIT


def lift_findings(
    lift: LiftedFrames, prior: FittedPrior, *, first_frame: int | None = None
) -> tuple[Finding, ...]:
    """Return the findings of a lift by a prior, most often none.

    Parameters
    ----------
    first_frame
        The number of the first frame, if this is part of a lift. Without it these are all frames,
        and a finding about all of them names no frames.
    """
    if not lift.findings.any():
        return ()
    return noticed(_found, lift, prior, first_frame)


def _found(lift: LiftedFrames, prior: FittedPrior, first_frame: int | None) -> Iterator[Finding]:
    for bit, code in FINDING_BITS.items():
        about = (lift.findings & bit) > 0  # (N,)
        if not about.any():
            continue
        every = first_frame is None and about.all()
        numbers = np.flatnonzero(about) + (first_frame or 0)
        evidence = _EVIDENCE[bit](lift.frames(about), prior)
        finding = Finding.of(code, frames=() if every else numbers)
        yield finding.with_evidence(evidence)


def _of_rig(lift: LiftedFrames, prior: FittedPrior) -> dict[str, float]:
    residual = _median(lift.rig_residuals)
    return {
        "residual_px": residual,
        "noise_px": prior.noise,
        "times_the_noise": residual / prior.noise,
    }


def _of_misfit(lift: LiftedFrames, prior: FittedPrior) -> dict[str, float]:
    limits = prior.capture.usual.misfits
    views = np.isfinite(lift.reprojection_errors).sum(1)
    limit = limits[np.minimum(views, len(limits)) - 1]
    return {"misfit": _median(lift.misfits), "usual_at_most": float(np.median(limit))}


def _of_size(lift: LiftedFrames, prior: FittedPrior) -> dict[str, float]:
    usual = prior.capture.usual
    return {
        "size_px": _median(lift.sizes),
        "usual_at_least_px": usual.least_size,
        "usual_at_most_px": usual.most_size,
    }


def _of_nothing(_lift: LiftedFrames, _prior: FittedPrior) -> dict[str, float]:
    return {}


_EVIDENCE = {
    RIG_NOT_USED: _of_rig,
    UNLIKE_FIT: _of_misfit,
    OTHER_SCALE: _of_size,
    NOT_IN_ROOM: _of_nothing,
}


def _median(values: NDArray[np.float32]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
