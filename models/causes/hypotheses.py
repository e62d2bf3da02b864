"""What may be wrong with a view's pixels: as a prior of its lens, and as the map that undoes it."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.causes.cause import Cause, Kind
from models.causes.free_rig import ASPECT, CENTRE, FOCAL
from models.causes.pixel_map import PixelMap
from models.causes.sightings import Hypothesis

Float64 = NDArray[np.float64]

SCALES = (1 / 2, 2 / 3, 2.0)
ASPECTS = (16 / 9, 4 / 3, 3 / 4, 9 / 16)
CROPS, CROPPED_BY = 8, 0.2  # directions of a window's corner that are tried, and sides
ROUGHLY = 0.1  # sd of the principal point and the aspect, where a harm is tried roughly
RARE = 4.6  # nats against any harm: one view in a hundred
RARER = 1.0  # against one that is seen less often
FREE_OFFSET = 6.0  # what two free numbers cost beside the expected principal point
FREE_NUMBER = 4.0
LEAST_OFFSET = 0.06  # sides: a crop nearer than this does no harm
LEAST_SQUARE = 1.05  # between width and height, for an image that is not square


class Image(NamedTuple):
    """The image of a view, as it was given or estimated."""

    width: float
    height: float
    middle: tuple[float, float]  # pixels
    side: float  # pixels in a side
    known: bool

    @property
    def middle_in_sides(self) -> Float64:
        """The middle from the corner, in sides."""
        return np.array(self.middle) / self.side

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, if they were given."""
        return (round(self.width), round(self.height)) if self.known else None


class Candidate(NamedTuple):
    """A hypothesis of one view, beside what was supposed so far."""

    kind: Kind
    view: int
    hypothesis: Hypothesis
    numbers: dict[str, float]
    nats: float  # against it, before the keypoints are seen


def rough_ones(image: Image, view: int, before: Hypothesis) -> Iterator[tuple[str, Hypothesis]]:
    """Yield hypotheses of a view of which one is near to whatever is wrong with it, and their kind.

    The best of each kind is looked at closely.
    """
    middle, nowhere = image.middle_in_sides, np.zeros(2)
    yield "mirrored", before.flipped(view).freed(view, aspect=0.0)
    for aspect in ASPECTS:
        there = before.moved(view, aspect=math.log(aspect), centre=nowhere)
        yield f"stretched by {aspect:.2f}", there.freed(view, aspect=0.0, centre=ROUGHLY)
    for scale in SCALES:
        yield "aside", before.moved(view, centre=(scale - 1) * middle, focal=math.log(scale))
    for angle in np.linspace(0, 2 * np.pi, CROPS, endpoint=False):
        centre = CROPPED_BY * np.array((math.cos(angle), math.sin(angle)))
        yield "aside", before.moved(view, centre=centre).freed(view, aspect=0.0, centre=ROUGHLY)


def candidates(
    image: Image, view: int, before: Hypothesis, lens: Float64, *, flipped: bool
) -> Iterator[Candidate]:
    """Yield what may be wrong with a view whose lens (6,) is roughly known.

    `flipped`: it is a mirror image.
    """
    middle = image.middle_in_sides
    aspect, centre = float(lens[ASPECT]), lens[CENTRE : CENTRE + 2]
    if flipped:
        base = before.flipped(view)
        yield Candidate("mirrored", view, base, {}, RARE)
        # Exchanged about the corner; seen here after x was mirrored about the middle.
        across = np.full(2, middle[0] - middle[1])
        yield Candidate("axes_exchanged", view, base.moved(view, centre=across), {}, RARE + RARER)
        return
    if abs(aspect) > 0.1:
        yield from _stretched(image, view, before, aspect)
    free = 1 + float(centre @ middle / (middle @ middle))
    for scale, nats in ((min(SCALES, key=lambda each: abs(each - free)), 0.0), (free, FREE_NUMBER)):
        if 0.1 < scale < 10 and abs(math.log(scale)) > 0.15:
            there = before.moved(view, centre=(scale - 1) * middle, focal=math.log(scale))
            yield Candidate("scaled", view, there, {"scale": scale}, RARE + nats)
    if np.hypot(*centre) > LEAST_OFFSET:
        yield Candidate("cropped", view, before.freed(view, aspect=0.0), {}, RARE + FREE_OFFSET)
        aside = np.array((middle[1] - middle[0], middle[0] - middle[1]))
        if image.known and np.hypot(*aside) > LEAST_OFFSET:
            there = before.moved(view, centre=aside)
            yield Candidate("on_its_side", view, there, {}, RARE + RARER)


def _stretched(image: Image, view: int, before: Hypothesis, aspect: float) -> Iterator[Candidate]:
    shape, nowhere = math.log(image.width / image.height), np.zeros(2)
    if image.known and math.exp(abs(shape)) > LEAST_SQUARE:
        there = before.moved(view, aspect=shape, centre=nowhere)
        yield Candidate("padded", view, there, {"fx_over_fy": math.exp(shape)}, RARE + RARER)
    usual = min(ASPECTS, key=lambda each: abs(math.log(each) - aspect))
    for log, nats in ((math.log(usual), 0.0), (aspect, FREE_NUMBER)):
        numbers = {"fx_over_fy": math.exp(log)}
        # About the middle, or the longer axis made shorter about the corner.
        shrunk = np.array((min(math.exp(log), 1.0), min(math.exp(-log), 1.0)))
        for to, more in ((nowhere, {}), ((shrunk - 1) * image.middle_in_sides, {"from_corner": 1})):
            there = before.moved(view, aspect=log, centre=to)
            yield Candidate("stretched", view, there, numbers | more, RARE + 2 * RARER + nats)


def cause_of(
    found: Candidate, image: Image, lens: Float64, sds: Float64, turned: int, gain: float
) -> Cause:
    """Return the cause, with the map that undoes it; `turned` are quarter turns of the image."""
    numbers, errors = dict(found.numbers), {}
    right, low = 2 * image.middle[0], 2 * image.middle[1]
    if image.known:
        right, low = right - 1, low - 1
    pixels, size = PixelMap(), image.size
    x, y = image.middle
    if found.kind == "cropped":
        offset = -image.side * lens[CENTRE : CENTRE + 2]
        numbers = {"x": float(np.round(offset[0])), "y": float(np.round(offset[1]))}
        errors = dict(zip("xy", (image.side * sds[CENTRE : CENTRE + 2]).tolist(), strict=True))
        pixels = PixelMap(c=numbers["x"], f=numbers["y"])
    elif found.kind == "scaled":
        times = 1 / numbers["scale"]
        shift = (times - 1) / 2
        errors = {"scale": numbers["scale"] * float(sds[FOCAL])}
        pixels = PixelMap(a=times, c=shift, e=times, f=shift)
    elif found.kind in ("padded", "stretched"):
        ratio = numbers["fx_over_fy"]
        errors = {"fx_over_fy": ratio * float(sds[ASPECT])}
        wide, high = (1.0, ratio) if ratio > 1 else (1 / ratio, 1.0)
        pixels = PixelMap(a=wide, e=high)
        if not numbers.pop("from_corner", 0.0):
            pixels = PixelMap(a=wide, c=x - wide * x, e=high, f=y - high * y)
    elif found.kind == "mirrored":
        pixels = PixelMap(a=-1, c=right)
    elif found.kind == "axes_exchanged":
        pixels = PixelMap(a=0, b=1, d=1, e=0)
    kind = found.kind
    if kind in ("mirrored", "upside_down", "on_its_side") and turned:
        pixels, size, kind = _turned(kind, turned, pixels, image)
        if kind == "on_its_side":
            numbers["degrees"] = 90.0 * turned
    return Cause(kind, found.view, numbers, errors, gain, pixels, size)


def _turned(
    kind: Kind, turned: int, pixels: PixelMap, image: Image
) -> tuple[PixelMap, tuple[int, int] | None, Kind]:
    """Turn an image back by quarter turns, a mirror image only by half a turn."""
    right, low = 2 * image.middle[0], 2 * image.middle[1]
    if image.known:
        right, low = right - 1, low - 1
    if turned == 2:
        half = PixelMap(a=-1, c=right, e=-1, f=low)
        return half.after(pixels), image.size, "mirrored" if kind == "mirrored" else "upside_down"
    if kind == "mirrored":
        return pixels, image.size, kind
    # Turned clockwise, what was up is to the right.
    size = image.size and (image.size[1], image.size[0])
    if turned == 1:
        return PixelMap(a=0, b=1, c=0, d=-1, e=0, f=right), size, "on_its_side"
    return PixelMap(a=0, b=-1, c=low, d=1, e=0, f=0), size, "on_its_side"
