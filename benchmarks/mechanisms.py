"""The mechanisms of fits and lifts that `benchmarks/ablation.py` switches off, one at a time.

A mechanism is off while the functions that other code calls are replaced: what stays
behind is what the code did if the mechanism did not exist. Nothing in `models` knows of this.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.switching import GEOMETRY, LIFT, NETWORK, Mechanism, Part
from models.bundle.problem import make_shape_prior
from models.calibrating.likely_lenses import RefinedCameras
from models.capture.score_mixture import standard_normal
from models.lifting.explanations import Refiner
from models.lifting.frame_refinement import make_refiner
from models.lifting.skeleton_lengths import no_lengths
from models.network.settling import SETTLE_ALL
from models.numerics.steps import Steps


def _refiner(**changes: Callable[[Refiner, Any], Any]) -> Part:
    """Return `make_refiner` with fields that functions make of the refiner and its calibration."""

    def make(calibration: Any, *args: Any, **kwargs: Any) -> Refiner:
        refiner = make_refiner(calibration, *args, **kwargs)
        fields = {name: change(refiner, calibration) for name, change in changes.items()}
        return refiner._replace(**fields)

    return Part("models.lifting.fitted_prior", "make_refiner", make)


def _first(first: Any, *_: Any, **__: Any) -> Any:
    """Return the first argument."""
    return first


def _steps(choose: Callable[..., Any]) -> Callable[..., Steps[Any]]:
    """Return a function of arguments as steps."""

    def steps(*args: Any, **kwargs: Any) -> Steps[Any]:
        return choose(*args, **kwargs)
        yield

    return steps


def _nothing(*_: Any, **__: Any) -> None:
    """Return None."""


def _no_pairs(*_: Any) -> np.ndarray[Any, np.dtype[np.int64]]:
    return np.zeros((0, 2), np.int64)


def _as_arranged(arranged: Any, _: float) -> RefinedCameras:
    problem, best, _doubts = arranged.checked
    return RefinedCameras(problem, best, arranged.kept, arranged.reason)


def _without_shapes(_: Any, profile: Any) -> list[Any]:
    return [
        walk._replace(places=[place._replace(shapes=0.0) for place in walk.places])
        for walk in profile.walks
    ]


CALIBRATING, EPIPOLAR = "models.calibrating", "models.epipolar"
SELF = f"{CALIBRATING}.self_calibration"

MECHANISMS = (
    Mechanism(
        "stray keypoints and second looks",
        LIFT,
        ("lifting/stray_keypoints.py", "lifting/second_looks.py", "lifting/rays.py"),
        (_refiner(rejecting=lambda *_: False),),
    ),
    Mechanism(
        "known structures of hidden keypoints",
        LIFT,
        ("lifting/neighbours.py", "bundle/known_structures.py", "training/known_structures.py"),
        (_refiner(known=lambda refiner, _: refiner.known._replace(believed=np.zeros(1))),),
    ),
    Mechanism(
        "lengths of a skeleton",
        LIFT,
        ("lifting/skeleton_lengths.py",),
        (_refiner(held=lambda *_: no_lengths()),),
    ),
    Mechanism(
        "unlikely places are left out",
        LIFT,
        ("lifting/usual_structure.py",),
        (Part("models.lifting.fitted_prior", "without_unlikely", _first),),
    ),
    Mechanism(
        "errors of the network as the prior",
        LIFT,
        ("training/network_errors.py",),
        (
            _refiner(
                prior=lambda _, found: make_shape_prior(
                    found.shapes.mean, found.shapes.basis, found.shapes.spread, heavy=False
                ),
                about_network=lambda *_: False,
                scales=lambda *_: np.ones(1),
            ),
        ),
    ),
    Mechanism(
        "frames that need no settling",
        LIFT,
        (),
        (Part("models.lifting.fitted_prior", "FittedPrior.settling", SETTLE_ALL),),
    ),
    Mechanism(
        "noise removal",
        GEOMETRY,
        (
            "capture/noise_removal.py",
            "capture/denoising.py",
            "capture/score_mixture.py",
            "capture/principal_curves.py",
            "capture/heavy_tails.py",
            "capture/motion.py",
        ),
        (),
        (("denoising", False),),
    ),
    Mechanism(
        "principal curves",
        GEOMETRY,
        ("capture/principal_curves.py",),
        (Part("models.capture.denoising", "learn_curves", _nothing),),
    ),
    Mechanism(
        "mixture of scores",
        GEOMETRY,
        ("capture/score_mixture.py",),
        (
            Part(
                "models.capture.denoising",
                "learn_mixture",
                lambda scores, _: standard_normal(scores.shape[1]),
            ),
        ),
    ),
    Mechanism(
        "heavy tails of noise",
        GEOMETRY,
        ("capture/heavy_tails.py",),
        (Part("models.capture.denoising", "learn_tails", lambda _: 0.0),),
    ),
    Mechanism(
        "smoothing in time",
        GEOMETRY,
        ("capture/motion.py", "capture/fixed_lag.py", "capture/known_poses.py"),
        (Part("models.capture.noise_removal", "learn_motion", _nothing),),
    ),
    Mechanism(
        "outliers of stacked views",
        GEOMETRY,
        ("capture/outliers.py", "capture/outlier_kernels.py", "capture/swapped_keypoints.py"),
        (),
        (("outlier_rejection", False),),
    ),
    Mechanism(
        "exchanged keypoints put right",
        GEOMETRY,
        ("capture/swapped_keypoints.py",),
        (Part("models.capture.outliers", "find_pairs", _no_pairs),),
    ),
    Mechanism(
        "views put in step",
        GEOMETRY,
        (
            "epipolar/synchronisation.py",
            "epipolar/coarse_offsets.py",
            "epipolar/offset_refinement.py",
            "epipolar/held_out_offsets.py",
            "epipolar/offset_judgement.py",
        ),
        (),
        (("synchronise", "off"),),
    ),
    Mechanism(
        "cameras by keypoints as detected",
        GEOMETRY,
        ("calibrating/detected_rig.py", "bundle/instrumental_equations.py"),
        (Part(SELF, "_by_detected", _steps(_nothing)),),
    ),
    Mechanism(
        "cameras by bones and clear keypoints",
        GEOMETRY,
        ("bundle/bone_lengths.py",),
        (Part(SELF, "_by_clear", _steps(lambda refined: refined.best)),),
    ),
    Mechanism(
        "other camera models",
        GEOMETRY,
        ("calibrating/likely_lenses.py",),
        (Part(SELF, "with_likely_lenses", _steps(_as_arranged)),),
    ),
    Mechanism(
        "close fit to clear keypoints",
        GEOMETRY,
        (),
        (Part(SELF, "_exact", _steps(lambda _, best, sds: (best, sds))),),
    ),
    Mechanism(
        "kinds of lens",
        GEOMETRY,
        ("calibrating/lens_groups.py",),
        (
            Part(
                f"{CALIBRATING}.geometry_first",
                "lens_kinds",
                lambda problem, _: problem.lens_groups,
            ),
        ),
    ),
    Mechanism(
        "posterior of a pair's lenses",
        GEOMETRY,
        (
            "calibrating/pair_lenses.py",
            "calibrating/lens_profile.py",
            "calibrating/lens_posterior.py",
            "calibrating/lens_evidence.py",
            "calibrating/shape_evidence.py",
            "calibrating/bagging.py",
        ),
        (
            Part(
                f"{CALIBRATING}.geometry_first",
                "settle_lenses",
                _steps(lambda problem, found: (problem, found)),
            ),
        ),
    ),
    Mechanism(
        "evidence of shapes for a pair's lenses",
        GEOMETRY,
        ("calibrating/lens_evidence.py", "calibrating/shape_evidence.py"),
        (Part(f"{CALIBRATING}.pair_lenses", "with_shapes", _steps(_without_shapes)),),
    ),
    Mechanism(
        "information that frames repeat",
        GEOMETRY,
        ("calibrating/bagging.py",),
        (Part(f"{CALIBRATING}.lens_profile", "share_of_information", lambda *_, **__: 1.0),),
    ),
    Mechanism(
        "pairs of views that move",
        GEOMETRY,
        (),
        (Part(f"{EPIPOLAR}.static_rig", "moving_pairs", lambda *_: set()),),
    ),
    Mechanism(
        "focal lengths of views that move",
        GEOMETRY,
        ("calibrating/moving_lenses.py",),
        (
            Part(
                f"{CALIBRATING}.arrangement_search",
                "scanned_views",
                lambda *_: np.zeros(0, np.int64),
            ),
        ),
    ),
    Mechanism(
        "boxes",
        GEOMETRY,
        ("capture/boxes.py",),
        (Part(f"{CALIBRATING}.arrangement_search", "expecting_boxes", _first),),
    ),
    Mechanism(
        "steps along teachers",
        NETWORK,
        ("training/teachers.py", "training/virtual_views.py"),
        (),
        (("distillation", False),),
    ),
    Mechanism(
        "virtual views",
        NETWORK,
        ("training/virtual_views.py",),
        (Part("models.training.batches", "_virtual_share", lambda *_, **__: 0.0),),
    ),
    Mechanism(
        "views dropped in training",
        NETWORK,
        (),
        (Part("models.training.batches", "drop_views", _first),),
    ),
)
