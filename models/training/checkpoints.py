"""Checkpoints of a fit, as safetensors bytes: single numbers in the header, arrays as tensors."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor

from models.calibrating.image_sizes import ImageSizes
from models.calibrating.result import SelfCalibration
from models.calibrating.result_files import array_shapes, from_arrays, to_arrays
from models.capture.observations import Observations
from models.lifting.curve import CurveRow, curve_from_tensor, curve_to_tensor
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
from models.settings.config import FitConfig
from models.training.state import TrainerState, state_from_json, state_to_json
from models.training.teachers import Teachers

TEACHERS, CAMERAS = "teachers.", "cameras."  # before the names of their arrays
MOMENTS = ("first_moment", "second_moment")


class Checkpoint(NamedTuple):
    """A fit at one step."""

    weights: Tensor  # (W,) of the network
    moments: tuple[Tensor, Tensor]  # (W,) each, of Adam
    state: TrainerState
    curve: Sequence[CurveRow]
    teachers: Teachers | None
    self_calibration: SelfCalibration | None


def fingerprint(
    observations: Observations,
    times: NDArray[np.float64] | None,
    image_sizes: ImageSizes | None,
    edges: NDArray[np.int64],
) -> str:
    """Return what identifies the data of a fit."""
    digest = hashlib.sha256(repr(image_sizes and [s and tuple(s) for s in image_sizes]).encode())
    arrays: list[NDArray[Any]] = [observations.keypoints, observations.weights]
    arrays += [] if times is None else [times]
    arrays += [edges] if len(edges) else []
    for array in arrays:
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def write(
    checkpoint: Checkpoint, *, config: FitConfig, data: str, known: NDArray[np.bool_]
) -> bytes:
    """Write a checkpoint of a fit of a configuration.

    `data` identifies its keypoints, of which the network has the `known` (P,).
    """
    arrays: Arrays = {
        "weights": checkpoint.weights,
        **dict(zip(MOMENTS, checkpoint.moments, strict=True)),
        "curve": curve_to_tensor(checkpoint.curve),
    }
    about = {
        "config": config.model_dump_json(),
        "data": data,
        "known": json.dumps(known.tolist()),
        "state": state_to_json(checkpoint.state),
    }
    if checkpoint.teachers is not None:
        about["teachers"] = str(len(checkpoint.teachers.points))
        parts = checkpoint.teachers._asdict().items()
        arrays |= prefixed(TEACHERS, {name: _as_floats(value) for name, value in parts})
    if checkpoint.self_calibration is not None:
        cameras, about["cameras"] = to_arrays(checkpoint.self_calibration)
        arrays |= prefixed(CAMERAS, cameras)
    return pack(arrays, kind="checkpoint", about=about)


def read(
    written: bytes,
    *,
    config: FitConfig,
    data: str,
    weights: int,
    shape: tuple[int, int, int],
) -> Checkpoint:
    """Read a checkpoint of the same configuration and data.

    `weights` is the number W of the network's weights, `shape` are N, K and P of the data.

    Raises
    ------
    WeightsError
        When it is damaged, was written by another version, or was made for other data or another
        configuration.
    """
    about = read_about(written, kind="checkpoint")
    if _config_of(about) != config:
        raise WeightsError("the checkpoint was made for another configuration; start anew")
    if about.get("data") != data:
        raise WeightsError("the checkpoint was made for other keypoints; start anew")
    state = state_from_json(about.get("state", ""))
    frames, views, keypoints = shape
    shapes: Shapes = dict.fromkeys(("weights", *MOMENTS), (weights,))
    shapes["curve"] = (None, 3)
    if "teachers" in about:
        shapes |= prefixed(TEACHERS, _teacher_shapes(frames, views, keypoints))
    if "cameras" in about:
        shapes |= prefixed(CAMERAS, array_shapes(about["cameras"], keypoints, views))
    arrays = unpack(written, shapes=shapes)
    teachers = found = None
    if "teachers" in about:
        teachers = _read_teachers(without_prefix(TEACHERS, arrays))
    if "cameras" in about:
        found = from_arrays(without_prefix(CAMERAS, arrays), about["cameras"])
    first, second = (arrays[name] for name in MOMENTS)
    return Checkpoint(
        weights=arrays["weights"],
        moments=(first, second),
        state=state,
        curve=curve_from_tensor(arrays["curve"]),
        teachers=teachers,
        self_calibration=found,
    )


def known_keypoints(written: bytes, keypoints: int) -> NDArray[np.bool_]:
    """Return which of P keypoints the network of a checkpoint has, (P,).

    Raises
    ------
    WeightsError
        When it is damaged, was written by another version, or was made for other keypoints.
    """
    about = read_about(written, kind="checkpoint")
    try:
        known = np.array(json.loads(about["known"]), np.bool_).reshape(-1)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise WeightsError("the checkpoint was written by another version; start anew") from error
    if len(known) != keypoints:
        raise WeightsError("the checkpoint was made for other keypoints; start anew")
    return known


def _config_of(about: Mapping[str, str]) -> FitConfig | None:
    """Return the configuration of a header, with defaults for fields that are newer."""
    try:
        return FitConfig.model_validate_json(about.get("config", ""))
    except ValidationError:
        return None


def _teacher_shapes(frames: int, views: int, keypoints: int) -> Shapes:
    return {
        "points": (None, keypoints, 3),
        "rotations": (None, views, 3, 3),
        "observed": (None, views),
        "up_axes": (None, 3),
        "taught": (frames,),
        "indices": (frames,),
        "foreshortening": (1,),
        "noise": (1,),
    }


def _read_teachers(parts: Arrays) -> Teachers:
    return Teachers(
        points=parts["points"],
        rotations=parts["rotations"],
        observed=parts["observed"],
        up_axes=parts["up_axes"],
        taught=parts["taught"].bool(),
        indices=parts["indices"].long(),
        foreshortening=parts["foreshortening"].item(),
        noise=parts["noise"].item(),
    )


def _as_floats(value: Tensor | float) -> Tensor:
    """Return a field of the teachers as stored in files: a tensor of floats."""
    if isinstance(value, Tensor):
        return value if value.is_floating_point() else value.double()
    return torch.tensor([value], dtype=torch.float64)
