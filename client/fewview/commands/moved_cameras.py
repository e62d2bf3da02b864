"""A camera that was moved while it filmed: two cameras, one before that and one from there on."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fewview.api.forms import Fit
from fewview.capture import Capture


class Parted(NamedTuple):
    """A capture in which each camera is static, and the configuration of its fit."""

    capture: Capture
    config: dict[str, Any]
    note: str


def parted(capture: Capture, fit: Fit, config: Mapping[str, Any]) -> Parted | None:
    """Return a capture with a moved camera divided into two views; None if none was moved.

    What is given of the lens is used for both views; a pose, and a distance from another camera,
    for the first.
    """
    moved = [each for each in fit.findings if each.code == "camera_moved" and len(each.views) == 1]
    if len(moved) != 1 or config.get("cameras") == "moving":
        return None
    view, first = moved[0].views[0], moved[0].frames[0][0]
    names = capture.view_names or tuple(f"view{v}" for v in range(capture.views))
    name = f"{names[view]}@{first}"
    later = np.arange(capture.frames) >= first
    keypoints = np.concatenate([capture.keypoints, capture.keypoints[:, [view]]], axis=1)
    keypoints[later, view] = keypoints[~later, -1] = np.nan
    confidence = capture.confidence
    if confidence is not None:
        confidence = np.concatenate([confidence, confidence[:, [view]]], axis=1)
        confidence[later, view] = confidence[~later, -1] = 0
    times = capture.times
    if times is not None and times.ndim == 2:
        times = np.concatenate([times, times[:, [view]]], axis=1)
    sizes = capture.image_sizes
    calibration = config.get("calibration")
    changed = dict(config)
    if calibration:
        lens = calibration[view] and {"intrinsics": calibration[view].get("intrinsics")}
        changed["calibration"] = [*calibration, lens]
    lenses = config.get("lenses") or ()
    if len(lenses) > 1:  # else it is that of all views
        changed["lenses"] = [*lenses, lenses[view] or {"same_as": view}]
    return Parted(
        replace(
            capture,
            keypoints=keypoints,
            confidence=confidence,
            times=times,
            view_names=(*names, name),
            image_sizes=sizes and (*sizes, sizes[view]),
        ),
        changed,
        f"{names[view]} was moved at frame {first}: it was fitted again as two cameras, "
        f"{names[view]} and {name}",
    )
