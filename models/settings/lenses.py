"""What people know of a lens without calibrating it. Imports no torch."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import TypeAliasType

Axis = TypeAliasType("Axis", Literal["horizontal", "vertical", "diagonal"])
Sizes = Sequence[tuple[int, int] | None]  # (width, height) in pixels

FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm, of 35 mm film
USUAL_SD = 0.05  # share of the focal length: of sheets of devices, and of what people measure


class Lens(BaseModel):
    """What is known of one view's lens: its focal length, in one of four ways."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"equivalent": 26},
                {"field_of_view": 78},
                {"field_of_view": 120, "axis": "diagonal", "sd": 0.1},
                {"focal": 1460},
                {"same_as": 0},
            ]
        },
    )

    equivalent: float | None = Field(
        default=None,
        ge=4,
        le=3000,
        description="Equivalent focal length of 35 mm film, by the diagonal, in mm: 26 for most"
        " main cameras of phones.",
    )
    field_of_view: float | None = Field(
        default=None, ge=0.5, le=170, description="Degrees from one side of the image to the other."
    )
    axis: Axis = Field(
        default="horizontal",
        description="The sides between which `field_of_view` is: `horizontal`, `vertical`, or the"
        " corners (`diagonal`).",
    )
    focal: float | None = Field(default=None, gt=1, le=1e6, description="Focal length, pixels.")
    same_as: Annotated[int, Field(ge=0, le=63)] | None = Field(
        default=None,
        description="A view, from 0, that was filmed with the same lens and zoom. Views that are"
        " the same as no other then count as unlike, unless `cameras_alike` is true.",
    )
    sd: float = Field(
        default=USUAL_SD,
        gt=0,
        le=1,
        description="Standard deviation of the focal length, as a share of it. Not of `same_as`.",
    )

    @model_validator(mode="after")
    def _has_one_way(self) -> Self:
        ways = ("equivalent", "field_of_view", "focal", "same_as")
        given = [way for way in ways if getattr(self, way) is not None]
        if len(given) != 1:
            raise ValueError(
                f"a lens needs one of {', '.join(ways)}, got {' and '.join(given) or 'none'}"
            )
        return self

    def pixels(self, size: tuple[int, int] | None) -> float:
        """Return its focal length in pixels of an image (width, height), unless it is `same_as`.

        Raises
        ------
        ValueError
            If it takes the size of the image to know, and there is none.
        """
        if self.focal is not None:
            return self.focal
        if size is None:
            raise ValueError(
                "a focal length in mm or a field of view needs the size of the view's image: give"
                " the dataset's image_sizes, or the focal length in pixels"
            )
        diagonal = math.hypot(*size)
        if self.equivalent is not None:
            return self.equivalent * diagonal / FILM_DIAGONAL
        extents = {"horizontal": size[0], "vertical": size[1], "diagonal": diagonal}
        angle = math.radians(self.field_of_view or 0.0)
        return extents[self.axis] / 2 / math.tan(angle / 2)


class KnownLens(NamedTuple):
    """A focal length that is known roughly."""

    focal: float  # pixels
    sd: float  # its standard deviation, as a share of it


def lens_of_each_view(lenses: Sequence[Lens | None], views: int) -> tuple[Lens | None, ...]:
    """Return an entry for each view; a single one counts for all.

    Raises
    ------
    ValueError
        If there are more or fewer.
    """
    if len(lenses) == 1:
        return tuple(lenses) * views
    if len(lenses) != views:
        raise ValueError(
            f"lenses must have one entry, or one per view ({views}), got {len(lenses)}"
        )
    return tuple(lenses)


def alike_views(lenses: Sequence[Lens | None]) -> list[int]:
    """Return the group of each view: views of one number were filmed with the same lens.

    Raises
    ------
    LensError
        If a view is the same as itself, or as one that there is not.
    """
    groups = list(range(len(lenses)))
    for view, lens in enumerate(lenses):
        other = None if lens is None else lens.same_as
        if other is None:
            continue
        if other == view or other >= len(lenses):
            raise LensError(
                view, f"same_as must name another view, from 0 to {len(lenses) - 1}, got {other}"
            )
        joined, gone = sorted((groups[view], groups[other]))
        groups = [joined if group == gone else group for group in groups]
    return groups


def known_lenses(lenses: Sequence[Lens | None], sizes: Sizes) -> list[KnownLens | None]:
    """Return the focal length of each view in pixels of its image; None where nothing is known.

    A view that is the `same_as` others has theirs, as large in its image as in theirs.

    Raises
    ------
    LensError
        If the size of an image is not known that must be.
    """
    found: list[KnownLens | None] = []
    for view, lens in enumerate(lenses):
        known = lens is not None and lens.same_as is None
        found.append(_in_pixels(view, lens, sizes[view]) if known and lens else None)
    groups = alike_views(lenses)
    for view, group in enumerate(groups):
        like = [k for k, known in enumerate(found) if known is not None and groups[k] == group]
        if found[view] is None and like:
            found[view] = _as_large(view, found[like[0]], sizes[view], sizes[like[0]])
    return found


def _as_large(
    view: int,
    known: KnownLens | None,
    size: tuple[int, int] | None,
    other: tuple[int, int] | None,
) -> KnownLens | None:
    """Return the lens that is `known` of an image of the `other` size, in an image of this one."""
    if known is None or size == other:
        return known
    if size is None or other is None:
        raise LensError(view, "same_as needs the sizes of both images, or of none")
    return known._replace(focal=known.focal * max(size) / max(other))


class LensError(ValueError):
    """What is known of a view's lens cannot be used."""

    def __init__(self, view: int, words: str) -> None:
        super().__init__(f"lenses[{view}]: {words}")
        self.view, self.words = view, words


def _in_pixels(view: int, lens: Lens, size: tuple[int, int] | None) -> KnownLens:
    try:
        return KnownLens(lens.pixels(size), lens.sd)
    except ValueError as error:
        raise LensError(view, str(error)) from error
