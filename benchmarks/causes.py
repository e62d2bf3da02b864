"""Plants a fault in one view's pixels of drawn rigs, and asks whether it is named.

    python -m benchmarks.causes --half setting --draws 0 40 --data MOTIONS

No fit is made: cameras are found from keypoints alone. The error of triangulation with them is that
of structures aligned frame by frame, over the subject's height: unharmed, harmed, and mended as the
causes have it. A fault that lenses absorb without a trace is not named, and does little harm.
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.drawn_captures import Draw
from benchmarks.draws import add_options, of_draws
from benchmarks.figures import print_table
from benchmarks.motions import HALVES
from models.calibrating.image_sizes import ImageSizes
from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.problem import CalibrationProblem, problem_of
from models.capture.metrics import pa_mpjpe
from models.causes.cause import Cause, mended
from models.causes.cause_search import find_causes
from models.numerics.steps import finished
from models.settings.config import FitConfig

Float64 = NDArray[np.float64]
Size = tuple[float, float]
MENDED, NEGLIGIBLE = 1.1, 0.002  # of the unharmed error, and of the height: within them no harm
Harm = Callable[[Float64, Size, np.random.Generator], Float64]


def cropped(p: Float64, size: Size, rng: np.random.Generator) -> Float64:
    """Count from a window's corner."""
    corner = np.array((rng.uniform(0.12, 0.35) * size[0], rng.uniform(0.08, 0.3) * size[1]))
    return np.asarray(p - np.round(corner))


def padded(p: Float64, size: Size, _: np.random.Generator) -> Float64:
    """Multiply shares of a padded square by the sides of the image."""
    middle = np.array(size) / 2
    return np.asarray(middle + (p - middle) * np.array(size) / max(size))


def bent(p: Float64, size: Size, _: np.random.Generator) -> Float64:
    """Stretch the sides of an image more than its middle, as action cameras do."""
    u = p[..., 0] / size[0] * 2 - 1
    across = (u * (0.82 + 0.18 * u * u) + 1) * size[0] / 2
    return np.stack((across, p[..., 1]), -1)


HARMS: dict[str, tuple[tuple[str, ...], Harm]] = {
    "unharmed": ((), lambda p, _, __: p),
    "cropped": (("cropped",), cropped),
    "padded": (("padded", "stretched"), padded),
    "half": (("scaled",), lambda p, _, __: p / 2),
    "two_thirds": (("scaled",), lambda p, _, __: p * 2 / 3),
    "stretched": (("stretched", "padded"), lambda p, _, __: p * (1, 0.75)),
    "bent": (("stretched", "padded"), bent),
    "mirrored": (("mirrored",), lambda p, s, _: np.stack((s[0] - 1 - p[..., 0], p[..., 1]), -1)),
    "upside_down": (("upside_down",), lambda p, s, _: np.array(s) - 1 - p),
    "on_its_side": (
        ("on_its_side",),
        lambda p, s, _: np.stack((p[..., 1], s[0] - 1 - p[..., 0]), -1),
    ),
    "axes_exchanged": (("axes_exchanged",), lambda p, _, __: p[..., ::-1]),
}


class Row(NamedTuple):
    """What was found of one draw with one harm."""

    number: int
    harm: str
    named: bool  # the view and its kind, and no other view
    causes: tuple[Cause, ...]
    seconds: float  # of the search for causes
    error: float  # of the subject's height, without the harm
    harmed: float
    mended: float


def measure(draw: Draw, harm: str, unharmed: float) -> Row:
    """Plant a harm in one view of a draw, whose error is known, and look for causes."""
    rng = np.random.default_rng([draw.number, 7])
    keypoints, view = draw.keypoints.copy(), int(rng.integers(draw.keypoints.shape[1]))
    size = 2 * draw.centres.mean(0) if draw.sizes is None else draw.sizes[view]
    kinds, done = HARMS[harm]
    keypoints[:, view] = done(keypoints[:, view], (float(size[0]), float(size[1])), rng)
    problem, harmed = _located(draw, keypoints, draw.sizes)
    started = time.process_time()
    causes = finished(find_causes(problem))
    seconds = time.process_time() - started
    found = {(cause.view, cause.kind) for cause in causes}
    named = not found if not kinds else found <= {(view, kind) for kind in kinds} and bool(found)
    error = harmed
    if causes:
        after = mended(keypoints.astype(np.float32), None, draw.sizes, causes)
        _, error = _located(draw, after.keypoints.astype(np.float64), after.image_sizes)
    return Row(draw.number, harm, named, causes, seconds, unharmed, harmed, error)


def _located(
    draw: Draw, keypoints: Float64, sizes: ImageSizes | None
) -> tuple[CalibrationProblem, float]:
    """Return the problem of keypoints (N, K, P, 2) with its geometry, and its error."""
    weights = np.asarray(np.isfinite(keypoints).all(-1), np.float64)
    problem = problem_of(np.nan_to_num(keypoints), weights, sizes, FitConfig())
    geometry = finished(geometry_of(problem, declared=False))
    problem = problem._replace(geometry=geometry)
    if geometry.rig is None:
        return problem, float("inf")
    truth = np.where(draw.seen_twice[..., None], draw.points3d, np.nan)
    error = pa_mpjpe(geometry.rig.best.points, truth, reflection="never").mean
    return problem, error / draw.height


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Plant faults of one view's pixels in drawn rigs.")
    add_options(parser)
    parser.add_argument("--half", choices=HALVES, help="draw the motions of this half")
    parser.add_argument("--harms", nargs="+", choices=list(HARMS), default=list(HARMS))
    arguments = parser.parse_args()
    rows = []
    for some in of_draws(_measured, arguments, arguments.half):
        for row in some:
            rows.append(row)
            words = [f"{cause.kind} of view {cause.view}" for cause in row.causes]
            errors = [f"{100 * error:.2f}" for error in (row.error, row.harmed, row.mended)]
            verdict = "right" if row.named else "not right"
            print(row.number, row.harm, " -> ".join(errors), verdict, *words, flush=True)
    table = []
    for harm in arguments.harms:
        ours = [row for row in rows if row.harm == harm]
        wrong = sum(bool(row.causes) and not row.named for row in ours)
        seconds = float(np.mean([row.seconds for row in ours])) if ours else None
        right = sum(row.named for row in ours)
        figures = {"rigs": len(ours), "right": right, "wrongly named": wrong, "seconds": seconds}
        least = [max(MENDED * row.error, row.error + NEGLIGIBLE) for row in ours]
        figures["harmed"] = sum(r.harmed > most for r, most in zip(ours, least, strict=True))
        figures["not mended"] = sum(r.mended > most for r, most in zip(ours, least, strict=True))
        table.append({"harm": harm} | figures)
    print_table("Harms", table)


def _measured(draw: Draw, arguments: argparse.Namespace) -> list[Row] | None:
    if draw.moving or draw.keypoints.shape[1] < 3:
        return None
    _, error = _located(draw, draw.keypoints, draw.sizes)
    return [measure(draw, harm, error) for harm in arguments.harms]


if __name__ == "__main__":
    main()
