"""A fitted prior: lifts 2D keypoints to structures and cameras, and is stored as bytes."""

import math
from collections.abc import Sequence
from copy import copy
from functools import lru_cache, partial

import numpy as np
import torch
from numpy.typing import ArrayLike

from models.bundle.known_structures import KnownStructures
from models.calibrating.result import SelfCalibration, camera_report
from models.calibrating.result_files import to_arrays
from models.capture.denoising import DENOISER_KIND
from models.capture.noise_removal import NoiseRemoval
from models.capture.outliers import OUTLIERS_KIND, OutlierModel
from models.causes.cause import Cause
from models.findings.finding import Finding
from models.lifting.curve import CurveRow, curve_from_tensor, curve_to_tensor
from models.lifting.deviations import with_deviations
from models.lifting.fitted_capture import FittedCapture, whole_capture
from models.lifting.frame_refinement import make_refiner
from models.lifting.lift import LiftedFrames
from models.lifting.observing import Following, ObservedFrames, Observer
from models.lifting.prior_parts import parts_of
from models.lifting.second_looks import Lifter, lift_frames
from models.lifting.skeleton_lengths import SkeletonLengths
from models.lifting.usual_structure import without_unlikely
from models.network.answers import Answers, make_answers
from models.network.priors.registry import lay_out, parameter_shapes
from models.network.settling import SETTLE_ALL, SettlingPolicy
from models.numerics.tensor_files import (
    Arrays,
    Shapes,
    WeightsError,
    pack,
    prefixed,
    read_about,
    unpack,
    without_prefix,
)
from models.posterior.posterior import POSTERIOR_KIND, Posterior
from models.settings.config import FitConfig, Refine
from models.settings.keypoints import (
    MAX_KEYPOINTS,
    MIN_KEYPOINTS,
)
from models.settings.uncertainty import Uncertainty

MOST_REFINERS = 64  # choices of views whose refiners are kept at once


class FittedPrior:
    """The outcome of a fit. Immutable, and safe to use from several threads at once."""

    def __init__(
        self,
        config: FitConfig,
        arrays: Arrays,
        curve: tuple[CurveRow, ...],
        foreshortening: float,
        self_calibration: SelfCalibration | None = None,
        noise_removal: NoiseRemoval | None = None,
        capture: FittedCapture | None = None,
        outliers: OutlierModel | None = None,
        skeleton: SkeletonLengths | None = None,
        structures: KnownStructures | None = None,
        posterior: Posterior | None = None,
    ) -> None:
        self.config = config
        self._noise_removal = noise_removal or NoiseRemoval()
        self._outliers = outliers
        self._skeleton = skeleton
        self._structures = structures
        self.posterior = posterior
        self.cameras = None if self_calibration is None else camera_report(self_calibration)
        self.self_calibration = self_calibration
        self.curve = curve
        self.foreshortening = foreshortening
        self._arrays = arrays
        self._network = lay_out(config, arrays)
        # Of those for rare choices of views the one used longest ago goes.
        self._refiner_of = None
        if self_calibration is not None:
            make = partial(
                make_refiner,
                self_calibration,
                skeleton=skeleton,
                structures=structures,
                rejecting=config.outlier_rejection,
            )
            self._refiner_of = lru_cache(MOST_REFINERS)(make)
        self.capture = whole_capture(self._network.keypoints) if capture is None else capture
        rig = 0 if self_calibration is None else len(self_calibration.rig.groups)
        self._observer = Observer(self.capture, outliers, self._noise_removal, rig)

    def of_capture(
        self,
        config: FitConfig,
        capture: FittedCapture,
        outliers: OutlierModel | None = None,
        noise_removal: NoiseRemoval | None = None,
    ) -> "FittedPrior":
        """Return the same prior with what a fit learnt of its keypoints."""
        return FittedPrior(
            config,
            self._arrays,
            self.curve,
            self.foreshortening,
            self.self_calibration,
            noise_removal,
            capture,
            outliers,
            self._skeleton,
            self._structures,
        )

    def with_posterior(self, posterior: Posterior) -> "FittedPrior":
        """Return the same prior that knows how far its answers may be off."""
        knowing = copy(self)
        knowing.posterior = posterior
        return knowing

    def mending(self, causes: tuple[Cause, ...]) -> "FittedPrior":
        """Return the same prior that undoes these causes in the keypoints that it lifts."""
        knowing = copy(self)
        knowing.capture = self.capture._replace(mends=causes)
        knowing._observer = self._observer.of(knowing.capture)
        return knowing

    @property
    def noise(self) -> float:
        """Standard deviation of a coordinate in pixels; NaN if no cameras were estimated."""
        return math.nan if self.self_calibration is None else self.self_calibration.noise

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of the keypoints and, if cameras were estimated, of the cameras."""
        found = self.self_calibration
        return (*self.capture.findings, *(() if found is None else found.findings))

    @property
    def denoises(self) -> bool:
        """Whether noise is removed from keypoints before the network sees them."""
        return self._noise_removal.denoiser is not None

    @property
    def smooths(self) -> bool:
        """Whether noise is removed by smoothing in time, for frames with times."""
        return self._noise_removal.motion is not None

    @property
    def known_views(self) -> int:
        """How many views the fit had; 0 if it learnt nothing about its views."""
        return self._observer.views

    @property
    def holds_lengths(self) -> bool:
        """Whether edges of the skeleton keep their lengths in refined lifts."""
        return self._skeleton is not None

    @property
    def settling(self) -> SettlingPolicy:
        """Which frames of a lift are settled after the network."""
        found = self.self_calibration
        return SETTLE_ALL if found is None else found.settling

    @property
    def weights(self) -> Arrays:
        """The weights of the network, by name; not to be changed."""
        return self._arrays

    @property
    def keypoints_per_frame(self) -> int:
        """The number of keypoints P that every frame must have, known or not."""
        return len(self.capture.known)

    def lift(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        refine: Refine | None = None,
        views: Sequence[int] | None = None,
        previous: LiftedFrames | None = None,
        times: ArrayLike | None = None,
        only: slice | None = None,
        uncertainty: Uncertainty = "sd",
    ) -> LiftedFrames:
        """Lift frames (N, K, P, 2) in pixels, with any number of views K and any gaps.

        Every frame is lifted on its own: unless `times` are given, neither its neighbours nor the
        order of the frames changes its answer. Structures have the handedness that the fit decided
        on. Keypoints that have no place (`models.capture.checks.placed`) in the fit are NaN, even
        if these frames show them. So are those that fewer than two views show of a frame and that
        lie far from where the fit's structures have them (`models.lifting.usual_structure`).

        Parameters
        ----------
        refine
            `off`: the network and weak perspective. `full`: perspective refinement with the lenses,
            the rig and the shapes that the fit estimated. `auto`: the same, except for frames whose
            keypoints it explains worse than the network by more than a quarter. Default: as in
            the fit's configuration. Without estimated cameras nothing is refined.
        views
            Which of the fit's views these are. Default: all of them in their order if K is their
            number, otherwise cameras that the fit does not know.
        previous
            Answers for the previous frames, one for each frame and of the same views; NaN where
            there is none. If one explains a frame's keypoints better than the network's answer,
            refinement starts from it, and `continued` is set.
        times
            Times of the frames, (N,) or (N, K) in seconds, rising. Frames are then smoothed in
            time, if the fit had times too and these are views of it.
        only
            Which of the frames to answer; the others are there to be neighbours. Default: all.
        uncertainty
            `sd`: with `points3d_sd`. `full`: with `points3d_covariance` and `points3d_modes`, too.
            `off`: without. Only refined frames have them (see `models.posterior`).

        Raises
        ------
        ValueError
            When the arrays or times are malformed (see `as_observations`, `check_times`), P differs
            from the fit's, `previous` is of other frames or views, or `views` does not name K
            different views of the fit.
        """
        observed = self.observe(keypoints, confidence=confidence, views=views, times=times)
        if only is not None:
            observed = observed.frames(only)
        return self.lift_observed(
            observed, refine=refine, previous=previous, uncertainty=uncertainty
        )

    def observe(
        self,
        keypoints: ArrayLike,
        *,
        confidence: ArrayLike | None = None,
        views: Sequence[int] | None = None,
        times: ArrayLike | None = None,
    ) -> ObservedFrames:
        """Remove outliers and noise from frames: the first half of `lift`, with its arguments.

        Raises ValueError as `lift` does.
        """
        return self._observer.observe(keypoints, confidence, views, times)

    def follow(self, *, views: Sequence[int] | None = None, lag: int) -> Following:
        """Begin a film of `views` of the fit, whose frames arrive one by one with their times.

        Each is smoothed in time and returned `lag` frames later: 0 to `MAX_LAG`.

        Raises
        ------
        ValueError
            If this prior does not smooth in time, or does not have these views.
        """
        return self._observer.follow(views, lag)

    def lift_observed(
        self,
        observed: ObservedFrames,
        *,
        refine: Refine | None = None,
        previous: LiftedFrames | None = None,
        uncertainty: Uncertainty = "sd",
    ) -> LiftedFrames:
        """Lift observed frames: the second half of `lift`, with its arguments.

        Raises ValueError if `previous` is of other frames or views.
        """
        frames, count, points = observed.observations.weights.shape
        if previous is not None and previous.scales.shape != (frames, count):
            raise ValueError(
                f"previous must have the shape of the keypoints, {frames} frames of {count} views,"
                f" got {previous.scales.shape}"
            )
        mode = self.config.refine if refine is None else refine
        before = make_answers(0, count, points)
        if previous is not None:
            known = previous.of_keypoints(self.capture.known)
            # A frame that lacks a point has nothing to continue from, as one without an answer.
            lacking = np.isnan(known.points3d).any((1, 2), keepdims=True)
            known = known._replace(points3d=np.where(lacking, np.float32(np.nan), known.points3d))
            # Arrays with another memory order would make Numba compile again, which takes a minute.
            before = Answers(*map(np.ascontiguousarray, known))
        lifter = Lifter(
            self._network,
            self.foreshortening,
            self.settling,
            self.capture.usual,
            self._refiner_of(observed.views, count)
            if self._refiner_of is not None and mode != "off"
            else None,
            mode == "full",
        )
        answers = lift_frames(lifter, observed, before)
        lift = LiftedFrames(*answers)
        if uncertainty != "off":
            rig = None if lifter.refiner is None else lifter.refiner.rig
            full = uncertainty == "full"
            lift = with_deviations(lift, self.posterior, rig, observed, modes=full)
        lift = without_unlikely(lift, self.capture.structure)
        return lift.among(self.capture.known)

    def to_bytes(self) -> bytes:
        """Return the prior as safetensors bytes, its configuration in the header."""
        about = {
            "config": self.config.model_dump_json(),
            "keypoints": str(self._network.keypoints),
            **self.capture.to_header(),
        }
        arrays = {
            **self._arrays,
            "curve": curve_to_tensor(self.curve),
            "foreshortening": torch.tensor([self.foreshortening], dtype=torch.float64),
        }
        denoiser, motion = self._noise_removal
        parts: dict[str, tuple[str, Arrays]] = {}
        if self.self_calibration is not None:
            cameras, words = to_arrays(self.self_calibration)
            parts["cameras"] = words, cameras
        others = {
            "denoiser": (DENOISER_KIND, denoiser),
            "motion": ("yes", motion),
            "outliers": (OUTLIERS_KIND, self._outliers),
            "skeleton": ("yes", self._skeleton),
            "structures": ("yes", self._structures),
            "posterior": (POSTERIOR_KIND, self.posterior),
        }
        for name, (kind, other) in others.items():
            if other is not None:
                parts[name] = kind, other.to_arrays()
        for name, (words, tensors) in parts.items():
            about[name] = words
            arrays |= prefixed(f"{name}.", tensors)
        return pack(arrays, kind="prior", about=about)

    @classmethod
    def from_bytes(cls, data: bytes) -> "FittedPrior":
        """Read what `to_bytes` wrote.

        Raises
        ------
        WeightsError
            When the bytes are damaged, of another kind, or do not agree with their header. This is
            checked before anything larger than `data` is allocated.
        """
        try:
            return cls._from_file(data, read_about(data, kind="prior"))
        except WeightsError:
            raise
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise WeightsError(f"the file contradicts itself: {error}") from error

    @classmethod
    def _from_file(cls, data: bytes, about: dict[str, str]) -> "FittedPrior":
        try:
            config = FitConfig.model_validate_json(about["config"])
            keypoints = int(about["keypoints"])
        except (KeyError, ValueError) as error:
            raise WeightsError("the header holds no valid configuration") from error
        if not MIN_KEYPOINTS <= keypoints <= MAX_KEYPOINTS:
            raise WeightsError(f"the header states {keypoints} keypoints per frame")
        capture = FittedCapture.from_header(about, keypoints)
        weights = parameter_shapes(config, keypoints)
        shapes: Shapes = {**weights, "curve": (None, 3), "foreshortening": (1,)}
        there = {name: part for name, part in parts_of(about, keypoints).items() if name in about}
        for name, part in there.items():
            shapes |= prefixed(f"{name}.", part.shapes())
        arrays = unpack(data, shapes=shapes)
        parts = {name: p.read(without_prefix(f"{name}.", arrays)) for name, p in there.items()}
        cameras, outliers = parts.get("cameras"), parts.get("outliers")
        removal = NoiseRemoval(parts.get("denoiser"), parts.get("motion"))
        capture.check_views(
            (
                0 if cameras is None else len(cameras.rig.groups),
                0 if outliers is None else len(outliers.mean),
                0 if removal.denoiser is None else len(removal.denoiser.mean),
                0 if removal.motion is None else len(removal.motion.noise),
                0 if "posterior" not in parts else len(parts["posterior"].noise),
            )
        )
        return cls(
            config,
            {name: arrays[name] for name in weights},
            curve_from_tensor(arrays["curve"]),
            arrays["foreshortening"].item(),
            cameras,
            removal,
            capture,
            outliers,
            parts.get("skeleton"),
            parts.get("structures"),
            parts.get("posterior"),
        )
