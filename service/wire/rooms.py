"""How it is asked for answers in a room, and not in canonical frames of reference."""

from typing import Annotated

from fastapi import Query
from pydantic import TypeAdapter, ValidationError

from models.settings.rooms import FrameOfReference, Up
from service.http.errors import invalid

FRAME_OF_REFERENCE = (
    "Frame of reference of points and cameras: `canonical`, centred and turning with the subject, "
    "or `room`, that of the model's cameras at rest, in which a walking subject walks."
)
UP = (
    "Of frame `room`: has its y axis point up, and its origin on the floor if keypoints are named "
    "as feet. A vector (x, y, z) in the room as it is without, or `auto`: found from the frames "
    "of the fit. An imported model has none, nor has one whose fit was deleted: then `up` must be "
    "a vector, and there is no floor. Without `up` the room is the first resting camera's (x "
    "right, y down, z forward), or that of the poses which the fit was told."
)
UP_QUERY = f"{UP} In a query: `up=auto` or `up=0,-1,0`."
FrameQuery = Annotated[FrameOfReference | None, Query(description=FRAME_OF_REFERENCE)]
UpQuery = Annotated[str | None, Query(max_length=100, description=UP_QUERY)]

_UP: TypeAdapter[Up] = TypeAdapter(Up)


def read_up(text: str | None) -> Up | None:
    """Return what a query says of up.

    Raises
    ------
    ApiError
        422 if it is neither `auto` nor three numbers.
    """
    if text is None:
        return None
    try:
        return _UP.validate_python("auto" if text == "auto" else tuple(text.split(",")))
    except ValidationError as error:
        raise invalid(
            "/up", f"expected auto or a vector other than zero, such as 0,-1,0, got {text!r}"
        ) from error


def is_room(frame: FrameOfReference | None, up: Up | None) -> bool:
    """Tell whether answers are wanted in the room; raise ``ApiError`` for up without a room."""
    if frame != "room" and up is not None:
        raise invalid("/up", "up is of a room: ask for frame=room too, or leave it out")
    return frame == "room"
