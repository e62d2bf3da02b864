"""What may be wrong with a view's pixels: as a prior of its lens, and as the map that undoes it."""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.causes.cause import Cause, Kind
from models.causes.free_rig import ASPECT, CENTRE, FOCAL
from models.causes.pixel_map import PixelMap
from models.causes.sightings import Even, Hypothesis

Float64 = NDArray[np.float64]

# Figures: evidence/causes.md.
SCALES = (1 / 3, 1 / 2, 2 / 3, 2.0)
ASPECTS = (16 / 9, 4 / 3, 3 / 4, 9 / 16)
BENDS = (0.1, 0.18, 0.26)
CORNERS = ((0.2, 0.2), (0.3, 0.05), (0.05, 0.3))  # of windows, in the image: where fits begin
LEAST_ASPECT, LEAST_SCALE = 0.06, 0.15  # logarithms: less does little harm
LEAST_OFFSET = 0.06  # sides: a crop nearer than this does no harm
RARE = 4.6  # nats against any harm: one view in a hundred
ALSO = 1.5  # against the same harm in another view
RARER = 1.0  # against one that is seen less often
FREE_OFFSET = 6.0  # what two free numbers cost beside the expected principal point
FREE_NUMBER = 4.0
BENT = 10.0  # and an uneven stretch, which few cameras make
MOST_OF_PAIRS = 4  # views, of which any two are tried
LEAST_SQUARE = 1.05  # between width and height, for an image that is not square
FRAMED = 0.4  # of half an image's width and height: how far a subject's middle is from its middle
OUTSIDE, MOST_OUTSIDE = 50.0, 0.3  # nats against keypoints outside the image, by their share
EDGE = 0.02  # of the width and height, that do not count as outside


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
    """A hypothesis of one view, or of several alike, beside what was supposed so far."""

    kind: Kind
    views: tuple[int, ...]
    hypothesis: Hypothesis
    numbers: dict[str, float]
    nats: float  # against it, before the keypoints are seen

    @property
    def place(self) -> tuple[str, tuple[int, ...]]:
        """Its kind and views."""
        return self.kind, self.views


def candidates(
    image: Image,
    view: int,
    before: Hypothesis,
    lens: Float64,
    ratios: Iterable[float] = (),
) -> Iterator[Candidate]:
    """Yield what may be wrong with a view whose lens (6,) is roughly known.

    `before` has its pixels evened, if they are mirrored or bent. Beside the usual scales of images,
    these `ratios` are tried. A rough fit may stop on the way, so it shows a direction alone.
    """
    middle, even = image.middle_in_sides, before.evens[view]
    if even.mirrored:
        yield Candidate("mirrored", (view,), before, {}, RARE)
        # Exchanged about the corner; seen here after x was mirrored about the middle.
        across = np.full(2, middle[0] - middle[1])
        for centre in (np.zeros(2), across) if image.known else (np.zeros(2),):
            there = before.moved(view, centre=centre)
            yield Candidate("axes_exchanged", (view,), there, {}, RARE + RARER)
        return
    if even.bend or abs(lens[ASPECT]) > LEAST_ASPECT:
        yield from _stretched(image, view, before, float(lens[ASPECT]))
    if not even.bend:
        yield from _aside(image, view, before, lens[CENTRE : CENTRE + 2], ratios)


def of_several(images: Sequence[Image], before: Hypothesis, left: list[int]) -> Iterator[Candidate]:
    """Yield what may be wrong with several views: windows of two, or all stretched alike.

    `images` are those of all views; the views `left` may be harmed.
    """
    if len(images) <= MOST_OF_PAIRS:
        for pair in combinations(left, 2):
            there = before
            for view in pair:
                corner = -2 * np.array(CORNERS[0]) * images[view].middle_in_sides
                there = there.moved(view, centre=corner).freed(view, aspect=0.0)
            yield Candidate("cropped", pair, there, {}, RARE + ALSO + 2 * FREE_OFFSET)
    if len(left) < len(images):
        return
    # Views of one shape do not show how tall the subject is: cameras that bend stretch 4:3 to 16:9.
    for bend, aspect in (*product((0.0,), ASPECTS), (BENDS[1], 4 / 3)):
        there = before
        for view in left:
            half = images[view].width / 2 / images[view].side
            there = there.moved(view, aspect=math.log(aspect), centre=np.zeros(2))
            there = there.shown(view, Even(bend=bend, half=half))
        numbers = {"fx_over_fy": aspect} | ({"bend": bend} if bend else {})
        nats = RARE + 2 * RARER + BENT * bool(bend)
        yield Candidate("stretched", tuple(left), there, numbers, nats)


def _aside(
    image: Image, view: int, before: Hypothesis, centre: Float64, ratios: Iterable[float]
) -> Iterator[Candidate]:
    middle = image.middle_in_sides
    free = 1 + float(centre @ middle / (middle @ middle))
    for scale in {*SCALES, *ratios, free}:
        enlarged = scale == free and scale > 1  # nobody enlarges images by any number
        if 0.1 < scale < 10 and abs(math.log(scale)) > LEAST_SCALE and not enlarged:
            nats = RARE + (FREE_NUMBER if scale == free else 0.0)
            there = before.moved(view, centre=(scale - 1) * middle, focal=math.log(scale))
            yield Candidate("scaled", (view,), there, {"scale": scale}, nats)
    for share in CORNERS:
        there = before.moved(view, centre=-2 * np.array(share) * middle)
        yield Candidate("cropped", (view,), there.freed(view, aspect=0.0), {}, RARE + FREE_OFFSET)
    aside = np.array((middle[1] - middle[0], middle[0] - middle[1]))
    if image.known and np.hypot(*aside) > LEAST_OFFSET:
        there = before.moved(view, centre=aside)
        yield Candidate("on_its_side", (view,), there, {"aside": 1.0}, RARE + RARER)


def _stretched(image: Image, view: int, before: Hypothesis, aspect: float) -> Iterator[Candidate]:
    shape, nowhere = math.log(image.width / image.height), np.zeros(2)
    bend = before.evens[view].bend
    known = {"bend": bend} if bend else {}
    oblong = image.known and math.exp(abs(shape)) > LEAST_SQUARE
    if oblong and not bend and shape * aspect > 0:
        there = before.moved(view, aspect=shape, centre=nowhere)
        yield Candidate("padded", (view,), there, {"fx_over_fy": math.exp(shape)}, RARE + RARER)
    usual = [log for log in map(math.log, ASPECTS) if log * aspect > 0]
    for log in (*usual, aspect, *([0.0] if bend else [])):
        numbers = {"fx_over_fy": math.exp(log), **known}
        nats = RARE + 2 * RARER + FREE_NUMBER * (log == aspect) + BENT * bool(bend)
        # About the middle, or the longer axis made shorter about the corner.
        shrunk = np.array((min(math.exp(log), 1.0), min(math.exp(-log), 1.0)))
        for to, more in ((nowhere, {}), ((shrunk - 1) * image.middle_in_sides, {"from_corner": 1})):
            there = before.moved(view, aspect=log, centre=to)
            yield Candidate("stretched", (view,), there, numbers | more, nats)


def framing(image: Image, pixels: Float64, size: tuple[int, int] | None) -> float:
    """Return nats against keypoints (M, 2) of an image of a size, from where they are in it.

    People point cameras at their subject, and detectors find nothing outside of the image.
    """
    if not image.known or size is None or not len(pixels):
        return 0.0
    from_middle = 2 * pixels / size - 1
    aside = float(np.square(np.median(from_middle, 0) / FRAMED).sum()) / 2
    outside = float((np.abs(from_middle) > 1 + 2 * EDGE).any(1).mean())
    return aside + OUTSIDE * min(outside, MOST_OUTSIDE)


def causes_of(
    found: Candidate, view: int, image: Image, lens: Float64, sds: Float64, turned: int
) -> list[Cause]:
    """Return causes of a view, with maps; more than one if the framing decides between them.

    `lens` (6,) is as estimated, with deviations; `turned` are quarter turns of the image clockwise.
    """
    numbers, errors = dict(found.numbers), dict[str, float]()
    cause = Cause(found.kind, view, numbers, errors, 0.0, PixelMap(), image.size)
    if found.kind == "cropped":
        offset = -image.side * lens[CENTRE : CENTRE + 2]
        numbers |= {"x": float(np.round(offset[0])), "y": float(np.round(offset[1]))}
        errors |= zip("xy", (image.side * sds[CENTRE : CENTRE + 2]).tolist(), strict=True)
        return [cause._replace(map=PixelMap(c=numbers["x"], f=numbers["y"]))]
    if found.kind == "scaled":
        times = 1 / numbers["scale"]
        shift = (times - 1) / 2
        errors["scale"] = numbers["scale"] * float(sds[FOCAL])
        return [cause._replace(map=PixelMap(a=times, c=shift, e=times, f=shift))]
    if found.kind in ("padded", "stretched"):
        errors["fx_over_fy"] = numbers["fx_over_fy"] * float(sds[ASPECT])
        return _unstretched(cause, image)
    if found.kind == "axes_exchanged":
        return [cause._replace(map=PixelMap(a=0, b=1, d=1, e=0))]
    return _upright(cause, image, turned)


def _unstretched(cause: Cause, image: Image) -> list[Cause]:
    """Make the shorter direction longer, or the longer one shorter with another size."""
    numbers, (x, y) = dict(cause.numbers), image.middle
    ratio, bend = numbers["fx_over_fy"], numbers.get("bend", 0.0)
    wide, high = max(1 / ratio, 1.0), max(ratio, 1.0)
    corner = numbers.pop("from_corner", 0.0)
    shift = (0.0, 0.0) if corner else (x - wide * x, y - high * y)
    longer = PixelMap(wide, 0, shift[0], 0, high, shift[1], bend, x, image.width / 2)
    cause = cause._replace(numbers=numbers, map=longer)
    if corner or cause.kind == "padded":
        return [cause]
    wide, high = min(1 / ratio, 1.0), min(ratio, 1.0)
    shorter = PixelMap(wide, 0, 0, 0, high, 0, bend, x, image.width / 2)
    size = image.size and (round(wide * image.width), round(high * image.height))
    return [cause, cause._replace(map=shorter, size=size)]


def _upright(cause: Cause, image: Image, turned: int) -> list[Cause]:
    """Undo a mirror, or turn an image back by quarter turns; a mirror image by half a turn only."""
    right, low = 2 * image.middle[0], 2 * image.middle[1]
    if image.known:
        right, low = right - 1, low - 1
    half = PixelMap(a=-1, c=right, e=-1, f=low)
    if cause.kind == "mirrored":
        mirror = PixelMap(a=-1, c=right)
        return [cause._replace(map=half.after(mirror) if turned == 2 else mirror)]
    if turned == 2:
        return [cause._replace(kind="upside_down", map=half)]
    numbers = dict(cause.numbers)
    size = image.size and (image.size[1], image.size[0])
    if numbers.pop("aside", 0.0):  # the size is that of the image as it was filmed
        size, right, low = image.size, low, right
    # Turned clockwise, what was up is to the right.
    back = PixelMap(a=0, b=-1, c=low, d=1, e=0, f=0)
    if turned == 1:
        back = PixelMap(a=0, b=1, c=0, d=-1, e=0, f=right)
    numbers["degrees"] = 90.0 * turned
    return [cause._replace(numbers=numbers, map=back, size=size)]
