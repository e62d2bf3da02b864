"""Which frames of several cameras belong together: by their numbers, or by their times."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fewview.animation import USUAL_RATE, rate_of
from fewview.capture import Float64
from fewview.errors import FormatError
from fewview.readers.views import Int64, View
from fewview.reading_options import Align

MOST_MISSING = 20  # times the frames that there are: images that were chosen have larger holes
ALIKE = 0.02  # rates that differ by a smaller share are one
APART = 0.5  # of a frame: times of one number are not of one moment
OFTEN = 0.1  # of the frames
WHOLE = 0.02  # of a ratio of lengths: so near it is to 2, 3, ...


class Together(NamedTuple):
    """Frames of all cameras.

    Attributes
    ----------
    rows
        (N, K) which frame of each view stands in each, -1 for none.
    numbers
        (N,) their numbers.
    times
        (N,) or (N, K) seconds, where they are known.
    fps
        Frames per second, where all have one rate.
    """

    rows: Int64
    numbers: Int64
    times: Float64 | None
    fps: float | None


def together(
    views: list[View], align: Align, notes: list[str], *, one_file: bool = False
) -> Together:
    """Return which frames of the views belong together.

    Parameters
    ----------
    one_file
        Whether all are of one file, whose rows belong together.

    Raises
    ------
    FormatError
        If they are to be joined by times, and one has none.
    """
    rates = [_rate(view) for view in views]
    known = [rate for rate in rates if rate is not None]
    differ = len(known) == len(views) and max(known) > (1 + ALIKE) * min(known)
    if align == "time" or (align == "auto" and (differ or (not one_file and _times_differ(views)))):
        if align == "auto":
            shown = ", ".join(f"{v.name} {r:.4g}" for v, r in zip(views, rates, strict=True) if r)
            notes.append(f"frames were joined by their times (frames per second: {shown})")
        return _by_time(views, rates, notes)
    if differ:
        notes.append("the cameras have unlike frames per second; align='time' joins by times")
    return _by_number(views, notes)


def _rate(view: View) -> float | None:
    return rate_of(view.times) if view.times is not None and len(view.times) > 1 else view.fps


def _times_differ(views: Sequence[View]) -> bool:
    """Whether by the cameras' own times, frames of one number are not of one moment."""
    clocks = [view.times for view in views]
    if any(clock is None or len(clock) < 2 or np.any(np.diff(clock) <= 0) for clock in clocks):
        return False
    timed = [clock for clock in clocks if clock is not None]
    start, end = max(clock[0] for clock in timed), min(clock[-1] for clock in timed)
    if 2 * (end - start) < min(clock[-1] - clock[0] for clock in timed):
        return False  # clocks that know nothing of each other
    step = float(np.median(np.diff(timed[0])))
    numbers = [view.numbers for view in views]
    for own, clock in zip(numbers[1:], timed[1:], strict=True):
        _, i, j = np.intersect1d(numbers[0], own, return_indices=True)
        if len(i) and np.mean(np.abs(timed[0][i] - clock[j]) > APART * step) > OFTEN:
            return True
    return False


def _by_number(views: list[View], notes: list[str]) -> Together:
    numbers = common_numbers(views, notes)
    every = np.unique(np.concatenate(numbers))
    rows = np.full((len(every), len(views)), -1)
    for v, own in enumerate(numbers):
        rows[np.searchsorted(every, own), v] = np.arange(len(own))
    for view, own in zip(views, numbers, strict=True):
        if len(own) < len(every):
            ended = f"; it ends at frame {own[-1]}" if own[-1] < every[-1] - 1 else ""
            notes.append(
                f"{view.name}: has {len(own)} of the {len(every)} frames; the others are gaps"
                + ended
            )
    _unlike_lengths(views, numbers, notes)
    rates = {view.fps for view in views}
    fps = rates.pop() if len(rates) == 1 else None
    times = _own_times(views, rows, notes)
    missing = int(every[-1] - every[0]) + 1 - len(every)
    if times is None and 0 < missing <= MOST_MISSING * len(every):  # else these are no film
        times = (every - every[0]) / (fps or USUAL_RATE)
        note = f"{missing} frame numbers between {every[0]} and {every[-1]} are in no file"
        if fps is None:
            note += f": times are for {USUAL_RATE:g} frames per second, as no rate is known (fps=)"
        notes.append(note)
    return Together(rows, every, times, fps)


def common_numbers(views: list[View], notes: list[str]) -> list[Int64]:
    """Return frame numbers (N,) that mean the same in all views."""
    numbers = [view.numbers for view in views]
    first = [int(own[0]) for own in numbers]
    last = [int(own[-1]) for own in numbers]
    if set(first) == {0, 1} and len({b - a for a, b in zip(first, last, strict=True)}) == 1:
        from_one = ", ".join(v.name for v, a in zip(views, first, strict=True) if a)
        notes.append(f"{from_one}: frames are counted from 1, those of the others from 0")
        return [own - start for own, start in zip(numbers, first, strict=True)]
    shared = min(last) - max(first) + 1
    shortest = min(b - a + 1 for a, b in zip(first, last, strict=True))
    if shared * 2 >= shortest:
        return numbers
    notes.append(
        "frame numbers of the cameras hardly overlap ("
        + ", ".join(f"{v.name} {a} to {b}" for v, a, b in zip(views, first, last, strict=True))
        + "), so each camera's first frame was taken for the same"
    )
    return [own - start for own, start in zip(numbers, first, strict=True)]


def _unlike_lengths(views: list[View], numbers: list[Int64], notes: list[str]) -> None:
    """Note where one camera has twice, three times, ... the frames of another, and no rate."""
    lengths = [int(own[-1] - own[0]) + 1 for own in numbers]
    ratio = max(lengths) / min(lengths)
    whole = round(ratio) > 1 and min(lengths) > 2 / WHOLE and abs(ratio - round(ratio)) < WHOLE
    if whole and any(_rate(view) is None for view in views):
        most, least = (views[lengths.index(f(lengths))].name for f in (max, min))
        notes.append(
            f"{most} has {round(ratio)} times the frames of {least}: if it films faster, give the "
            f"frames per second of each, as in fps='{most}=60,{least}={60 / round(ratio):g}' "
            f"(--fps {most}=60,{least}={60 / round(ratio):g}); else {least} ends early"
        )


def _own_times(views: list[View], rows: Int64, notes: list[str]) -> Float64 | None:
    """Return the times that views have, (N,) where equal, else (N, K).

    A frame that a camera lacks has the time of the others', and what that camera is late by.
    """
    timed = [(v, view.times) for v, view in enumerate(views) if view.times is not None]
    if not timed:
        return None
    times = np.full(rows.shape, np.nan)
    for v, own in timed:
        there = rows[:, v] >= 0
        times[there, v] = own[rows[there, v]]
    if len(timed) < len(views):
        notes.append(f"times are those of {', '.join(views[v].name for v, _ in timed)}")
    times = times[:, [v for v, _ in timed]]
    whole = np.isfinite(times).all(1)
    late = np.zeros(len(timed))
    if whole.any():
        late = np.median(times[whole] - times[whole].mean(1, keepdims=True), axis=0)
    some = np.isfinite(times).any(1).all()
    common = np.nanmedian(times - late, axis=1) if some else np.zeros(len(times))
    if np.any(np.diff(common) <= 0):
        notes.append("times were left out: some frames have none, or they do not rise")
        return None
    if len(timed) < len(views) or (np.nan_to_num(times - common[:, None]) == 0).all():
        return np.asarray(common)
    filled = np.where(np.isfinite(times), times, common[:, None] + late)
    return filled if (np.diff(filled, axis=0) > 0).all() else np.asarray(common)


def _by_time(views: list[View], rates: list[float | None], notes: list[str]) -> Together:
    """Align to the times of the view with most frames: each takes what is nearest, within half."""
    clocks = _clocks(views, rates)
    if any(np.any(np.diff(clock) <= 0) for clock in clocks):
        raise FormatError("times must rise from frame to frame to align by them", option="align")
    reference = max(clocks, key=len)
    half = float(np.median(np.diff(reference))) / 2 if len(reference) > 1 else np.inf
    rows = np.full((len(reference), len(views)), -1)
    for v, (view, clock) in enumerate(zip(views, clocks, strict=True)):
        after = np.clip(np.searchsorted(clock, reference), 1, max(len(clock) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(clock) - 1)
        nearer = np.abs(clock[after] - reference) < np.abs(clock[before] - reference)
        nearest = np.where(nearer, after, before)
        near = np.abs(clock[nearest] - reference) <= half
        rows[near, v] = nearest[near]
        if not near.all():
            notes.append(f"{view.name}: {int((~near).sum())} moments without a frame are gaps")
    if not (rows >= 0).any(0).all():
        raise FormatError("the cameras' times do not overlap", option="align", remedy="index")
    return Together(rows, np.arange(len(reference)), reference - reference[0], None)


def _clocks(views: Sequence[View], rates: Sequence[float | None]) -> list[Float64]:
    """Return the times of each view's frames; raise FormatError if one has neither times nor rate.

    Frames are counted from 0, from 1, or from a number of all; else these are parts of films.
    """
    clocks: list[Float64] = []
    first = {int(view.numbers[0]) for view in views}
    begin = min(first) if min(first) == 1 or len(first) == 1 else 0
    for view, rate in zip(views, rates, strict=True):
        if view.times is not None:
            clocks.append(view.times)
        elif rate:
            clocks.append((view.numbers - begin) / rate)
        else:
            raise FormatError(
                "has no times to align by",
                place=view.name,
                option="fps",
                remedy="RATE",
            )
    return clocks


def put_in_step(
    views: Sequence[View], delays: Sequence[float | None], notes: list[str]
) -> list[View]:
    """Return views with times of one clock: each view's, less the seconds that it is late.

    Raises
    ------
    FormatError
        If a view has neither times nor a rate.
    """
    out = []
    clocks = _clocks(views, [_rate(view) for view in views])
    for view, clock, late in zip(views, clocks, delays, strict=True):
        if late:
            when = "later" if late > 0 else "earlier"
            notes.append(f"{view.name}: shows moments {abs(late):g} s {when}; put in step")
        out.append(replace(view, times=np.asarray(clock - (late or 0.0), np.float64)))
    return out


def with_rates(views: Sequence[View], rates: Sequence[float | None]) -> list[View]:
    """Return the views with the frames per second that were given, instead of those of files."""
    return [
        view if rate is None else replace(view, fps=rate)
        for view, rate in zip(views, rates, strict=True)
    ]
