"""Bringing the views of a capture in step before a fit looks at anything else."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.clocks import Clocks, positions_in_step, read_at, times_of_views
from models.epipolar.synchronisation import Timing, find_timing, is_film, reach_at
from models.findings.catalogue import Severity
from models.findings.finding import Finding
from models.settings.config import Synchronise

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class InStep(NamedTuple):
    """The keypoints of a capture with its views in step, and what was found on the way."""

    keypoints: Float32  # (N, K, P, 2) pixels
    confidence: Float32 | None  # (N, K, P)
    clocks: Clocks | None  # of views that were shifted although their times are those of others
    findings: tuple[Finding, ...]


def put_in_step(
    keypoints: Float32,
    confidence: Float32 | None,
    times: Float64 | None,
    synchronise: Synchronise,
) -> InStep:
    """Read late views (of keypoints (N, K, P, 2)) later, so that every frame is one moment.

    Times (N,) or (N, K) in seconds that differ between views are honoured. With them, views that
    are late nevertheless are looked for and shifted; without them they are only told, and nothing
    is told of frames that do not follow each other in time. `synchronise: off` looks for nothing.
    """
    given, own = keypoints, confidence
    step = None
    if times is not None:
        times = times_of_views(times, keypoints.shape[1])
        step = float(np.median(np.diff(times[:, 0]))) if len(times) > 1 else None
        keypoints, confidence = read_at(given, own, positions_in_step(times))
    nothing = InStep(keypoints, confidence, None, ())
    if synchronise == "off" or (times is None and not is_film(keypoints.astype(np.float64))):
        return nothing
    reach = reach_at(None if step is None else 1 / step)
    weights = _weights(keypoints, confidence)
    timing = find_timing(keypoints.astype(np.float64), weights, reach=reach)
    if timing is None:
        return nothing
    findings = tuple(
        _finding(timing, int(view), step) for view in np.flatnonzero(timing.late | timing.doubtful)
    )
    if times is None or step is None or not timing.late.any():
        return nothing._replace(findings=findings)
    frames = np.arange(len(times), dtype=np.float64)
    knots = np.interp(timing.frames, frames, times[:, 0])
    clocks = Clocks(knots, np.where(timing.late, timing.offsets, 0.0) * step)
    return InStep(*read_at(given, own, positions_in_step(times, clocks)), clocks, findings)


def _weights(keypoints: Float32, confidence: Float32 | None) -> Float64:
    seen = np.asarray(np.isfinite(keypoints).all(-1))
    if confidence is None:
        return seen.astype(np.float64)
    return np.where(seen, np.nan_to_num(confidence), 0.0).astype(np.float64)


def _finding(timing: Timing, view: int, step: float | None) -> Finding:
    """Say by how much a view is late; `step` is the time between frames, if it is known."""
    offsets = timing.offsets[:, view]
    sure = bool(timing.late[view])
    applied = sure and step is not None
    evidence = {
        "offset_frames": float(offsets[np.argmax(np.abs(offsets))]),
        "sd_frames": float(timing.sds[view]),
        "sure": float(sure),
        "applied": float(applied),
    }
    if step is not None:
        evidence["offset_seconds"] = evidence["offset_frames"] * step
    if len(offsets) > 1:
        evidence["first_offset_frames"], evidence["last_offset_frames"] = map(float, offsets)
        evidence["changes_from"], evidence["changes_to"] = map(float, timing.frames)
    severity: Severity = "warning" if sure and not applied else "info"
    finding = Finding.of("views_out_of_step", views=(view,), severity=severity)
    return finding.model_copy(update={"evidence": evidence})
