"""The frame of reference of answers. Imports no torch."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from typing_extensions import TypeAliasType

from models.settings.unions import refused_with

FrameOfReference = TypeAliasType("FrameOfReference", Literal["canonical", "room"])
# `upright`: the room with y up, estimated from the frames of the fit.
BestFrame = TypeAliasType("BestFrame", Literal["canonical", "room", "upright"])
_Number = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
_Vector = tuple[_Number, _Number, _Number]


def _is_a_direction(vector: _Vector) -> _Vector:
    if not any(vector):
        raise ValueError("zero has no direction")
    return vector


# Up in the room: estimated, or (x, y, z) in the frame of reference of the model's cameras.
Up = Annotated[
    Literal["auto"] | Annotated[_Vector, AfterValidator(_is_a_direction)],
    refused_with(
        "expected 'auto' or a vector (x, y, z) other than zero, its numbers from -1e6 to 1e6"
    ),
]
