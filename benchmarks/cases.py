"""What the benchmark of fidelity measures: a function per case."""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench import PCK_MM, Bench, Fit, Float, Float64
from benchmarks.report import TRNG, Curve, Row, precision_and_recall
from benchmarks.rig import (
    add_noise,
    detect,
    hide,
    keep_few_views,
    miscalibrate,
    scatter,
    swap_limbs,
)
from models.capture.metrics import pa_mpjpe
from models.capture.observations import as_observations
from models.settings.config import Refine

THRESHOLDS_MM = [float(mm) for mm in range(5, 155, 5)]
FEW = (0.6, 0.25, 0.15)  # shares of the frames that keep one, two, three of their views
SEEN = 0.7  # share of the frames that a fit sees where the others are to be unseen
ALL = "fitted to all views"
ALONE = "fitted to these views alone"
REFINES: tuple[Refine, ...] = ("off", "auto")


def error_by_views(bench: Bench, seed: int) -> None:
    """Every subset of the views: feed-forward, and refined with the rig known and not known."""
    everything = bench.fit(seed, bench.views)
    for count in range(len(bench.views), 0, -1):
        for views in combinations(bench.views, count):
            which = bench.showing(views, count)
            ways = {
                f"{ALL}, feed-forward": bench.lift(everything, views, refine="off").points3d,
                f"{ALL}, refined": bench.lift(everything, views).points3d,
            }
            if views != bench.views:
                unknown = bench.lift(everything, views, unknown=True).points3d
                ways[f"{ALL}, refined, cameras unknown"] = unknown
            for how, points in ways.items():
                bench.score("views", how, views, points, which, seed=seed, fitted=everything)
    if not bench.usable.all():
        points = bench.lift(everything, bench.views).points3d
        shown = bench.usable.sum(1)
        for view in bench.views:
            how = f"{ALL}, lifted with all: frames of view {view}"
            which = bench.usable[:, view]
            bench.score("views", how, bench.views, points, which, seed=seed, fitted=everything)
        for count in range(1, len(bench.views) + 1):
            how = f"{ALL}, lifted with all: {count} shown"
            bench.score(
                "views", how, bench.views, points, shown == count, seed=seed, fitted=everything
            )
    for count in (3, 2) if bench.full else (2,):
        subsets = combinations(bench.views, count) if bench.full else [bench.pair]
        for views in (views for views in subsets if views != bench.views):
            which = bench.showing(views, count)
            for how, cameras in ((ALONE, "auto"), (f"{ALONE}, declared moving", "moving")):
                alone = bench.fit(seed, views, cameras=cameras)
                points = bench.lift(alone, views, known_as=tuple(range(count))).points3d
                bench.score("views", how, views, points, which, seed=seed, fitted=alone)


def noise(bench: Bench, seed: int) -> None:
    """Gaussian noise on every 2D coordinate, and TRNG with exact cameras beside it."""
    for sigma in (0, 5, 15, 25, 35) if bench.full else (0, 15, 35):
        spoilt = add_noise(bench.keypoints, sigma, seed)
        for views in bench.sets if bench.full else [bench.pair]:
            which = bench.showing(views, 2)
            key = f"noise {sigma}" if sigma else ""  # without noise: the fit of the other cases
            own = tuple(range(len(views)))
            ways: list[tuple[str, bool, dict[str, Any]]] = [(ALONE, False, {})]
            if bench.times is not None:
                ways.append((f"{ALONE}, times given", True, {}))
            if sigma and bench.full and views == bench.pair:
                ways.append((f"{ALONE}, declared moving", False, {"cameras": "moving"}))
            for how, timed, changes in ways:
                fitted = bench.fit(seed, views, keypoints=spoilt, key=key, timed=timed, **changes)
                points = bench.lift(
                    fitted, views, keypoints=spoilt, known_as=own, timed=timed
                ).points3d
                bench.score(
                    "noise", how, views, points, which, seed=seed, level=sigma, fitted=fitted
                )
            if bench.rig is not None:
                points = bench.triangulated(views, bench.rig.projections[list(views)], spoilt)
                how = f"{TRNG}, exact calibration"
                bench.score("noise", how, views, points, which, seed=seed, level=sigma)


def noisy_pairs(bench: Bench, seed: int) -> None:
    """15 pixels of noise in every pair of views, each fitted alone."""
    spoilt = add_noise(bench.keypoints, 15, seed)
    for views in combinations(bench.views, 2) if bench.full else [bench.pair]:
        fitted = bench.fit(seed, views, keypoints=spoilt, key="noise 15")
        points = bench.lift(fitted, views, keypoints=spoilt, known_as=(0, 1)).points3d
        which = bench.showing(views, 2)
        bench.score("pairs", ALONE, views, points, which, seed=seed, level=15, fitted=fitted)


def outliers(bench: Bench, seed: int) -> None:
    """Keypoints placed anywhere in the image, in hundredths, and how many of them are found."""
    for share in (5, 20) if bench.full else (5,):
        spoilt, placed = scatter(bench.keypoints, share / 100, bench.sizes, seed)
        _score_spoilt(bench, seed, "outliers", share, spoilt, placed)


def harmed(bench: Bench, seed: int) -> None:
    """15 pixels of noise, a tenth of the keypoints missing, a twentieth anywhere in the image."""
    spoilt, _ = scatter(add_noise(bench.keypoints, 15, seed), 0.05, bench.sizes, seed)
    _score_spoilt(bench, seed, "harmed", 15, hide(spoilt, 0.1, seed))


def detector(bench: Bench, seed: int) -> None:
    """Errors like those of a detector, in hundredths of the subject's size; all is scored."""
    for share in (2, 4, 8) if bench.full else (4,):
        _score_spoilt(bench, seed, "detector", share, detect(bench.keypoints, share / 100, seed))


def swapped(bench: Bench, seed: int) -> None:
    """Limbs taken for those of the other side, in hundredths of the views of frames."""
    if (bench.partners == np.arange(len(bench.partners))).all():
        return  # without names the side of a keypoint is unknown
    for share in (4, 10) if bench.full else (4,):
        spoilt = swap_limbs(bench.keypoints, bench.partners, share / 100, seed)
        _score_spoilt(bench, seed, "swapped", share, spoilt)


def _score_spoilt(
    bench: Bench,
    seed: int,
    case: str,
    level: int,
    spoilt: Float64,
    placed: NDArray[np.bool_] | None = None,
) -> None:
    """Fit and lift spoilt keypoints; `placed` (N, K, P) are those that the lift is to find."""
    for views in bench.sets:
        which, own = bench.showing(views, 1), tuple(range(len(views)))
        fitted = bench.fit(seed, views, keypoints=spoilt, key=f"{case} {level}")
        lift = bench.lift(fitted, views, keypoints=spoilt, known_as=own)
        found = (
            None
            if placed is None
            else precision_and_recall(lift.outlier_probability, placed[:, views])
        )
        points = lift.points3d
        bench.score(
            case, ALONE, views, points, which, fitted=fitted, level=level, seed=seed, found=found
        )
        if bench.rig is not None:
            points = bench.triangulated(views, bench.rig.projections[list(views)], spoilt)
            how = f"{TRNG}, exact calibration"
            bench.score(case, how, views, points, which, seed=seed, level=level)


def miscalibration(bench: Bench, seed: int) -> None:
    """TRNG with a wrong calibration, beside a fit without given cameras."""
    if bench.rig is None:
        return
    keypoints = bench.keypoints
    for views in bench.sets:
        which = bench.showing(views, 2)
        cameras = bench.rig.projections[list(views)]
        exact = bench.triangulated(views, cameras, keypoints)
        bench.score("trng", f"{TRNG}, exact calibration", views, exact, which, seed=seed, level=0)
        for part in ("extrinsics", "intrinsics"):
            for sigma in (0.1, 0.5, 0.9):
                wrong = miscalibrate(cameras, part, sigma, len(keypoints), bench.metre, seed)
                points = bench.triangulated(views, wrong, keypoints)
                how = f"{TRNG}, {part} off"
                bench.score("trng", how, views, points, which, seed=seed, level=sigma)
        fitted = bench.fit(seed, views)
        points = bench.lift(fitted, views, known_as=tuple(range(len(views)))).points3d
        bench.score("trng", ALONE, views, points, which, seed=seed, fitted=fitted)


def unseen(bench: Bench, seed: int) -> None:
    """Frames that the fit did not see: the end of the capture, and some drawn at random."""
    count = len(bench.keypoints)
    cut = round(SEEN * count)
    shuffled = np.random.default_rng(seed).permutation(count)
    ways = {"first 70 %, lifts all others": np.arange(cut)}
    ways["random 70 %, lifts all others"] = np.sort(shuffled[:cut])
    for way, frames in ways.items():
        fitted = bench.fit(seed, bench.views, frames=frames, key=way)
        rest = np.ones(count, bool)
        rest[frames] = False
        for views in (bench.views, bench.pair, bench.pair[:1]):
            for refine in REFINES:
                points = bench.lift(fitted, views, refine=refine).points3d
                for part, which in (("unseen", rest), ("seen", ~rest)):
                    shown = which & bench.showing(views, 1)
                    how = f"{way}: {part}{_refined(refine)}"
                    bench.score("unseen", how, views, points, shown, seed=seed, fitted=fitted)


def missing(bench: Bench, seed: int) -> None:
    """Keypoints hidden at random, from the fit and from the lift; all of them are scored."""
    for share in (0.1, 0.3, 0.5) if bench.full else (0.3,):
        gappy = hide(bench.keypoints, share, seed)
        for views in bench.sets if bench.full else [bench.views]:
            fitted = bench.fit(seed, views, keypoints=gappy, key=f"missing {share}")
            which, known_as = bench.showing(views, 1), tuple(range(len(views)))
            for refine in REFINES:
                points = bench.lift(
                    fitted, views, keypoints=gappy, known_as=known_as, refine=refine
                ).points3d
                how = ALONE + _refined(refine)
                bench.score(
                    "missing", how, views, points, which, seed=seed, level=share, fitted=fitted
                )


def few_views(bench: Bench, seed: int) -> None:
    """Most frames keep one view, some two, few three, in the fit and in the lift."""
    if len(bench.views) <= len(FEW):
        return
    sparse = keep_few_views(bench.keypoints, FEW, seed)
    fitted = bench.fit(seed, bench.views, keypoints=sparse, key="few views")
    shown = as_observations(sparse, bench.given_confidence).usable.sum(1)  # (N,)
    for refine in REFINES:
        points = bench.lift(fitted, bench.views, keypoints=sparse, refine=refine).points3d
        for count in range(1, len(FEW) + 1):
            how, which = f"{count} shown{_refined(refine)}", shown == count
            bench.score("few", how, bench.views, points, which, seed=seed, fitted=fitted)


def _refined(refine: Refine) -> str:
    return ", feed-forward" if refine == "off" else ", refined"


def correct_keypoints(bench: Bench, seed: int) -> None:
    """PCK against the number of views, over all subsets of so many, and against the threshold."""
    everything = bench.fit(seed, bench.views)
    for count in range(1, len(bench.views) + 1):
        ours, theirs = [], []
        for views in combinations(bench.views, count):
            which = bench.showing(views, count)
            truth = bench.truth[which]
            points = bench.lift(everything, views).points3d[which]
            ours.append(pa_mpjpe(points, truth, reflection="never").errors)
            if bench.rig is not None and count > 1:
                cameras = bench.rig.projections[list(views)]
                points = bench.triangulated(views, cameras, bench.keypoints)[which]
                theirs.append(pa_mpjpe(points, truth, reflection="never").errors)
        for label, errors in ((ALL, ours), (f"{TRNG}, exact calibration", theirs)):
            _add_curve(bench, f"{label}, {count} of them", count, errors, seed, everything)


def _add_curve(
    bench: Bench, label: str, count: int, parts: Sequence[Float], seed: int, fitted: Fit
) -> None:
    """Add a curve over thresholds, and a row at the paper's; means over keypoints."""
    mm = 1000 / bench.metre * np.concatenate([part.ravel() for part in parts] or [np.empty(0)])
    mm = mm[np.isfinite(mm)]
    if not mm.size:
        return
    shares = [float((mm < threshold).mean()) for threshold in THRESHOLDS_MM]
    bench.report.curves.append(Curve(label, seed, THRESHOLDS_MM, shares))
    bench.report.add(
        Row(
            case="pck",
            how=label,
            views=bench.views,
            level=count,
            seed=seed,
            error_mm=float(mm.mean()),
            pck=float((mm < PCK_MM).mean()),
            frames=sum(len(part) for part in parts),
            fit_seconds=None if label.startswith(TRNG) else fitted.seconds,
            focal=None if label.startswith(TRNG) else fitted.focal,
        )
    )


def ablations(bench: Bench, seed: int) -> None:
    """One switch of the configuration at a time against the default."""
    lifted: list[tuple[str, Refine | None, dict[str, Any]]] = [
        ("the default", None, {}),
        ("lifted with refine full", "full", {}),
        ("lifted with refine off", "off", {}),
        ("refine off, also in the fit", None, {"refine": "off"}),
        ("distillation off", None, {"distillation": False}),
        ("distillation and refine off", None, {"distillation": False, "refine": "off"}),
        ("cameras moving", None, {"cameras": "moving"}),
        ("cameras static", None, {"cameras": "static"}),
    ]
    if bench.sizes is not None:
        lifted.append(("image sizes not given", None, {"sized": False}))
    for how, refine, changes in lifted if bench.full else lifted[:6]:
        fitted = bench.fit(seed, bench.views, **changes)
        for views in (bench.views, bench.pair, bench.pair[:1]):
            points = bench.lift(fitted, views, refine=refine).points3d
            which = bench.showing(views, 1)
            bench.score("ablations", how, views, points, which, seed=seed, fitted=fitted)


CASES: dict[str, Callable[[Bench, int], None]] = {
    "views": error_by_views,
    "noise": noise,
    "pairs": noisy_pairs,
    "outliers": outliers,
    "harmed": harmed,
    "detector": detector,
    "swapped": swapped,
    "trng": miscalibration,
    "pck": correct_keypoints,
    "unseen": unseen,
    "missing": missing,
    "few": few_views,
    "ablations": ablations,
}
