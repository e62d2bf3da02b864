"""What pictures of a report are made of: numbers of a drawing, and the words beside them."""

import math
from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

from service.wire.reports import CameraDirection, CameraPlace, FitReport

LEVELS = 9  # of a colour, above none
WIDE, HIGH = 600, 100  # of a curve
RING = 100.0  # the radius of the horizon
HORIZON, PER_DEGREE = 0.86 * RING, 0.28 * RING / 30  # where elevation 0 is, and how it rises
NOTABLE = 0.3  # of the error: less than this looks pale, though it is the best
MARGIN = 0.06  # about what a view shows
Point = Sequence[float] | None


class Bar(NamedTuple):
    """A row with a bar of a width in percent; `dots` are the views that it is about."""

    name: str
    value: float | None
    width: float
    dots: tuple[bool, ...] = ()


class Cell(NamedTuple):
    """A number and how strong its colour is."""

    value: float | None
    level: int


class Curve(NamedTuple):
    """A curve over frames as a path, its highest value, and where it is doubtful, with why."""

    path: str
    most: float
    doubtful: list[tuple[float, float, str]]  # start, width, reason


class Run(NamedTuple):
    """Frames one after the other that are doubtful for the same reason."""

    first: int
    last: int
    reason: str
    quality: float | None


class Sector(NamedTuple):
    """A place for one more camera, as a part of a ring."""

    path: str
    place: CameraPlace
    level: int


class Drawn(NamedTuple):
    """A view of a frame: where it lies, edges, errors and keypoints as paths."""

    box: str
    edges: str
    errors: str
    dots: str
    answered: str
    seen: int
    error: float | None  # pixels, median


def bars(names: Sequence[str], values: Sequence[float | None]) -> list[Bar]:
    """Return bars of values, the largest first, those that are not known last."""
    most = max((value for value in values if value is not None), default=0.0) or 1.0
    found = [
        Bar(name, value, 0.0 if value is None else round(100 * value / most, 1))
        for name, value in zip(names, values, strict=True)
    ]
    return sorted(found, key=lambda bar: -math.inf if bar.value is None else bar.value)[::-1]


def worth(report: FitReport, names: Sequence[str]) -> list[Bar]:
    """Return bars of choices of views."""
    errors = [some.expected_error for some in report.of_views]
    # Bars of single views, which are far longer, are cut.
    known = [(len(some.views), some.expected_error or 0.0) for some in report.of_views]
    most = max((error for views, error in known if views > 1), default=0.0) or 1.0
    return [
        Bar(
            ", ".join(names[view] for view in some.views),
            error,
            0.0 if error is None else round(min(100 * error / most, 100.0), 1),
            tuple(view in some.views for view in range(len(names))),
        )
        for some, error in zip(report.of_views, errors, strict=True)
    ]


def heat(rows: Sequence[Sequence[float | None]]) -> list[list[Cell]]:
    """Return cells of rows of numbers."""
    known = [value for row in rows for value in row if value is not None]
    most = max(known, default=0.0)
    least = min(*known, most / 2) if known else 0.0  # else small differences would look large
    spread = (most - least) or 1.0
    return [
        [
            Cell(value, 0 if value is None else round(LEVELS * (value - least) / spread))
            for value in row
        ]
        for row in rows
    ]


def curve(
    values: Sequence[float | None], reasons: Sequence[str | None], most: float | None = None
) -> Curve:
    """Return a curve over frames, of the largest value of those that share a place."""
    count = len(values)
    step = max(1, math.ceil(count / WIDE))
    parts = [values[start : start + step] for start in range(0, count, step)]
    highest = [max((v for v in part if v is not None), default=None) for part in parts]
    top = most or max((value for value in highest if value is not None), default=0.0) or 1.0
    path, pen = [], "M"
    for place, value in enumerate(highest):
        if value is None:
            pen = "M"
            continue
        x = WIDE * (place + 0.5) / len(highest)
        path.append(f"{pen}{x:.1f} {HIGH * (1 - value / top):.1f}h.1")
        pen = "L"
    doubtful = [
        (
            round(WIDE * run.first / count, 2),
            round(WIDE * (run.last - run.first + 1) / count, 2),
            run.reason,
        )
        for run in _runs(reasons)
    ]
    return Curve("".join(path), top, doubtful)


def doubtful(report: FitReport) -> list[Run]:
    """Return the runs of doubtful frames, with the lowest quality of each."""
    found = []
    for run in _runs(report.reasons):
        known = [q for q in report.quality[run.first : run.last + 1] if q is not None]
        found.append(run._replace(quality=min(known, default=None)))
    return found


def _runs(reasons: Sequence[str | None]) -> list[Run]:
    found, start = [], 0
    for reason, group in groupby(reasons):
        length = len(list(group))
        if reason is not None:
            found.append(Run(start, start + length - 1, reason, None))
        start += length
    return found


def sectors(report: FitReport) -> list[Sector]:
    """Return the map of places for one more camera, seen from above, the first view's on top."""
    if not report.places or report.expected_error is None:
        return []
    azimuths = {place.direction.azimuth_deg for place in report.places}
    heights = sorted({place.direction.elevation_deg for place in report.places})
    half = 180 / len(azimuths)
    tall = (heights[1] - heights[0]) / 2 if len(heights) > 1 else 15.0
    gains = [1 - place.expected_error / report.expected_error for place in report.places]
    most = max(*gains, NOTABLE)
    return [
        Sector(_sector(place.direction, half, tall), place, round(LEVELS * max(gain, 0.0) / most))
        for place, gain in zip(report.places, gains, strict=True)
    ]


def _sector(middle: CameraDirection, half: float, tall: float) -> str:
    low, high = middle.elevation_deg - tall, middle.elevation_deg + tall
    left, right = middle.azimuth_deg + half, middle.azimuth_deg - half
    corners = [
        on_map(CameraDirection(azimuth_deg=azimuth, elevation_deg=elevation))
        for azimuth, elevation in ((right, low), (left, low), (left, high), (right, high))
    ]
    (a, b, c, d), outer, inner = corners, _radius(low), _radius(high)
    return (
        f"M{a[0]} {a[1]}A{outer:.2f} {outer:.2f} 0 0 0 {b[0]} {b[1]}"
        f"L{c[0]} {c[1]}A{inner:.2f} {inner:.2f} 0 0 1 {d[0]} {d[1]}Z"
    )


def _radius(elevation: float) -> float:
    return min(max(HORIZON - PER_DEGREE * elevation, 0.0), 1.1 * RING)


def on_map(direction: CameraDirection) -> tuple[float, float]:
    """Return where a direction is on the map, x right and y down."""
    radius, angle = _radius(direction.elevation_deg), math.radians(direction.azimuth_deg)
    return round(-radius * math.sin(angle), 2), round(-radius * math.cos(angle), 2)


def drawn(
    detected: Sequence[Point], answered: Sequence[Point], edges: Sequence[Sequence[int]]
) -> Drawn | None:
    """Return a view of a frame; None if it shows nothing."""
    pairs = list(zip(detected, answered, strict=True))
    known = [point for pair in pairs for point in pair if point is not None]
    if not known:
        return None
    # A keypoint far away from all others would make these tiny.
    (left, right), (top, bottom) = (_extent([point[axis] for point in known]) for axis in (0, 1))
    size = max(right - left, bottom - top, 1.0)
    scale = 100 / size

    def at(point: Sequence[float]) -> str:
        return f"{scale * (point[0] - left):.1f} {scale * (point[1] - top):.1f}"

    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    far = sorted(math.dist(a, b) for a, b in both)
    joined = [(answered[a], answered[b]) for a, b in edges]
    margin = 100 * MARGIN
    width, height = scale * (right - left), scale * (bottom - top)
    return Drawn(
        box=f"{-margin:.1f} {-margin:.1f} {width + 2 * margin:.1f} {height + 2 * margin:.1f}",
        edges="".join(f"M{at(a)}L{at(b)}" for a, b in joined if a is not None and b is not None),
        errors="".join(f"M{at(a)}L{at(b)}" for a, b in both),
        dots="".join(f"M{at(point)}h.1" for point in detected if point is not None),
        answered="".join(f"M{at(point)}h.1" for point in answered if point is not None),
        seen=sum(point is not None for point in detected),
        error=far[len(far) // 2] if far else None,
    )


def _extent(values: list[float]) -> tuple[float, float]:
    """Return the least and the largest of values, without those far from all others."""
    ordered = sorted(values)
    middle = ordered[len(ordered) // 2]
    usual = sorted(abs(value - middle) for value in ordered)[len(ordered) // 2]
    near = [value for value in ordered if abs(value - middle) <= 8 * usual + 1]
    return near[0], near[-1]
