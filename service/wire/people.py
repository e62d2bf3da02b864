"""Whom the views of a capture show, so that one can be chosen of each."""

from typing import Self

import numpy as np
from fewview.capture import ViewPeople
from pydantic import BaseModel, Field

from service.wire.schemas import Vector2

LONGEST_NAME = 200


class PersonPreview(BaseModel):
    """Somebody whom a view shows."""

    index: int = Field(description="The number that `person` has for them in this view.")
    name: str = Field(description="That of their track or individual; empty without.")
    frames: int = Field(description="In how many frames of the view they are seen.")
    picked: bool = Field(description="Whether they are the one of this view in the capture.")
    keypoints: list[Vector2 | None] = Field(
        description="A frame that shows them well: keypoints x (x, y), null where not observed."
    )


class ViewPeoplePreview(BaseModel):
    """Those whom a view shows."""

    edges: list[tuple[int, int]] = Field(description="Pairs of keypoints that are joined.")
    people: list[PersonPreview] = Field(description="Who is seen most first, 12 at most.")

    @classmethod
    def of(cls, view: ViewPeople) -> Self:
        """Return the wire form of those whom a reader saw."""
        people = [
            PersonPreview(
                index=one.index,
                name=one.name[:LONGEST_NAME],
                frames=one.frames,
                picked=one.picked,
                keypoints=[
                    point.tolist() if np.isfinite(point).all() else None for point in one.keypoints
                ],
            )
            for one in view.people
        ]
        return cls(edges=list(view.edges), people=people)
