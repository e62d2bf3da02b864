"""Parameters of requests for answers in the room instead of canonical frames of reference."""

from typing import Annotated

from fastapi import Query
from pydantic import TypeAdapter, ValidationError

from models.settings.rooms import FrameOfReference, Up
from service.http.errors import invalid

FRAME_OF_REFERENCE = (
    "Frame of reference of points and cameras: `canonical`, centred and turning with the subject, "
    "or `room`, that of the model's static cameras, in which a walking subject walks."
)
UP = (
    "The direction of up in frame `room`. The y axis then points up, and the origin is on the "
    "floor if keypoints are named as feet. `auto`, estimated from the frames of the fit, or a "
    "vector (x, y, z) in the frame of reference without `up`. An imported model, and one whose fit "
    "was deleted, have no such frames: `up` must be a vector, and there is no floor. Without `up` "
    "the frame is that of the first static camera (x right, y down, z forward), or of the given "
    "poses."
)
UP_QUERY = f"{UP} In a query: `up=auto` or `up=0,-1,0`."
FrameQuery = Annotated[FrameOfReference | None, Query(description=FRAME_OF_REFERENCE)]
UpQuery = Annotated[str | None, Query(max_length=100, description=UP_QUERY)]

_UP: TypeAdapter[Up] = TypeAdapter(Up)


def read_up(text: str | None) -> Up | None:
    """Return the direction of up in a query.

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
    """Return whether answers are wanted in the room; raise ``ApiError`` for up without a room."""
    if frame != "room" and up is not None:
        raise invalid("/up", "up needs frame=room: give that too, or leave up out")
    return frame == "room"
