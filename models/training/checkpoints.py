"""Checkpoints of a fit, as safetensors bytes."""

from typing import NamedTuple

import torch
from torch import Tensor

from models.calibrating.result import array_shapes, from_arrays, to_arrays
from models.calibrating.self_calibration import Discovery
from models.lifting.curve import CurvePoint
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, pack, read_about, unpack
from models.training.teachers import Teachers

TEACHERS, CAMERAS = "teachers.", "cameras."


class State(NamedTuple):
    """Numbers of a fit at one step."""

    step: float
    loss: float
    error: float
    steps: float  # this and the next two are the schedule's
    since: float
    done: float
    seconds: float  # this and the next two are the clock's
    pace: float
    lesson: float
    taught: float
    mirrored: float
    found_at: float
    given_up: float
    doubting: float
    least: float
    least_at: float
    hurries: float


class Checkpoint(NamedTuple):
    """A fit at one step."""

    weights: Tensor  # (W,) of the network
    moments: tuple[Tensor, Tensor]  # (W,) each, of Adam
    state: State
    curve: list[CurvePoint]
    teachers: Teachers | None
    found: Discovery | None


def write(checkpoint: Checkpoint, *, config: str, data: str) -> bytes:
    """Write a checkpoint of a fit of some configuration and data, both told apart by strings."""
    arrays: Arrays = {
        "weights": checkpoint.weights,
        "first_moment": checkpoint.moments[0],
        "second_moment": checkpoint.moments[1],
        "curve": torch.tensor(checkpoint.curve, dtype=torch.float64).reshape(-1, 3),
    }
    # Infinity is written as the largest number: files with anything else are taken for damaged.
    arrays["state"] = torch.tensor(checkpoint.state, dtype=torch.float64).nan_to_num()
    about = {"config": config, "data": data}
    if checkpoint.teachers is not None:
        about["teachers"] = str(len(checkpoint.teachers.points))
        for name, value in checkpoint.teachers._asdict().items():
            number = _number(value) if isinstance(value, float) else value
            arrays[f"{TEACHERS}{name}"] = number.double() if name == "places" else number
    if checkpoint.found is not None:
        cameras, about["cameras"] = to_arrays(checkpoint.found)
        arrays |= {f"{CAMERAS}{name}": value for name, value in cameras.items()}
    return pack(arrays, kind="checkpoint", about=about)


def read(
    written: bytes,
    *,
    config: str,
    data: str,
    numbers: int,
    shape: tuple[int, int, int],
) -> Checkpoint:
    """Read a checkpoint of the same configuration and data.

    `numbers` W of a network are expected, and N, K, P of the data.

    Raises
    ------
    WeightsError
        When it is damaged or was made for other data or another configuration.
    """
    about = read_about(written, kind="checkpoint")
    if about.get("config") != config:
        raise WeightsError("the checkpoint was made for another configuration; start anew")
    if about.get("data") != data:
        raise WeightsError("the checkpoint was made for other keypoints; start anew")
    shapes: Shapes = dict.fromkeys(("weights", "first_moment", "second_moment"), (numbers,))
    shapes |= {"curve": (None, 3), "state": (len(State._fields),)}
    frames, views, keypoints = shape
    if "teachers" in about:
        shapes |= {
            f"{TEACHERS}points": (None, keypoints, 3),
            f"{TEACHERS}rotations": (None, views, 3, 3),
            f"{TEACHERS}seen": (None, views),
            f"{TEACHERS}ups": (None, 3),
            f"{TEACHERS}places": (frames,),
            f"{TEACHERS}foreshortening": (1,),
            f"{TEACHERS}noise": (1,),
        }
    if "cameras" in about:
        for name, expected in array_shapes(keypoints, views).items():
            shapes[f"{CAMERAS}{name}"] = expected
    arrays = unpack(written, shapes=shapes)
    teachers = found = None
    if "teachers" in about:
        parts = _under(TEACHERS, arrays)
        teachers = Teachers(
            points=parts["points"],
            rotations=parts["rotations"],
            seen=parts["seen"],
            ups=parts["ups"],
            places=parts["places"].long(),
            foreshortening=parts["foreshortening"].item(),
            noise=parts["noise"].item(),
        )
    if "cameras" in about:
        found = from_arrays(_under(CAMERAS, arrays), about["cameras"])
    return Checkpoint(
        weights=arrays["weights"],
        moments=(arrays["first_moment"], arrays["second_moment"]),
        state=State(*arrays["state"].tolist()),
        curve=[CurvePoint(int(s), loss, error) for s, loss, error in arrays["curve"].tolist()],
        teachers=teachers,
        found=found,
    )


def _number(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def _under(prefix: str, arrays: Arrays) -> Arrays:
    """Return the arrays whose names begin with `prefix`, without it."""
    return {n.removeprefix(prefix): value for n, value in arrays.items() if n.startswith(prefix)}
