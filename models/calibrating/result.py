"""What a fit found out about the cameras: for people, and as tensors in a file."""

import json
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from models.bundle.adjustment import Rig
from models.bundle.frame import OPTICS
from models.bundle.shape_model import Doubts, ShapeModel
from models.calibrating.self_calibration import Discovery
from models.network.settling import SETTLE_ALL, settle_beyond
from models.numerics.tensor_files import Arrays, Shapes, WeightsError
from models.optics.lenses import COEFFICIENTS, Optics

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class FoundCameras:
    """The K views of a fit; standard deviations are 0 for what was given and kept.

    Cameras at rest share one frame of reference: that of the first of them, or the one in which
    the user gave their poses.
    """

    arrangement: str  # "static", "moving" or "mixed"
    reason: str  # why, in words with figures
    warnings: tuple[str, ...]  # what does not fit, such as a calibration that is wrong
    fisheye: NDArray[np.bool_]  # (K,)
    focals: Float64  # (K, 2) pixels along x and y
    focal_sds: Float64  # (K,) pixels
    principal_points: Float64  # (K, 2) pixels
    principal_point_sds: Float64  # (K, 2) pixels
    distortions: Float64  # (K, 8) OpenCV's order
    distortion_sds: Float64  # (K,) of the first coefficient
    resting: NDArray[np.bool_]  # (K,)
    rotations: Float64  # (K, 3, 3) x_cam = R x + t; NaN for a view that does not rest
    rotation_sds: Float64  # (K,) degrees
    translations: Float64  # (K, 3) units of the structure; NaN for a view that does not rest
    translation_sds: Float64  # (K, 3)
    reprojection_errors: Float64  # (K,) pixels, mean over the frames it was found from
    noise: float  # pixels, standard deviation of a coordinate about the model


def report(found: Discovery) -> FoundCameras:
    """Return what was found in the words and units of the user."""
    rig, deviations = found.rig, found.deviations
    resting = found.resting
    focals = rig.optics.focals
    nothing = torch.nan
    at_rest = resting[:, None]
    pose = deviations[:, OPTICS:]
    arrangement = "static" if bool(resting.all()) else "mixed" if bool(resting.any()) else "moving"
    return FoundCameras(
        arrangement=arrangement,
        reason=found.reason,
        warnings=found.warnings,
        fisheye=rig.optics.fisheye.numpy().copy(),
        focals=focals.numpy().copy(),
        focal_sds=(deviations[:, 0] * focals.mean(-1)).numpy(),
        principal_points=rig.optics.centres.numpy().copy(),
        principal_point_sds=deviations[:, 1:3].numpy().copy(),
        distortions=rig.optics.distortion.numpy().copy(),
        distortion_sds=deviations[:, 3].numpy().copy(),
        resting=resting.numpy(),
        rotations=torch.where(at_rest[..., None], rig.rotations, nothing).numpy(),
        rotation_sds=torch.where(
            resting, torch.rad2deg(pose[:, :3].square().sum(-1).sqrt()), nothing
        ).numpy(),
        translations=torch.where(at_rest, found.unit * rig.translations, nothing).numpy(),
        translation_sds=torch.where(at_rest, found.unit * pose[:, 3:], nothing).numpy(),
        reprojection_errors=found.errors.numpy().copy(),
        noise=found.noise,
    )


def to_arrays(found: Discovery) -> tuple[Arrays, str]:
    """Return a discovery as tensors and a line of text, for a file."""
    optics = found.rig.optics
    misfit_limit = 0.0 if found.settling.every_frame else found.settling.misfit_limit
    arrays = {
        "focals": optics.focals,
        "centres": optics.centres,
        "distortion": optics.distortion,
        "fisheye": optics.fisheye.to(torch.float64),
        "groups": found.rig.groups.to(torch.float64),
        "extrinsic_rotations": found.rig.rotations,
        "extrinsic_translations": found.rig.translations,
        "deviations": found.deviations,
        "errors": found.errors,
        "shape_mean": found.shapes.mean,
        "shape_basis": found.shapes.basis,
        "doubt_basis": found.doubts.basis,
        "doubt_scales": found.doubts.scales,
        "numbers": torch.tensor(
            [found.shapes.spread, found.doubts.spread, misfit_limit, found.noise, found.unit],
            dtype=torch.float64,
        ),
    }
    words = json.dumps({"reason": found.reason, "warnings": found.warnings})
    return {name: value.contiguous() for name, value in arrays.items()}, words


def array_shapes(keypoints: int, views: int | None) -> Shapes:
    """Shapes of what `to_arrays` returns; None stands for any length."""
    return {
        "focals": (views, 2),
        "centres": (views, 2),
        "distortion": (views, COEFFICIENTS),
        "fisheye": (views,),
        "groups": (views,),
        "extrinsic_rotations": (views, 3, 3),
        "extrinsic_translations": (views, 3),
        "deviations": (views, 10),
        "errors": (views,),
        "shape_mean": (keypoints, 3),
        "shape_basis": (keypoints, 3, None),
        "doubt_basis": (keypoints, 3, None),
        "doubt_scales": (None,),
        "numbers": (5,),
    }


def from_arrays(arrays: Arrays, words: str) -> Discovery:
    """Read what `to_arrays` returned.

    Raises
    ------
    WeightsError
        When the tensors contradict each other or the text is not what was written.
    """
    try:
        said = json.loads(words)
        reason, warnings = str(said["reason"]), tuple(str(w) for w in said["warnings"])
    except (ValueError, KeyError, TypeError) as error:
        raise WeightsError("the file does not say what was found of the cameras") from error
    a = {name: value.to(torch.float64) for name, value in arrays.items()}
    groups = a["groups"].long()
    views = len(groups)
    spread, doubt, misfit_limit, noise, unit = a["numbers"].tolist()
    consistent = (
        views > 0
        and all(
            len(a[name]) == views
            for name in array_shapes(0, 0)
            if not name.startswith(("shape", "doubt", "numbers"))
        )
        and torch.equal(torch.unique(groups), torch.arange(int(groups.max()) + 1))
        and bool((a["focals"] > 0).all())
        and bool((a["doubt_scales"] > 0).all())
        and min(spread, doubt, noise, unit) > 0
        and misfit_limit >= 0
        and math.isfinite(spread + doubt + misfit_limit + noise + unit)
    )
    if not consistent:
        raise WeightsError("the file contradicts itself about the cameras")
    optics = Optics(a["focals"], a["centres"], a["distortion"], a["fisheye"] > 0.5)
    return Discovery(
        Rig(optics, groups, a["extrinsic_rotations"], a["extrinsic_translations"]),
        a["deviations"],
        ShapeModel(a["shape_mean"], a["shape_basis"], spread),
        Doubts(a["doubt_basis"], doubt, a["doubt_scales"]),
        settle_beyond(misfit_limit) if misfit_limit > 0 else SETTLE_ALL,
        noise,
        unit,
        a["errors"],
        reason,
        warnings,
    )
