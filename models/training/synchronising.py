"""Bringing the views of a capture in step, before anything else in a fit."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.clocks import Clocks, in_step
from models.epipolar.order_checks import put_in_order
from models.epipolar.synchronisation import Timing, find_timing, is_film
from models.findings.advice import attempt
from models.findings.catalogue import Severity
from models.findings.finding import Finding
from models.settings.config import Automatic

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int = NDArray[np.int64]

LONGEST_GAP = 5  # places on the grid of times that missing frames take


class InStep(NamedTuple):
    """The keypoints of a capture with its views in step, and the findings about them."""

    keypoints: Float32  # (N, K, P, 2) pixels
    confidence: Float32 | None  # (N, K, P)
    times: Float64 | None  # (N,) seconds, of the first view, if they were given
    clocks: Clocks | None  # of views that were shifted although their given times are the same
    findings: tuple[Finding, ...]


def put_in_step(
    keypoints: Float32,
    confidence: Float32 | None,
    times: Float64 | None,
    synchronise: Automatic,
) -> InStep:
    """Read late views (of keypoints (N, K, P, 2)) later, so that every frame is one moment.

    Times (N,) or (N, K) in seconds may differ between views, and the views are then shifted by the
    difference. If frames follow each other in time, views that are still late are found. With
    times they are shifted too; without, they are only reported. A view that may be late, but need
    not, is reported and never shifted. `synchronise: off` disables the search. If the search
    fails, the error is logged and no view counts as late.
    """
    read, trust = in_step(keypoints, confidence, times)
    first = None if times is None else times.reshape(len(times), -1)[:, 0]
    nothing = InStep(read, trust, first, None, ())
    if synchronise == "off":
        return nothing
    if times is None and not attempt(is_film, False, read.astype(np.float64)):
        return nothing
    step = None if first is None or len(first) < 2 else float(np.median(np.diff(first)))
    slots = np.arange(len(read)) if first is None or step is None else _slots(first, step)
    timing = attempt(_timing, None, read.astype(np.float64), _weights(read, trust), slots)
    if timing is None:
        return nothing
    frames = np.arange(len(slots), dtype=np.float64)
    timing = timing._replace(frames=np.interp(timing.frames, slots, frames))
    findings = tuple(
        _finding(timing, int(view), step) for view in np.flatnonzero(timing.late | timing.unknown)
    )
    if first is None or step is None or not timing.late.any():
        return nothing._replace(findings=findings)
    knots = np.interp(timing.frames, frames, first)
    clocks = Clocks(knots, np.where(timing.late, timing.offsets, 0.0) * step)
    return InStep(*in_step(keypoints, confidence, times, clocks), first, clocks, findings)


def _timing(pixels: Float64, weights: Float64, slots: Int) -> Timing | None:
    """Find by how many frames views are late.

    Exchanged views or keypoints and a camera that was moved also look like late views. If fewer
    views look late once these are corrected, the corrected frames decide.
    """
    timing = find_timing(*_spread(pixels, weights, slots))
    if timing is None or not _out_of_step(timing):
        return timing
    ordered = put_in_order(pixels, weights)
    again = ordered and find_timing(*_spread(*ordered, slots))
    return again if again and _out_of_step(again) < _out_of_step(timing) else timing


def _out_of_step(timing: Timing) -> int:
    return int((timing.late | timing.unknown).sum())


def _slots(times: Float64, step: float) -> Int:
    """Return places (N,) on a grid of even steps, with free places for missing frames.

    Long pauses are shortened. No two frames have the same place.
    """
    steps = np.round(np.diff(times) / step).astype(np.int64)
    return np.concatenate(([0], np.cumsum(np.clip(steps, 1, LONGEST_GAP))))


def _spread(keypoints: Float64, weights: Float64, slots: Int) -> tuple[Float64, Float64]:
    """Put keypoints (N, K, P, 2) and weights (N, K, P) in their places, of weight 0 between."""
    if slots[-1] == len(slots) - 1:
        return keypoints, weights
    pixels = np.full((slots[-1] + 1, *keypoints.shape[1:]), np.nan)
    spread = np.zeros((slots[-1] + 1, *weights.shape[1:]))
    pixels[slots], spread[slots] = keypoints, weights
    return pixels, spread


def _weights(keypoints: Float32, confidence: Float32 | None) -> Float64:
    seen = np.asarray(np.isfinite(keypoints).all(-1))
    if confidence is None:
        return seen.astype(np.float64)
    return np.where(seen, np.nan_to_num(confidence), 0.0).astype(np.float64)


def _finding(timing: Timing, view: int, step: float | None) -> Finding:
    """Return what is found of a view that is late, or may be; `step` is the time between frames."""
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
    if not sure:
        return Finding.of("timing_unknown", views=(view,)).with_evidence(evidence)
    severity: Severity = "info" if applied else "warning"
    finding = Finding.of("views_out_of_step", views=(view,), severity=severity)
    return finding.with_evidence(evidence)
