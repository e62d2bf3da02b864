"""The posterior of the focal lengths of two static views.

Three parts count for what each is worth (`models.calibrating.lens_profile`): the likelihood of the
keypoints under epipolar geometry; a prior of lenses, with those that were given as data; and the
evidence of shapes. Shapes bend in more ways than models of them do, so their evidence is off by far
more than it says: it counts as one observation whose error has heavy tails, and with some
probability shapes mislead and count for nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.calibrating.lens_evidence import SHAPE_NATS
from models.calibrating.lens_profile import TO_LOGS, Kind, Walk
from models.calibrating.problem import LensPosterior

Float64 = NDArray[np.float64]

# Figures: evidence/lenses.md.
FINE = 0.01  # of the common log focal length, or so many standard deviations of its kind
RATIOS = np.linspace(-3.5, 3.5, 21)  # standard deviations of the log ratio
# Errors of the evidence of shapes, learnt on drawn motions: Student's t of common log focal length
# and ratio, and the probability that shapes mislead.
SHAPE_SDS = np.array([0.1, 0.3])
SHAPE_FREEDOM, MISLEADS = 3.0, 0.1
EVERYWHERE = 1 / (2.4 * 2.0)  # density of the two logarithms where shapes are not informative
FAR_ASIDE = 0.3  # of the log ratio: so far shapes are believed without being asked
LEAST_SHARE = 1e-3  # of a place among those that shapes favour
LEAST_SD = 0.002  # of a log focal length: lens models are no more exact
TINY = 1e-9
PEAK = 0.2  # of the highest density: less is no peak of its own
VALLEY = 0.8  # of the lower of two peaks: less between them makes them two


class _Line(NamedTuple):
    """One kind of lenses on a fine grid of common log focal lengths (T,)."""

    kind: Kind
    commons: Float64  # (T,)
    ratios: Float64  # (T,) the best
    ratio_sds: Float64  # (T,) about these, by geometry and prior; 0: held
    geometry: Float64  # (T,) log likelihood and log prior, of the best ratio
    shapes: Float64  # (T,) log evidence, at the ratios that shapes favour; NaN where not asked
    favoured: Float64  # (T,) these ratios


def posterior_of(walks: list[Walk]) -> LensPosterior:
    """Combine all evidence along the walks."""
    lines = [_line(walk) for walk in walks]
    centres = _favoured(lines)
    logs, ats, widths = [], [], []
    for line in lines:
        held = line.ratio_sds[0] == 0
        steps = np.zeros(1) if held else RATIOS
        ratios = line.ratios[:, None] + line.ratio_sds[:, None] * steps  # (T, R)
        at = np.stack((np.broadcast_to(line.commons[:, None], ratios.shape), ratios), -1)
        density = line.geometry[:, None] - np.square(steps) / 2 + _log_of_shapes(centres, at)
        across = 1.0 if held else line.ratio_sds[:, None] * (steps[1] - steps[0])
        logs.append(density + np.log(across * np.gradient(line.commons)[:, None]))
        ats.append(at)
        widths.append(np.gradient(line.commons))
    top = max(float(each.max()) for each in logs)
    shares = [np.exp(each - top) for each in logs]
    total = sum(float(each.sum()) for each in shares)
    weights = np.concatenate([each.ravel() for each in shares]) / total
    places = np.concatenate([each.reshape(-1, 2) for each in ats])
    mean = weights @ places
    apart = places - mean
    covariance = (apart.T * weights) @ apart
    likelier = int(np.argmax([each.sum() for each in shares]))
    own = shares[likelier].ravel() / shares[likelier].sum()
    about = ats[likelier].reshape(-1, 2) - mean
    of_kind = (about.T * own) @ about
    if lines[likelier].ratio_sds[0] == 0:
        of_kind[1, 1] += lines[likelier].kind.sds[1] ** 2
    marginal = [each.sum(1) / width for each, width in zip(shares, widths, strict=True)]
    return LensPosterior(
        TO_LOGS @ mean,
        TO_LOGS @ covariance @ TO_LOGS.T + LEAST_SD**2 * np.eye(2),
        TO_LOGS @ of_kind @ TO_LOGS.T + LEAST_SD**2 * np.eye(2),
        _peaks([line.commons for line in lines], marginal),
    )


def _line(walk: Walk) -> _Line:
    """Interpolate a walk."""
    kind, sd = walk.kind, walk.kind.sds
    commons = np.array([place.at[0] for place in walk.places])
    step = min(FINE, sd[0] / 20, float(np.diff(commons).min(initial=1.0)) / 2)
    count = max(2, int(np.ceil((commons[-1] - commons[0]) / step)) + 1)
    fine = np.linspace(commons[0], commons[-1], count)
    found = np.array([place.at[1] for place in walk.places])
    geometry = np.array([place.geometry for place in walk.places])
    ratios = interpolated(commons, found, fine)
    precision, slope, bend = _aside(walk) if walk.aside else (0.0, 0.0, 0.0)
    free = bool(walk.aside)
    ratio_sd = 1 / np.sqrt(precision + 1 / sd[1] ** 2) if free else 0.0
    prior = -np.square((fine - kind.mean[0]) / sd[0]) / 2 - np.log(sd[0])
    if free:
        off = (ratios - kind.ratio_at(fine)) / sd[1]
        prior -= np.square(off) / 2 + np.log(sd[1]) + np.log(2 * np.pi) / 2
    asked = np.array([np.isfinite(place.shapes) for place in walk.places])
    shapes, steps = np.full(len(fine), np.nan), 0.0
    if asked.sum() > 1:
        inside = (fine >= commons[asked][0]) & (fine <= commons[asked][-1])
        evidence = np.array([place.shapes for place in walk.places])[asked]
        shapes[inside] = interpolated(commons[asked], evidence, fine[inside])
        # Geometry holds the ratio where it knows it.
        held = bend + SHAPE_NATS / ratio_sd**2 if free else np.inf
        steps = float(np.clip(slope / max(held, 1e-9), -FAR_ASIDE, FAR_ASIDE))
        shapes[inside] += slope * steps - bend * steps**2 / 2
    return _Line(
        kind,
        fine,
        ratios,
        np.full(len(fine), ratio_sd),
        interpolated(commons, geometry, fine) + prior + np.log(kind.share),
        shapes,
        ratios + steps,
    )


def _aside(walk: Walk) -> tuple[float, float, float]:
    """Return how places of other ratios differ from the one that they are beside.

    It is the curvature of geometry, and slope and curvature of the evidence of shapes.
    """
    low, high = walk.aside
    best = min(walk.places, key=lambda place: abs(float(place.at[0] - low.at[0])))
    step = float(high.at[1] - low.at[1]) / 2
    precision = max(0.0, 2 * best.geometry - low.geometry - high.geometry) / step**2
    slope = (high.shapes - low.shapes) / (2 * step)
    bend = (2 * best.shapes - low.shapes - high.shapes) / step**2
    if not np.isfinite(slope + bend):
        return precision, 0.0, 0.0
    return precision, float(slope), float(bend)


def _favoured(lines: list[_Line]) -> tuple[Float64, Float64]:
    """Return the places (C, 2) that shapes favour, and their shares (C,).

    There are none if shapes were never asked, or if their evidence rises to the end of a line: a
    slope without a top is no peak.
    """
    known = [np.isfinite(line.shapes) for line in lines]
    places = np.concatenate(
        [
            np.stack((line.commons, line.favoured), 1)[there]
            for line, there in zip(lines, known, strict=True)
        ]
    )
    evidence = np.concatenate(
        [line.shapes[there] for line, there in zip(lines, known, strict=True)]
    )
    ends = np.concatenate(
        [np.isin(np.arange(len(there)), (0, len(there) - 1))[there] for there in known]
    )
    if not len(evidence) or ends[evidence.argmax()]:
        return places[:0], evidence[:0]
    shares = np.exp((evidence - evidence.max()) / SHAPE_NATS)
    shares *= np.concatenate(
        [np.gradient(line.commons)[there] for line, there in zip(lines, known, strict=True)]
    )
    kept = shares > LEAST_SHARE * shares.max()
    return places[kept], shares[kept] / shares[kept].sum()


def _log_of_shapes(centres: tuple[Float64, Float64], at: Float64) -> Float64:
    """Return the log density of two numbers (..., 2) by shapes alone."""
    places, shares = centres
    if not len(places):
        return np.zeros(at.shape[:-1])
    squared = np.zeros((*at.shape[:-1], len(places)))
    for number in (0, 1):
        squared += np.square((at[..., number, None] - places[:, number]) / SHAPE_SDS[number])
    tails = (1 + squared / SHAPE_FREEDOM) ** (-(SHAPE_FREEDOM + 2) / 2)
    density = tails @ shares / (2 * np.pi * SHAPE_SDS.prod())
    return np.asarray(np.log((1 - MISLEADS) * density + MISLEADS * EVERYWHERE))


def interpolated(known: Float64, values: Float64, at: Float64) -> Float64:
    """Interpolate by cubics with Akima's slopes, which do not overshoot beside a cliff.

    H. Akima, *A new method of interpolation and smooth curve fitting*, 1970.
    """
    if len(known) == 1:
        return np.full(len(at), values[0])
    chords = np.diff(values) / np.diff(known)
    before, after = 2 * chords[0] - chords[1 % len(chords)], 2 * chords[-1] - chords[-2:][0]
    beside = np.array([2 * before - chords[0], before, *chords, after, 2 * after - chords[-1]])
    bends = np.abs(np.diff(beside)) + TINY
    first, last = bends[2:], bends[:-2]
    slopes = (first * beside[1:-2] + last * beside[2:-1]) / (first + last)
    left = np.searchsorted(known, at, side="right").clip(1, len(known) - 1) - 1
    width = known[left + 1] - known[left]
    share = (at - known[left]) / width
    begin, end = values[left], values[left + 1]
    rise = end - begin
    first, last = slopes[left] * width - rise, rise - slopes[left + 1] * width
    bent = share * (1 - share) * (first * (1 - share) + last * share)
    return np.asarray(begin + rise * share + bent)


def _peaks(commons: list[Float64], densities: list[Float64]) -> tuple[float, ...]:
    """Return the focal lengths where the sum of densities along the lines has peaks."""
    fine = np.arange(
        min(line[0] for line in commons), max(line[-1] for line in commons) + FINE / 2, FINE
    )
    total = sum(
        np.interp(fine, line, density, 0, 0)
        for line, density in zip(commons, densities, strict=True)
    )
    rises = np.concatenate(([0.0], np.asarray(total), [0.0]))
    higher = (rises[1:-1] >= rises[:-2]) & (rises[1:-1] > rises[2:])
    tops: list[int] = np.flatnonzero(higher).tolist()
    found: list[int] = []
    for top in sorted(tops, key=lambda place: -float(rises[place + 1])):
        height = rises[top + 1]
        apart = all(
            rises[min(top, other) + 1 : max(top, other) + 2].min() < VALLEY * height
            for other in found
        )
        if height > PEAK * rises.max() and apart:
            found.append(int(top))
    return tuple(float(np.exp(fine[place])) for place in found)
