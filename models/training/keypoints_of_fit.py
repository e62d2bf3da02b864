"""Preparing the keypoints of a fit: unknown and frozen ones, outliers and noise are removed.

A keypoint that two views never show in the same frame is left out: the network, the shapes and the
cameras are those of the other keypoints.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.calibrating.image_sizes import ImageSizes
from models.capture.checks import capture_findings, observed, placed
from models.capture.frozen import frozen_places
from models.capture.noise_removal import NoiseRemoval, learn_noise_removal
from models.capture.observations import Observations, as_observations
from models.capture.outliers import OutlierJudge, OutlierModel, learn_outliers
from models.epipolar.order_checks import order_findings
from models.findings.advice import attempt, noticed
from models.findings.finding import Finding
from models.lifting.fitted_capture import FittedCapture
from models.network.answers import nothing_unusual
from models.settings.config import FitConfig
from models.settings.lenses import known_lenses, lens_of_each_view
from models.training.synchronising import InStep

WORTH_REPORTING = 0.005  # share of the keypoints of a view that are outliers

Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]


class ObservedCapture(NamedTuple):
    """N frames of K views with the Q known of P keypoints, and the findings about them."""

    detected: Observations  # without outliers
    observations: Observations  # and without noise; the same ones if none was removed
    capture: FittedCapture
    outliers: OutlierModel | None
    noise_removal: NoiseRemoval

    @property
    def as_detected(self) -> bool:
        """Whether no noise was removed."""
        return self.observations is self.detected


def observe(
    read: InStep, image_sizes: ImageSizes | None, known: Bool | None, config: FitConfig
) -> ObservedCapture:
    """Prepare the keypoints that a fit learns from.

    Parameters
    ----------
    read
        The keypoints, checked, with the views in step.
    known
        Which keypoints (P,) the weights have that the fit starts from; None if it starts anew.
    config
        States whether outliers and noise are to be removed.

    Raises
    ------
    ValueError
        When a view shows a keypoint that the weights do not have, or numbers of keypoints differ.
    """
    pixels, confidence = read.keypoints, read.confidence
    places = attempt(frozen_places, [], pixels, observed(pixels, confidence))
    findings = capture_findings(pixels, confidence, image_sizes, places=places)
    rows = [(place.k, place.p, *place.pixel) for place in places]
    views, keypoints = pixels.shape[1:3]
    capture = FittedCapture(
        views,
        np.ones(keypoints, np.bool_),
        np.array(rows, np.float32).reshape(-1, 4),
        nothing_unusual(),
        (*findings, *read.findings),
        read.clocks,
    )
    detected, trust = capture.observations(pixels, confidence, None)
    observations = as_observations(detected, trust)
    shown = placed(observations.weights > 0)
    late = [
        view
        for finding in read.findings
        if not finding.evidence["applied"]
        for view in finding.views
    ]
    still = any(finding.code == "no_motion" and not finding.views for finding in findings)
    if not still:  # a single pose fits many geometries, however often it is shown
        order = noticed(order_findings, detected, observations.weights, late=late)
        capture = capture._replace(findings=(*capture.findings, *order))
    capture = capture._replace(known=shown if known is None else _suited(known, shown))
    observations = _among(observations, capture.known)
    outliers = learn_outliers(observations) if config.outlier_rejection else None
    if outliers is not None:
        judged = OutlierJudge(outliers, range(views)).without_outliers(observations)
        kept, swapped = judged.observations, judged.swapped
        open_ones = (finding for finding in capture.findings if not _settled(finding, swapped))
        found = (
            *noticed(_mended, swapped, capture.known),
            *noticed(_left_out, observations, kept),
        )
        capture, observations = capture._replace(findings=(*open_ones, *found)), kept
    if not config.denoising or not observations.usable.any():
        return ObservedCapture(observations, observations, capture, outliers, NoiseRemoval())
    removal = learn_noise_removal(observations, read.times)
    clear = removal.remove(observations, range(views), read.times)
    return ObservedCapture(observations, clear, capture, outliers, removal)


def usable_frames(observations: Observations) -> Int64:
    """Return the frames that show a view that can be used.

    Raises ValueError if there are none.
    """
    frames = np.flatnonzero(observations.usable.any(1))
    if not frames.size:
        raise ValueError(
            "no frame has a usable view: a view needs at least 4 observed keypoints"
            " that do not all lie at one place"
        )
    return frames


def check_entries_per_view(views: int, config: FitConfig, image_sizes: ImageSizes | None) -> None:
    """Raise ValueError unless sizes, calibration and lenses have entries that suit the views."""
    for name, given in (("image_sizes", image_sizes), ("calibration", config.calibration)):
        if given is not None and len(given) != views:
            raise ValueError(f"{name} must have one entry per view ({views}), got {len(given)}")
    pair = config.known_distance and config.known_distance.views
    if pair and (pair[0] == pair[1] or max(pair) >= views):
        raise ValueError(f"known_distance must name 2 different views below {views}, got {pair}")
    if config.lenses is not None:
        known_lenses(lens_of_each_view(config.lenses, views), image_sizes or (None,) * views)


def among_known(config: FitConfig, known: Bool) -> FitConfig:
    """Return a configuration with keypoint indices that count the known keypoints alone.

    Raises ValueError if a named keypoint is repeated, is unknown, or has no place.
    """
    place = np.cumsum(known) - 1  # of a keypoint among the known
    length, corners = config.known_length, config.corners
    for field, named in (("known_length", length and length.ends), ("handedness", corners)):
        if named and not len(set(named)) == len(named) <= len(known) > max(named):
            raise ValueError(
                f"{field} must name different keypoints of the {len(known)}, counted from 0, got"
                f" {list(named)}"
            )
        unseen = [keypoint for keypoint in named or () if not known[keypoint]]
        if unseen:
            raise ValueError(
                f"{field} must name keypoints that two views show in the same frame, got"
                f" {unseen[0]}; name others, or leave it out"
            )
    if length is not None:
        a, b = length.ends
        length = length.model_copy(update={"keypoints": (int(place[a]), int(place[b]))})
    if corners is not None:
        a, b, c, d = (int(place[keypoint]) for keypoint in corners)
        corners = (a, b, c, d)
    return config.model_copy(update={"known_length": length, "handedness": corners})


def edges_among_known(edges: Int64, known: Bool) -> Int64:
    """Return the edges (E, 2) between known keypoints, as indices among the known."""
    place = np.cumsum(known) - 1
    between: Int64 = place[edges[known[edges].all(1)]]
    return between


def _mended(swapped: Bool, known: Bool) -> tuple[Finding, ...]:
    """Yield findings about views in which known keypoints (P,) were swapped (N, K, Q)."""
    if not swapped.any():
        return ()
    frames = np.logical_or.reduce(swapped, axis=2)  # (N, K)
    views = np.flatnonzero(frames.any(0))
    finding = Finding.of(
        "left_right_mended",
        views=views.tolist(),
        frames=np.flatnonzero(frames.any(1)).tolist(),
        keypoints=np.flatnonzero(known)[np.flatnonzero(swapped.any((0, 1)))].tolist(),
        share=float(frames[:, views].mean()),
    )
    return (finding,)


def _settled(finding: Finding, swapped: Bool) -> bool:
    """Whether a finding is about frames most of which were corrected: `swapped` (N, K, Q).

    Epipolar lines do not always determine which of two views has its sides exchanged.
    """
    if finding.code != "left_right_swapped" or not finding.frames:
        return False
    mended = np.logical_or.reduce(swapped, axis=(1, 2))  # (N,)
    return bool(np.mean([mended[a : b + 1].mean() for a, b in finding.frames]) > 0.5)


def _left_out(before: Observations, after: Observations) -> tuple[Finding, ...]:
    """Yield findings about views with outliers that were left out."""
    there, left = before.weights > 0, after.weights > 0
    counts = there.sum((0, 2))  # (K,)
    shares = (counts - left.sum((0, 2))) / counts.clip(1)
    if not (shares >= WORTH_REPORTING).any():
        return ()
    views = np.flatnonzero(shares >= WORTH_REPORTING).tolist()
    share = float(1 - left.sum() / there.sum())
    return (Finding.of("outliers", views=views, share=share),)


def _suited(known: Bool, shown: Bool) -> Bool:
    if known.shape != shown.shape:
        raise ValueError(
            f"the prior to start from has keypoints {len(known)}, the fit {len(shown)}"
        )
    new = np.flatnonzero(shown & ~known).tolist()
    if new:
        raise ValueError(
            f"the prior to start from has no keypoints {new}, which these views show; start"
            " without it, or leave them out (NaN)"
        )
    return known


def _among(observations: Observations, known: Bool) -> Observations:
    if known.all():
        return observations
    return observations._replace(
        keypoints=np.ascontiguousarray(observations.keypoints[:, :, known]),
        weights=np.ascontiguousarray(observations.weights[:, :, known]),
    )
