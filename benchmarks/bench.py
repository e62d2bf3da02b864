"""A capture, the fits made to it, and how they are scored: what the cases of fidelity share."""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Found, Report, Row
from benchmarks.rig import Rig
from models.capture.metrics import Accuracy, pa_mpjpe, pck
from models.capture.observations import as_observations
from models.capture.triangulation import triangulate
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.settings.config import FitConfig, Refine
from models.training.trainer import fit

PCK_MM = 100.0  # the paper's threshold
Float = NDArray[np.floating[Any]]
Float64 = NDArray[np.float64]
Views = tuple[int, ...]
Key = tuple[Any, ...]


@dataclass(frozen=True)
class Fit:
    """A fitted prior and how long it took."""

    prior: FittedPrior
    seconds: float

    @property
    def focal(self) -> float | None:
        """The mean focal length that it found, pixels."""
        cameras = self.prior.cameras
        return None if cameras is None else float(cameras.focals.mean())


@dataclass
class Bench:
    """A capture, what is asked of it, and the fits made so far."""

    keypoints: Float  # (N, K, P, 2) pixels
    given_confidence: Float | None  # (N, K, P)
    truth: Float  # (N, P, 3)
    sizes: list[tuple[int, int]] | None  # of the images, one per view
    edges: Any  # (E, 2) of the skeleton, or None
    config: FitConfig
    metre: float  # in the unit of the truth
    pair: Views
    full: bool
    report: Report
    rig: Rig | None
    partners: NDArray[np.intp]  # (P,) left and right keypoints; a keypoint itself if it has none
    times: Float64 | None = None  # (N,) seconds, if frames follow each other
    fits: dict[Key, Fit] = field(default_factory=dict)

    def __post_init__(self) -> None:
        seen = as_observations(self.keypoints, self.given_confidence)
        self.usable: NDArray[np.bool_] = seen.usable  # (N, K), before anything is spoilt
        self.views: Views = tuple(range(self.usable.shape[1]))
        self.sets = [self.pair, self.views] if len(self.views) > 2 else [self.views]

    def fit(
        self,
        seed: int,
        views: Views,
        *,
        keypoints: Float | None = None,
        frames: NDArray[np.int64] | None = None,
        sized: bool = True,
        timed: bool = False,
        key: str = "",
        **changes: Any,
    ) -> Fit:
        """Fit to some views; `key` identifies keypoints and frames other than the capture's.

        `timed`: the fit gets the times of the frames.
        """
        config = self.config.model_copy(update={"seed": seed, **changes})
        name: Key = (views, key, sized, timed, config)
        if name not in self.fits:
            pixels = self.keypoints if keypoints is None else keypoints
            which = slice(None) if frames is None else frames
            sizes = None if self.sizes is None or not sized else [self.sizes[v] for v in views]
            started = time.perf_counter()
            prior = fit(
                pixels[which][:, views],
                config,
                confidence=self.confidence(views, which),
                times=self.times[which] if timed and self.times is not None else None,
                image_sizes=sizes,
                edges=self.edges,
            )
            self.fits[name] = Fit(prior, time.perf_counter() - started)
        return self.fits[name]

    def confidence(self, views: Views, which: slice | NDArray[np.int64]) -> Float | None:
        """Return the confidence of some views in some frames."""
        all_of_it = self.given_confidence
        return None if all_of_it is None else all_of_it[which][:, views]

    def lift(
        self,
        fitted: Fit,
        views: Views,
        *,
        keypoints: Float | None = None,
        known_as: Views | None = None,
        unknown: bool = False,
        timed: bool = False,
        refine: Refine | None = None,
    ) -> LiftedFrames:
        """Lift every frame from some views; `known_as` are their numbers in the fit.

        `unknown`: as cameras that the fit does not know. `timed`: with the times of the frames.
        """
        pixels = self.keypoints if keypoints is None else keypoints
        return fitted.prior.lift(
            pixels[:, views],
            confidence=self.confidence(views, slice(None)),
            views=None if unknown else views if known_as is None else known_as,
            times=self.times if timed else None,
            refine=refine,
        )

    def showing(self, views: Views, least: int) -> NDArray[np.bool_]:
        """Return which frames (N,) show at least so many of these views."""
        return np.asarray(self.usable[:, views].sum(1) >= least)

    def score(
        self,
        case: str,
        how: str,
        views: Views,
        points: Float,
        which: NDArray[np.bool_],
        *,
        seed: int,
        level: float | None = None,
        fitted: Fit | None = None,
        found: Found | None = None,
    ) -> Accuracy | None:
        """Add a row for the frames that are asked for, if any has an answer."""
        accuracy = pa_mpjpe(points[which], self.truth[which], reflection="never")
        frames = int(np.isfinite(accuracy.per_frame).sum())
        if not frames:
            return None
        self.report.add(
            Row(
                case=case,
                how=how,
                views=views,
                level=level,
                seed=seed,
                error_mm=1000 / self.metre * accuracy.mean,
                pck=pck(accuracy, PCK_MM * self.metre / 1000),
                frames=frames,
                fit_seconds=None if fitted is None else fitted.seconds,
                focal=None if fitted is None else fitted.focal,
                found=found,
            )
        )
        return accuracy

    def triangulated(self, views: Views, projections: Float, keypoints: Float) -> Float:
        """Return what TRNG makes of some views of calibrated cameras."""
        return triangulate(keypoints[:, views], projections).points3d
