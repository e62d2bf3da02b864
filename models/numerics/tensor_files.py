"""Tensors and strings about them, to and from safetensors bytes; never a pickle."""

import json
import math
import struct
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

FORMAT = "fewview/1"
MAX_HEADER = 1_000_000  # bytes; ours are a few thousand

Arrays = dict[str, Tensor]
Shapes = dict[str, tuple[int | None, ...]]
Part = TypeVar("Part")


class WeightsError(ValueError):
    """Bytes that are not the expected weights or checkpoint; the message explains why."""


def pack(arrays: Arrays, *, kind: str, about: dict[str, str]) -> bytes:
    """Serialise `arrays` with `about` and the `kind` of file in the header."""
    contiguous = {name: value.detach().contiguous() for name, value in arrays.items()}
    # One entry: safetensors writes several in any order, and equal weights should be equal bytes.
    return save(contiguous, metadata={"fewview": json.dumps({**about, **_kind(kind)})})


def _kind(kind: str) -> dict[str, str]:
    return {"format": FORMAT, "kind": kind}


def read_about(data: bytes, *, kind: str) -> dict[str, str]:
    """Return the strings in the header, reading nothing else.

    Raises
    ------
    WeightsError
        When this is no safetensors file, or not one of this kind.
    """
    if len(data) < 8:
        raise WeightsError(f"expected a safetensors file, got {len(data)} bytes")
    (length,) = struct.unpack("<Q", data[:8])
    if length > min(MAX_HEADER, len(data) - 8):
        raise WeightsError("expected a safetensors file, but the header is cut off or not one")
    try:
        header = json.loads(data[8 : 8 + length])
        about = json.loads(header["__metadata__"]["fewview"])
        found = (about["format"], about["kind"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise WeightsError("expected a file written by fewview, got another one") from error
    if found != tuple(_kind(kind).values()):
        raise WeightsError(f"expected a {FORMAT} {kind}, got {found[0]} {found[1]}")
    return {str(key): str(value) for key, value in about.items()}


def unpack(data: bytes, *, shapes: Shapes) -> Arrays:
    """Return the tensors of a file, having checked that they are exactly those of `shapes`.

    A None in a shape allows any length. What is allocated never exceeds the length of `data`.

    Raises
    ------
    WeightsError
        When the file is damaged, tensors are missing, foreign, of another shape, or not finite.
    """
    try:
        arrays = load(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"the file is damaged: {error}") from error
    if arrays.keys() != shapes.keys():
        odd = ", ".join(sorted(arrays.keys() ^ shapes.keys())[:4])
        raise WeightsError(f"the file does not hold the expected tensors (see {odd})")
    for name, shape in shapes.items():
        found = tuple(arrays[name].shape)
        fits = len(found) == len(shape) and all(
            want in (None, got) for want, got in zip(shape, found, strict=True)
        )
        if not fits:
            raise WeightsError(f"{name} must have shape {shape}, got {found}")
        if arrays[name].dtype not in (torch.float32, torch.float64):
            raise WeightsError(f"{name} must hold floats, got {arrays[name].dtype}")
        if not math.isfinite(arrays[name].abs().sum().item()):
            raise WeightsError(f"{name} holds numbers that are not finite")
    return arrays


def as_tensors(numbers: Mapping[str, ArrayLike]) -> Arrays:
    """Return numbers and arrays as tensors in float64, single numbers with the shape (1,)."""
    return {
        name: torch.from_numpy(np.array(value, np.float64, ndmin=1, order="C"))
        for name, value in numbers.items()
    }


def prefixed(prefix: str, parts: dict[str, Part]) -> dict[str, Part]:
    """Return tensors, or their shapes, under names that begin with a prefix."""
    return {f"{prefix}{name}": part for name, part in parts.items()}


def without_prefix(prefix: str, arrays: Arrays) -> Arrays:
    """Return the tensors whose names begin with a prefix, under their names without it."""
    chosen = ((name, array) for name, array in arrays.items() if name.startswith(prefix))
    return {name.removeprefix(prefix): array for name, array in chosen}
