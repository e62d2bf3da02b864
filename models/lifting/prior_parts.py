"""The parts that the file of a prior may hold besides its network."""

from collections.abc import Callable
from typing import Any, NamedTuple

from models.bundle.known_structures import KnownStructures
from models.calibrating.result_files import array_shapes, from_arrays
from models.capture.denoising import Denoiser
from models.capture.motion import MotionModel
from models.capture.outliers import OutlierModel
from models.lifting.skeleton_lengths import SkeletonLengths
from models.numerics.tensor_files import Arrays, Shapes
from models.posterior.posterior import Posterior


class Part(NamedTuple):
    """A part, as arrays whose names begin with that of the part."""

    shapes: Callable[[], Shapes]  # of its arrays
    read: Callable[[Arrays], Any]


def parts_of(about: dict[str, str], keypoints: int) -> dict[str, Part]:
    """Return all parts that a file may hold, by name; its header lists those it has."""
    return {
        "cameras": Part(
            lambda: array_shapes(about["cameras"], keypoints, None),
            lambda arrays: from_arrays(arrays, about["cameras"]),
        ),
        "denoiser": Part(
            lambda: Denoiser.shapes(keypoints, about["denoiser"]),
            Denoiser.from_arrays,
        ),
        "motion": Part(lambda: MotionModel.shapes(keypoints), MotionModel.from_arrays),
        "outliers": Part(
            lambda: OutlierModel.shapes(keypoints, about["outliers"]),
            OutlierModel.from_arrays,
        ),
        "skeleton": Part(
            SkeletonLengths.shapes,
            lambda arrays: SkeletonLengths.from_arrays(arrays, keypoints),
        ),
        "structures": Part(lambda: KnownStructures.shapes(keypoints), KnownStructures.from_arrays),
        "posterior": Part(
            lambda: Posterior.shapes_in_files(keypoints, about["posterior"]), Posterior.from_arrays
        ),
    }
