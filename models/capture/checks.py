"""Cheap checks of keypoints alone, before any fit: what cannot be right, or is too little.

Thresholds are shares of what a view shows or of its image, so that they hold for every resolution.
No check depends on the order of the frames.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.capture.extents import Extents, extents
from models.capture.frozen import FrozenPlace, frozen_places
from models.findings.advice import attempt, noticed
from models.findings.finding import Finding
from models.settings.keypoints import MIN_KEYPOINTS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
ImageSizes = Sequence[Sequence[int] | None]

NUMBERS = 2**18  # keypoints that a sample has: looked at in a fraction of a second
BLOCKS = 32  # of consecutive frames, that a sample of a long capture consists of
LEAST_FRAMES = 30  # fewer poses than that span no shapes
LEAST_PAIRED = 20  # frames with two views: from fewer no cameras are sought
LEAST_PAIRED_SHARE = 0.5  # and it is the views that are missing, not the frames, if so few are left
SAME_SHARE, SAME_DISTANCE = 0.99, 1e-3  # of keypoints, and of the view's radius: the same view
LEAST_COMPARED = 20  # keypoints that two views must share to be called the same
PIXELS = 2.0  # coordinates that all lie closer to 0 are no pixels: the subject would have two
ASTRAY = 0.01  # of the coordinates may be larger, for there are outliers
MARGIN = 0.05  # of the image's side: a detector may place hidden keypoints somewhat outside
OUTSIDE_SHARE = 0.02  # of a view's keypoints: more is no chance
MOTION_FRAMES = 300  # plenty to see whether anything moves
# In radii of what a view shows. A person's is half a metre, so that 0.05 is a few centimetres of
# every limb, or a turn by three degrees.
LEAST_CHANGE, LEAST_PATH = 0.05, 0.1
# A keypoint that lies so many times further off than usual, while most do not, is an outlier.
ASTRAY_ALONE, MOST_ALONE = 4.0, 0.5
USUAL = 2 / 3  # of the most: frames and keypoints that are seen less are no measure of motion
SLACK = 1.3  # of the largest variance of white noise, which is known from a median alone

ABSENCES = frozenset({"keypoint_never_seen", "view_never_seen", "too_few_frames", "one_view"})


class _Capture(NamedTuple):
    """N frames, with their extents and where keypoints were observed."""

    pixels: Float32  # (N, K, P, 2)
    seen: Bool  # (N, K, P) observed, in whatever view
    there: Extents
    numbers: NDArray[np.int64]  # (N,) of the frames in the whole capture

    def sees(self) -> Bool:
        """Which views (K,) ever show enough keypoints."""
        return np.asarray(self.there.usable.any(0))

    def views(self, chosen: Bool) -> list[int]:
        """Return the indices of the views (K,) chosen; an empty list if all usable ones are."""
        return [] if chosen[self.sees()].all() else np.flatnonzero(chosen).tolist()


def observed(keypoints: ArrayLike, confidence: ArrayLike | None = None) -> Bool:
    """Return which keypoints (N, K, P) of (N, K, P, 2) were observed."""
    seen: Bool = np.all(np.isfinite(np.asarray(keypoints, np.float32)), axis=-1)
    return seen if confidence is None else seen & (np.asarray(confidence, np.float32) > 0)


def capture_findings(
    keypoints: ArrayLike,
    confidence: ArrayLike | None = None,
    image_sizes: ImageSizes | None = None,
    *,
    places: Sequence[FrozenPlace] | None = None,
    numbers: NDArray[np.int64] | None = None,
    frames: int | None = None,
) -> tuple[Finding, ...]:
    """Return the findings of a capture, from its keypoints (N, K, P, 2) in pixels alone.

    A check that raises an error is logged, and the others go on.

    Parameters
    ----------
    keypoints, confidence
        As `models.settings.keypoints` checks them: NaN, or confidence 0, where not observed.
    image_sizes
        (width, height) in pixels of each view, None where unknown.
    places
        The result of `frozen_places`, if it was computed already.
    numbers, frames
        Of a sample: which frames of the capture these are, and how many that has.
    """
    pixels = np.asarray(keypoints, np.float32)
    seen = observed(pixels, confidence)
    numbers = np.arange(len(pixels)) if numbers is None else numbers
    frozen = np.zeros(seen.shape, np.bool_)
    if places is None:
        places = attempt(frozen_places, [], pixels, seen)
    for place in places:
        frozen[place.frames, place.k, place.p] = True
    stuck = noticed(_frozen, pixels, seen, frozen, numbers)
    seen = seen & ~frozen  # which are no detections
    capture = _Capture(pixels, seen, extents(pixels, seen), numbers)
    if not capture.sees().any():
        return stuck  # such a capture cannot be fitted: the fit's own error explains it
    return (
        *noticed(absences, seen, len(pixels) if frames is None else frames),
        *stuck,
        *noticed(_identical, capture),
        *(noticed(_normalised, capture) or noticed(_outside, capture, image_sizes)),
        *noticed(_motionless, capture),
    )


def sample(frames: int, views: int, keypoints: int) -> NDArray[np.int64]:
    """Return frames to look at: all, or of a long capture blocks of them, evenly spread."""
    most = max(BLOCKS, NUMBERS // (views * keypoints))
    if frames <= most:
        return np.arange(frames)
    starts = np.linspace(0, frames - most // BLOCKS, BLOCKS).astype(np.int64)
    return (starts[:, None] + np.arange(most // BLOCKS)).reshape(-1)


def absences(seen: Bool, frames: int) -> Iterator[Finding]:
    """Yield findings about what a capture of `frames` frames lacks.

    `seen` (N, K, P) states for a sample of them which keypoints were observed. These findings,
    `ABSENCES`, are the cheapest, and the only ones that a single frame can refute.
    """
    usable = seen.sum(2) >= MIN_KEYPOINTS  # (N, K)
    unseen = ~placed(seen & usable[..., None])
    if unseen.any():
        yield Finding.of("keypoint_never_seen", keypoints=np.flatnonzero(unseen))
    blind = ~usable.any(0)
    if blind.any():
        yield Finding.of("view_never_seen", views=np.flatnonzero(blind))
    shown, paired = usable.any(1).mean(), (usable.sum(1) > 1).mean()  # shares of the frames
    if shown * frames < LEAST_FRAMES:
        yield Finding.of("too_few_frames", frames_shown=shown * frames)
    if paired * frames < LEAST_PAIRED and paired < LEAST_PAIRED_SHARE * shown:
        yield Finding.of("one_view", frames_with_two_views=paired * frames)


def placed(shown: Bool) -> Bool:
    """Return which keypoints (P,) two views show in the same frame, by `shown` (N, K, P) of views.

    No other keypoint has a place in space. Where views share too few for any camera, each shows the
    subject on its own, as a single view does, and what one shows is enough.
    """
    together: Bool = np.any(shown.sum(1) > 1, axis=0)
    return together if together.sum() >= MIN_KEYPOINTS else np.any(shown, axis=(0, 1))


def _frozen(
    pixels: Float32, seen: Bool, frozen: Bool, numbers: NDArray[np.int64]
) -> Iterator[Finding]:
    """Yield findings of keypoints that never move, and of those that stop at times.

    A view has at most one of either.
    """
    repeats, shows = frozen.sum(0), seen.sum(0)  # (K, P)
    always = repeats >= (1 - ASTRAY) * shows
    for chosen, whole in ((frozen & always, True), (frozen & ~always, False)):
        same: dict[bytes, list[int]] = {}
        for view in np.flatnonzero(chosen.any((0, 2))).tolist():
            about = chosen[:, view].any(0) if whole else chosen[:, view]
            same.setdefault(about.tobytes(), []).append(view)
        for views in same.values():
            here = chosen[:, views[0]]  # (N, P)
            keypoints = np.flatnonzero(here.any(0))
            x, y = pixels[np.argmax(here[:, keypoints[0]]), views[0], keypoints[0]].tolist()
            counts = np.ix_(np.array(views), keypoints)
            yield Finding.of(
                "keypoint_frozen",
                views=views,
                keypoints=keypoints,
                frames=() if whole else numbers[here.any(1)],
                x=x,
                y=y,
                share=float(repeats[counts].sum() / shows[counts].sum()),
            )


def _identical(capture: _Capture) -> Iterator[Finding]:
    """Yield groups of views that show the same; one that is like the first is like the others."""
    views = capture.seen.shape[1]
    like = np.arange(views)  # the first view that shows the same
    for a, b in combinations(range(views), 2):
        both = capture.seen[:, a] & capture.seen[:, b]  # (N, P)
        if like[b] < b or like[a] < a or both.sum() < LEAST_COMPARED:
            continue
        apart = np.abs(capture.pixels[:, a][both] - capture.pixels[:, b][both]).max(-1)
        if (apart <= SAME_DISTANCE * capture.there.usual_radii[a]).mean() > SAME_SHARE:
            like[b] = a
    for first in np.unique(like[like < np.arange(views)]):
        yield Finding.of("views_identical", views=np.flatnonzero(like == first))


def _normalised(capture: _Capture) -> Iterator[Finding]:
    """Yield a finding if coordinates are shares of the image, or of anything, and not pixels."""
    small = (np.abs(capture.pixels) <= PIXELS).all(-1) & capture.seen
    views = small.sum((0, 2)) > (1 - ASTRAY) * capture.seen.sum((0, 2))  # (K,)
    if views.any():
        there = capture.pixels[capture.seen & views[:, None]]
        yield Finding.of(
            "coordinates_normalised",
            views=capture.views(views),
            least=float(there.min()),
            most=float(there.max()),
        )


def _outside(capture: _Capture, image_sizes: ImageSizes | None) -> Iterator[Finding]:
    """Yield views of which many keypoints lie outside the image, by more than a margin.

    Of an image of unknown size it is known that it begins at 0; its side is then taken for that of
    the part in which the keypoints lie.
    """
    for view in np.flatnonzero(capture.sees()).tolist():
        shown = capture.pixels[:, view][capture.seen[:, view]]  # (n, 2)
        size = None if image_sizes is None else image_sizes[view]
        if size is None:
            side = np.quantile(np.abs(shown), 1 - ASTRAY, axis=0)
            low, high = -MARGIN * side, np.full(2, np.inf)
        else:
            margin = MARGIN * np.array(size)
            low, high = -margin, size + margin
        astray = ((shown < low) | (shown > high)).any(-1)
        if astray.mean() > OUTSIDE_SHARE:
            least, most = shown.min(0), shown.max(0)
            yield Finding.of(
                "outside_image",
                views=[view],
                share=float(astray.mean()),
                least_x=float(least[0]),
                least_y=float(least[1]),
                most_x=float(most[0]),
                most_y=float(most[1]),
            )


def _motionless(capture: _Capture) -> Iterator[Finding]:
    """Yield that the subject neither changes nor moves in any view, but for the noise."""
    most_change = most_path = -1.0
    for view in np.flatnonzero(capture.there.usable.sum(0) >= LEAST_PAIRED).tolist():
        seen = capture.seen[:, view]
        usual = seen.sum(0) >= USUAL * seen.sum(0).max()
        shows = seen[:, usual].sum(1)
        frames = np.flatnonzero(shows >= USUAL * shows.max())
        frames = frames[:: -(-len(frames) // MOTION_FRAMES)]
        chosen = np.ix_(frames, usual)
        shown = np.where(seen[chosen][..., None], capture.pixels[:, view][chosen], np.nan)
        shown = shown[:, np.isfinite(shown).any((0, 2))].astype(np.float64)
        places = np.nanmedian(shown, 0)  # (P, 2)
        offsets = shown - places
        shifts = np.nanmedian(offsets, 1)  # (F, 2) of most keypoints together
        radius = float(np.sqrt(places.var(0).sum())) or 1.0  # pixels, if all are in one place
        most_change = max(most_change, _change(_kept(offsets - shifts[:, None]) / radius))
        most_path = max(most_path, float(np.sqrt(shifts.var(0).sum()) / radius))
        if most_change > LEAST_CHANGE or most_path > LEAST_PATH:
            return
    if most_change >= 0:
        yield Finding.of("no_motion", change=most_change, path=most_path)


def _kept(offsets: Float64) -> Float64:
    """Return offsets (F, P, 2) without those of keypoints that go astray alone."""
    distances = np.linalg.norm(offsets, axis=-1)
    far = distances > ASTRAY_ALONE * np.nanmedian(distances, 0)
    alone = far & (far.sum(1, keepdims=True) < MOST_ALONE * np.isfinite(distances).sum(1)[:, None])
    return np.where(alone[..., None], np.nan, offsets)


def _change(shape: Float64) -> float:
    """Return how much shapes (F, P, 2) vary about their mean, in radii, without the noise.

    This is the root mean square over keypoints of the principal components whose variance is
    above that of white noise (Marchenko & Pastur). A NaN, not observed, counts as the mean.
    """
    known = np.isfinite(shape)
    mean = np.nansum(shape, 0) / np.maximum(known.sum(0), 1)
    offsets = np.where(known, shape - mean, 0).reshape(len(shape), -1)  # (F, D)
    rows = offsets if len(offsets) < offsets.shape[1] else offsets.T  # of what is smaller
    variances = np.maximum(np.linalg.eigvalsh(rows @ rows.T), 0) / len(offsets)
    noise = np.median(variances)
    white = SLACK * noise * (1 + np.sqrt(offsets.shape[1] / len(offsets))) ** 2
    return float(np.sqrt((variances[variances > white] - noise).sum() / shape.shape[1]))
