"""A self-calibration as tensors and a line of text, for files."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError

from models.bundle.problem import RADIAL_2, VIEW, make_rig
from models.bundle.shape_model import NetworkErrors, ShapeModel
from models.calibrating.result import SelfCalibration
from models.findings.catalogue import FindingCode
from models.findings.finding import Finding
from models.network.settling import SETTLE_ALL, settle_beyond
from models.numerics.tensor_files import Arrays, Shapes, WeightsError
from models.optics.lenses.projection import COEFFICIENTS, LENSES, Lenses, index_of

Float64 = NDArray[np.float64]

# The beginnings of warnings in versions without findings, and the codes they have today.
OLD_WARNINGS: dict[str, FindingCode] = {
    "the given poses": "calibration_disagrees",
    "the known length": "known_length_disagrees",
}
NOT_ORTHONORMAL = 1e-3  # largest deviation of rotations that rounding explains
OF_ALL_VIEWS = ("shape_mean", "shape_basis", "doubt_basis", "doubt_scales", "numbers")


def to_arrays(calibration: SelfCalibration) -> tuple[Arrays, str]:
    """Return a self-calibration as tensors and a line of text, for a file."""
    rig, lenses = calibration.rig, calibration.rig.lenses
    shapes, errors = calibration.shapes, calibration.network_errors
    settling = calibration.settling
    misfit_limit = 0.0 if settling.every_frame else settling.misfit_limit
    arrays: dict[str, Any] = {
        "focals": lenses.focals,
        "centres": lenses.centres,
        "distortion": lenses.distortion,
        "groups": rig.groups,
        "extrinsic_rotations": rig.rotations,
        "extrinsic_translations": rig.translations,
        "deviations": calibration.deviations,
        "errors": calibration.reprojection_errors,
        "shape_mean": shapes.mean,
        "shape_basis": shapes.basis,
        "doubt_basis": errors.basis,
        "doubt_scales": errors.scales,
        "numbers": [
            shapes.spread,
            errors.spread,
            misfit_limit,
            calibration.noise,
            calibration.unit,
        ],
    }
    words = {
        "reason": calibration.reason,
        "findings": [finding.model_dump(mode="json") for finding in calibration.findings],
        "lenses": [LENSES[model].NAME for model in lenses.models],
        "stretched": rig.stretched.tolist(),
        "handedness_certainty": _finite(calibration.handedness_certainty),
    }
    tensors = {n: torch.from_numpy(np.array(a, np.float64, order="C")) for n, a in arrays.items()}
    return tensors, json.dumps(words)


def array_shapes(words: str, keypoints: int, views: int | None) -> Shapes:
    """Return the shapes of the tensors that go with a line of text; None allows any length.

    Files of versions with two camera models have a tensor "fisheye" (K,), 0 or 1, and no names of
    models in the text. Deviations of versions that estimated one radial coefficient have one number
    less for each view.

    Raises
    ------
    WeightsError
        When the text is not of this format.
    """
    shapes: Shapes = {
        "focals": (views, 2),
        "centres": (views, 2),
        "distortion": (views, COEFFICIENTS),
        "groups": (views,),
        "extrinsic_rotations": (views, 3, 3),
        "extrinsic_translations": (views, 3),
        "deviations": (views, None),
        "errors": (views,),
        "shape_mean": (keypoints, 3),
        "shape_basis": (keypoints, 3, None),
        "doubt_basis": (keypoints, 3, None),
        "doubt_scales": (None,),
        "numbers": (5,),
    }
    return shapes if "lenses" in _read_words(words) else {**shapes, "fisheye": (views,)}


def from_arrays(arrays: Arrays, words: str) -> SelfCalibration:
    """Read the result of `to_arrays`, of this version or an older one.

    Raises
    ------
    WeightsError
        When the tensors contradict each other or the text is not of this format.
    """
    fields = _read_words(words)
    a: dict[str, Float64] = {
        name: value.to(torch.float64).numpy().copy() for name, value in arrays.items()
    }
    if not all(len(a[name]) == len(a["groups"]) for name in a if name not in OF_ALL_VIEWS):
        raise WeightsError("the file contradicts itself about the cameras")
    groups, deviations = a["groups"].astype(np.int64), a["deviations"]
    models = _lens_models(fields, a)
    spread, error_spread, misfit_limit, noise, unit = a["numbers"].tolist()
    consistent = (
        len(models) == len(groups) > 0
        and deviations.shape[1] in (VIEW - 1, VIEW)
        and np.array_equal(np.unique(groups), np.arange(int(groups.max()) + 1))
        and bool((a["focals"] > 0).all())
        and bool((deviations >= 0).all() and (a["errors"] >= 0).all())
        and _are_rotations(a["extrinsic_rotations"])
        and bool((a["doubt_scales"] > 0).all())
        and min(spread, error_spread, noise, unit) > 0
        and misfit_limit >= 0
        and math.isfinite(spread + error_spread + misfit_limit + noise + unit)
    )
    if not consistent:
        raise WeightsError("the file contradicts itself about the cameras")
    lenses = Lenses(a["focals"], a["centres"], a["distortion"], models)
    if deviations.shape[1] < VIEW:  # the second radial coefficient was kept
        deviations = np.insert(deviations, RADIAL_2, 0, axis=1)
    return SelfCalibration(
        make_rig(
            lenses,
            groups,
            a["extrinsic_rotations"],
            a["extrinsic_translations"],
            _stretched(fields, len(groups)),
        ),
        deviations,
        ShapeModel(a["shape_mean"], a["shape_basis"], spread),
        NetworkErrors(a["doubt_basis"], error_spread, a["doubt_scales"]),
        settle_beyond(misfit_limit) if misfit_limit > 0 else SETTLE_ALL,
        noise,
        unit,
        a["errors"],
        str(fields["reason"]),
        _findings(fields),
        _certainty(fields),
    )


def _are_rotations(matrices: Float64) -> bool:
    """Whether matrices (K, 3, 3) are orthonormal, with determinant 1."""
    products = matrices @ matrices.transpose(0, 2, 1)
    return bool(
        (np.abs(products - np.eye(3)) < NOT_ORTHONORMAL).all()
        and (np.linalg.det(matrices) > 0).all()
    )


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _certainty(fields: dict[str, Any]) -> float:
    """Return the certainty of the handedness; NaN if the file has none."""
    certainty = fields.get("handedness_certainty")
    if certainty is None:
        return math.nan
    if not isinstance(certainty, int | float) or not 0 <= certainty <= 1:
        raise WeightsError("the file does not describe the cameras")
    return float(certainty)


def _stretched(fields: dict[str, Any], views: int) -> NDArray[np.bool_]:
    """Return which views (K,) are stretched; none in files of older versions."""
    stretched = fields.get("stretched", [False] * views)
    if not isinstance(stretched, list) or len(stretched) != views:
        raise WeightsError("the file contradicts itself about the cameras")
    return np.array([each is True for each in stretched], np.bool_)


def _read_words(words: str) -> dict[str, Any]:
    try:
        fields = json.loads(words)
        noticed = fields["findings"] if "findings" in fields else fields["warnings"]
        json.dumps(fields, ensure_ascii=False).encode()  # answers cannot have halves of characters
        complete = isinstance(fields["reason"], str) and isinstance(noticed, list)
    except (ValueError, KeyError, TypeError, RecursionError):
        complete = False
    if not complete:
        raise WeightsError("the file does not describe the cameras")
    return dict(fields)


def _findings(fields: Mapping[str, Any]) -> tuple[Finding, ...]:
    """Return the findings; from older versions, those warnings that have a code today."""
    try:
        if "findings" in fields:
            return tuple(Finding.model_validate(finding) for finding in fields["findings"])
    except ValidationError as error:
        raise WeightsError("the file holds findings that are not among those known") from error
    return tuple(
        Finding.of(code)
        for warning in fields["warnings"]
        for start, code in OLD_WARNINGS.items()
        if str(warning).startswith(start)
    )


def _lens_models(fields: Mapping[str, Any], arrays: Mapping[str, Float64]) -> NDArray[np.int8]:
    """Return the camera model (K,) of every view as a place in `LENSES`."""
    if "lenses" not in fields:
        names: list[Any] = [
            "fisheye" if is_one else "pinhole" for is_one in arrays["fisheye"] > 0.5
        ]
    else:
        names = list(fields["lenses"])
    known = [lens.NAME for lens in LENSES]
    if not all(name in known for name in names):
        raise WeightsError(f"the file holds camera models that are not among {known}")
    return np.array([index_of(name) for name in names], np.int8)
