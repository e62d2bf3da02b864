"""What several views of many frames say together: lenses, handedness, which cameras rest, shapes.

Starts from the network's weak-perspective answers. Everything is one maximum-a-posteriori problem
(`models.bundle.adjustment`) in which what the user told is a constant or a prior; expectation
maximisation learns the noise of the keypoints and the Gaussian shape model beside it.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from models.bundle.adjustment import (
    Rig,
    Scene,
    ShapePrior,
    SharedPrior,
    Views,
    adjust,
    place,
    refine,
    structure_covariances,
)
from models.bundle.bone_lengths import find_segments
from models.bundle.frame import OPTICS, OUTLIER, POSE, VIEW
from models.bundle.initial_poses import gather, starting_scene
from models.bundle.shape_model import (
    MOST_COMPONENTS,
    Doubts,
    ShapeModel,
    Similarity,
    align,
    learn_shapes,
    no_doubts,
)
from models.network.settling import SETTLE_ALL, SettlingPolicy, mirrored
from models.optics.lenses import COEFFICIENTS, Optics, image
from models.settings.calibration import Camera
from models.settings.config import FitConfig
from models.settings.keypoints import MIN_KEYPOINTS

Edges = dict[tuple[int, int], tuple[Tensor, Tensor, float]]  # see `_relative`
# Structures (N, P, 3), rotations (N, K, 3, 3), scales (N, K) and translations (N, K, 2).
Answers = tuple[Tensor, Tensor, Tensor, Tensor]
T = TypeVar("T")
Steps = Generator[None, None, T]  # yields between iterations, so that a fit can be stopped there
ImageSizes = Sequence[tuple[int, int] | None]

USUAL_FOCAL = 1.2  # times the longer side of the image: a field of view of 45 degrees
FOCAL_SDS = (0.3, 0.01)  # of the log focal length: of all cameras together, of each beside that
RADIAL_SDS = (0.2, 0.05)  # of the first radial coefficient, likewise
CENTRE_SD = 0.02  # of the principal point, as a share of the image's side
SIZE_SD = 0.3  # of the log size of a subject from frame to frame, seen by cameras at rest
FIXED = 1e8  # inverse variance of what does not vary
FIRST_SPREAD = 0.2  # of a structure about the network's, in units of its radius
LEAST_SPREAD = 0.02
FAINT = 0.005  # of a view's size: less noise than that, and lenses need no help of the shape model
FIRST_NOISE = 0.03  # of a keypoint, as a share of its view's size
LEAST_NOISE = 3e-4  # of the image's side: what lens models leave
LEAST_MEASURED = 3e-5  # of the image's side
COOLING = 0.25  # the noise falls no faster in a round
MOST_FRAMES, LEAST_FRAMES = 400, 20
OPERATIONS = 300_000_000  # in one iteration
ROUNDS = 4  # of expectation maximisation
SEGMENTED_ROUNDS = 8  # at most: until no focal length changes
FOUND = 3e-4  # by more than this share
WARM, ADJUSTMENTS, REFINEMENTS = 15, 10, 15  # iterations
LIKELY_REST = 12.0  # degrees, median scatter of a relative rotation beyond which cameras move
SEGMENTED_SPREAD = 0.1  # LEAST_SPREAD for such keypoints
DECISIVE = 0.5  # share of its cost that a frame of the other handedness must do with
MISFIT = 0.05  # of two statements about one length
REST_NOISE = 1.4  # times the noise of the moving model: more, and the cameras do not rest
REST_SLACK = 1e-4  # of the image's side, on top
BARREL = -0.1  # radial coefficient from which a lens may be a fisheye
PLAINLY = 0.95  # share of the noise that lenses must do with to be taken for fisheyes
WRONG = 1.5  # times the noise without a calibration: more, and it is wrong


@dataclass(frozen=True)
class Discovery:
    """What a fit knows of its cameras and shapes."""

    rig: Rig
    deviations: Tensor  # (K, 10) standard deviations of what `adjustment.VIEW` numbers; 0 if kept
    shapes: ShapeModel
    doubts: Doubts
    settling: SettlingPolicy  # which frames of a lift are settled
    noise: float  # pixels, of a coordinate of confidence 1
    unit: float  # what a unit of the structure is in the user's unit; 1 without one
    errors: Tensor  # (K,) pixels, mean reprojection error
    reason: str
    warnings: tuple[str, ...]

    @property
    def resting(self) -> Tensor:
        """Which views (K,) rest relative to another."""
        return torch.bincount(self.rig.groups)[self.rig.groups] > 1


class NothingFoundError(Exception):
    """The keypoints do not determine any cameras."""


class Problem(NamedTuple):
    """The frames that a discovery looks at."""

    keypoints: Tensor  # (N, K, P, 2) pixels
    weights: Tensor  # (N, K, P)
    side: float  # pixels, the longest side of the images
    size: float  # pixels, mean root-mean-square radius of a view
    reference: Rig  # lenses as they are given, or usual
    calibration: tuple[Camera | None, ...]

    def views(self, noise: float) -> Views:
        """Return the keypoints, weighted for this noise in pixels."""
        return Views(self.keypoints, self.weights / noise**2)


class State(NamedTuple):
    """A solution, and what it was found with."""

    rig: Rig
    scene: Scene
    prior: ShapePrior
    shapes: ShapeModel
    noise: float
    measured: float  # noise, without the least that is reckoned with
    information: Tensor  # (F, F) about what is free of the rig


def starting_rig(
    keypoints: Tensor,
    weights: Tensor,
    image_sizes: ImageSizes | None,
    calibration: Sequence[Camera | None] | None,
) -> tuple[Rig, float]:
    """Return moving cameras with given or usual lenses, and the longest side in pixels."""
    views = keypoints.shape[1]
    seen = weights > 0
    low = torch.where(seen[..., None], keypoints, torch.inf).amin((0, 2))  # (K, 2)
    high = torch.where(seen[..., None], keypoints, -torch.inf).amax((0, 2))
    empty = ~seen.any(-1).any(0)
    low[empty], high[empty] = 0, 1
    focals = torch.empty(views, 2, dtype=torch.float64)
    centres, distortion = (low + high) / 2, torch.zeros(views, COEFFICIENTS, dtype=torch.float64)
    fisheye = torch.zeros(views, dtype=torch.bool)
    longest = 0.0
    for k in range(views):
        size = image_sizes[k] if image_sizes is not None else None
        side = float((high[k] - low[k]).max())
        if size is not None:
            centres[k] = torch.tensor(size, dtype=torch.float64) / 2
            side = float(max(size))
        focals[k] = USUAL_FOCAL * side
        longest = max(longest, side)
        camera = calibration[k] if calibration is not None else None
        if camera is not None and camera.intrinsics is not None:
            lens = camera.intrinsics
            focals[k] = torch.tensor([lens.fx, lens.fy])
            centres[k] = torch.tensor([lens.cx, lens.cy])
            distortion[k, : len(lens.distortion)] = torch.tensor(
                lens.distortion, dtype=torch.float64
            )
            fisheye[k] = lens.model == "fisheye"
    eye = torch.eye(3, dtype=torch.float64).repeat(views, 1, 1)
    optics = Optics(focals, centres, distortion, fisheye)
    still = torch.zeros(views, 3, dtype=torch.float64)
    return Rig(optics, torch.arange(views), eye, still), longest


def discover(
    keypoints: Tensor,
    weights: Tensor,
    answers: Answers,
    config: FitConfig,
    image_sizes: ImageSizes | None,
) -> Steps[tuple[Discovery, Scene]]:
    """Find lenses, handedness, resting cameras and the shape model; yields between iterations.

    Parameters
    ----------
    keypoints, weights
        (N, K, P, 2) pixels and (N, K, P) confidences of frames with two usable views or more.
    answers
        The network's structures (N, P, 3), rotations (N, K, 3, 3), scales (N, K) and translations
        (N, K, 2), any finite number for a view that is not there.

    Returns
    -------
    What was found, and the structures and poses of the frames.

    Raises
    ------
    NothingFoundError
        When no frame can be explained at all.
    """
    views = keypoints.shape[1]
    calibration = config.calibration or (None,) * views
    reference, side = starting_rig(keypoints, weights, image_sizes, calibration)
    there = weights.sum(-1) > 0
    size = float((answers[2] * there).sum() / there.sum())
    problem = Problem(keypoints, weights, side, size, reference, calibration)
    start = yield from _choose_hand(problem, starting_scene(*answers, reference), config)

    best, unit, reason, warnings = yield from _find(problem, start, config)
    bent = _as_fisheye(problem, best)
    if bent is not None:
        trial = yield from _learn(*bent)
        if trial.measured < PLAINLY * best.measured:
            problem, best = bent[0], trial
            reason = f"{reason}; fisheye lenses explain the keypoints better"
    if best.noise < FAINT * size and find_segments(best.scene.points).steady:
        # The lens under which shapes look most alike need not be the true one, and with two views
        # it is not; with a wrong one, segments grow and shrink as they turn.
        best = yield from _learn(problem, best, segmented=True)
    if config.known_length is not None:
        a, b = config.known_length.keypoints
        lengths = (best.scene.points[:, a] - best.scene.points[:, b]).norm(dim=-1)
        measured = float((best.scene.sizes[:, 0].exp() * lengths).median())
        known = config.known_length.length / measured
        if unit is not None and abs(math.log(known / unit)) > MISFIT:
            warnings = (
                *warnings,
                f"the known length says that the calibration's unit is off by a factor of"
                f" {known / unit:.3g}; the known length is used",
            )
        unit = known
    camera = place(best.scene, best.rig)
    distances = (image(camera, best.rig.optics) - keypoints).norm(dim=-1)
    seen = weights > 0
    errors = (distances * seen).sum((0, 2)) / seen.sum((0, 2)).clamp_min(1)
    discovery = Discovery(
        best.rig,
        _deviations(problem, best),
        best.shapes,
        no_doubts(keypoints.shape[2]),
        SETTLE_ALL,
        best.measured,
        1.0 if unit is None else unit,
        errors,
        reason,
        warnings,
    )
    return discovery, best.scene


def _find(
    problem: Problem, start: State, config: FitConfig
) -> Steps[tuple[State, float | None, str, tuple[str, ...]]]:
    """Try moving cameras, then what rests: solution, unit if one was given, reason, warnings."""
    moving = yield from _learn(problem, start)
    warnings: tuple[str, ...] = ()
    posed = [
        k for k, c in enumerate(problem.calibration) if c is not None and c.rotation is not None
    ]
    if len(posed) > 1:
        state, unit = _calibrated(problem, moving, posed)
        state = yield from _learn(problem, state)
        if state.noise <= WRONG * moving.noise + REST_SLACK * problem.side:
            return state, unit, "the poses of the cameras were given", ()
        worst = _worst(problem, moving, state, posed)
        warnings = (
            f"the given poses do not fit the keypoints: noise {state.measured:.3g} px with them,"
            f" {moving.measured:.3g} px without; view {worst} fits worst, its camera may have been"
            " moved since. They were not used",
        )
    if config.cameras == "moving":
        return moving, None, "the cameras were declared moving", warnings
    state, reason = yield from _find_rest(problem, moving, config)
    return state, None, reason, warnings


def _as_fisheye(problem: Problem, state: State) -> tuple[Problem, State] | None:
    """Replace unknown lenses by fisheyes (Kannala & Brandt, 2006) where they bend enough inwards.

    A fisheye looks like a pinhole with a radial coefficient of -1/3, near its axis.
    """
    lens = state.rig.optics
    unknown = torch.tensor([c is None or c.intrinsics is None for c in problem.calibration])
    if not unknown.any() or lens.distortion[unknown, 0].mean() > BARREL:
        return None
    fisheye = lens.fisheye | unknown
    reference = problem.reference.optics
    straight = torch.where(unknown[:, None], 0.0, lens.distortion)
    return (
        problem._replace(
            reference=problem.reference._replace(optics=reference._replace(fisheye=fisheye))
        ),
        state._replace(
            rig=state.rig._replace(optics=lens._replace(distortion=straight, fisheye=fisheye))
        ),
    )


def most_frames(views: int, keypoints: int) -> int:
    """Say how many frames a discovery can look at in bounded time: half a second an iteration."""
    unknowns = (POSE + VIEW) * views + MOST_COMPONENTS
    return max(LEAST_FRAMES, min(MOST_FRAMES, OPERATIONS // (3 * keypoints * unknowns**2)))


def same_hand(points: Tensor, others: Tensor) -> bool:
    """Whether most structures (N, P, 3) are no mirror images of the others (N, P, 3)."""
    centred = others - others.mean(1, keepdim=True)
    votes = []
    for sign in (1, -1):
        aligned, _ = align(sign * points, centred)
        votes.append((aligned - centred).square().sum((1, 2)))
    return bool((votes[0] < votes[1]).double().mean() > 0.5)


def size_precision(rig: Rig) -> Tensor:
    """Return the inverse variance of the log size that each group of a rig sees, (G,)."""
    members = torch.bincount(rig.groups, minlength=rig.size)
    return torch.where(members > 1, 1 / SIZE_SD**2, FIXED).to(torch.float64)


def _mirror(scene: Scene) -> Scene:
    points, rotations = mirrored(scene.points, scene.rotations)
    return scene._replace(points=points, rotations=rotations)


def _choose_hand(problem: Problem, scene: Scene, config: FitConfig) -> Steps[State]:
    """Refine as the network has it and mirrored; what explains the keypoints better stays."""
    rig, noise = problem.reference, FIRST_NOISE * problem.size
    precision = size_precision(rig)
    views = problem.views(noise)
    found: list[tuple[Scene, Tensor]] = []
    for hand in (scene, _mirror(scene)):
        yield
        found.append(
            refine(views, rig, _loose(hand), hand, size_precision=precision, iterations=WARM)
        )
    costs = torch.stack([costs for _, costs in found])  # (2, N)
    if not costs.isfinite().any():
        raise NothingFoundError
    # Frames that neither explains must not decide for all.
    bound = 2 * costs[costs.isfinite()].quantile(0.95)
    mirror = bool(costs[1].clamp_max(bound).sum() < costs[0].clamp_max(bound).sum())
    if config.handedness is not None:
        mirror = _volume(found[0][0].points, config.handedness) < 0
    # A frame that the network mirrored is turned back, if its keypoints say so decidedly.
    turned = costs[1 - mirror] < DECISIVE * costs[int(mirror)]
    ours, theirs = found[mirror][0], found[1 - mirror][0]
    best = Scene(
        *(
            torch.where(turned.reshape(-1, *[1] * (a.ndim - 1)), b, a)
            for a, b in zip(ours, theirs, strict=True)
        )
    )
    start = _mirror(scene) if mirror else scene
    prior = _loose(start)._replace(
        means=torch.where(turned[:, None, None], best.points, start.points)
    )
    fine = torch.minimum(*costs).isfinite()
    covariances, _ = _doubts(views, rig, prior, best, precision, fine)
    shapes = learn_shapes(best.points[fine], covariances, floor=LEAST_SPREAD)
    nothing = torch.zeros(0, 0)
    return State(rig, best, prior, shapes, noise, noise, nothing)


def _volume(points: Tensor, corners: tuple[int, int, int, int]) -> float:
    a, b, c, d = (points[:, i] for i in corners)
    volumes = (torch.linalg.cross(b - a, c - a, dim=-1) * (d - a)).sum(-1)
    return float(volumes.median())


def _loose(scene: Scene) -> ShapePrior:
    frames, count, _ = scene.points.shape
    return ShapePrior(
        scene.points,
        scene.points.new_zeros(count, 3, 0),
        FIRST_SPREAD,
        scene.points.new_ones(frames),
    )


def _learn(problem: Problem, state: State, *, segmented: bool = False) -> Steps[State]:
    """Maximise expectations: adjust, then learn the noise and the shape model, and again.

    `segmented`: segments have a say, too, and the shape model less of it.
    """
    rig, scene, prior, shapes, noise, measured, information = state
    floor = LEAST_NOISE * problem.side
    precision, focals = size_precision(rig), rig.optics.focals
    least = SEGMENTED_SPREAD if segmented else LEAST_SPREAD
    for _ in range(SEGMENTED_ROUNDS if segmented else ROUNDS):
        views = problem.views(noise)
        rig, scene, _, information = yield from adjust(
            views,
            rig,
            prior,
            scene,
            size_precision=precision,
            shared=shared_prior(problem, rig),
            segments=find_segments(scene.points) if segmented else None,
            iterations=ADJUSTMENTS,
        )
        yield
        scene, costs = refine(
            views, rig, prior, scene, size_precision=precision, iterations=REFINEMENTS
        )
        yield
        fine = costs.isfinite()
        covariances, factor = _doubts(views, rig, prior, scene, precision, fine)
        measured = max(factor * noise, LEAST_MEASURED * problem.side)
        noise = max(factor * noise, COOLING * noise, floor)
        shapes = learn_shapes(scene.points[fine], covariances, floor=least)
        points, moved = align(scene.points, shapes.mean)
        scene = regauge(scene, points, moved, rig)
        prior = _about(shapes, len(points))
        change, focals = (rig.optics.focals / focals).log().abs().max(), rig.optics.focals
        if segmented and change < FOUND:
            break
    return State(rig, scene, prior, shapes, noise, measured, information)


def _about(shapes: ShapeModel, frames: int) -> ShapePrior:
    return ShapePrior(
        shapes.mean.expand(frames, -1, -1),
        shapes.basis,
        shapes.spread,
        shapes.mean.new_ones(frames),
    )


def _members(rig: Rig) -> Tensor:
    """Which group (K, G) each view belongs to, 1 or 0."""
    return torch.nn.functional.one_hot(rig.groups, rig.size).to(torch.float64)


def regauge(scene: Scene, points: Tensor, moved: Similarity, rig: Rig) -> Scene:
    """Give the structures another frame of reference, in which they are `points` (N, P, 3).

    Groups of several views take the scale into their size, those of one into their distance.
    """
    several = torch.bincount(rig.groups, minlength=rig.size) > 1  # (G,)
    shift = (scene.rotations @ moved.centres.mT[:, None])[..., 0]
    translations = scene.translations + scene.sizes.exp()[..., None] * shift
    scales = moved.scales[:, None].expand_as(scene.sizes)
    return Scene(
        points,
        scene.rotations @ moved.rotations[:, None],
        torch.where(several[:, None], translations, translations * scales[..., None]),
        torch.where(several, scene.sizes - scales.log(), scene.sizes),
    )


def _doubts(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, precision: Tensor, fine: Tensor
) -> tuple[Tensor, float]:
    """Covariances of the structures of frames `fine` (N,), and the factor that the noise lacks."""
    parts = []
    for part in torch.split(fine.nonzero()[:, 0], 128):  # bounds the memory
        frames = (
            Views(*(a[part] for a in views)),
            rig,
            prior.of(part),
            Scene(*(a[part] for a in scene)),
        )
        covariances = structure_covariances(*frames, size_precision=precision)
        parts.append((covariances, *_noise_terms(*frames, covariances)))
    squared, freedom = (sum(part[i] for part in parts) for i in (1, 2))
    return torch.cat([part[0] for part in parts]), math.sqrt(squared / max(freedom, 1.0))


def _noise_terms(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, covariances: Tensor
) -> tuple[float, float]:
    """Sum of the robust residuals over the noise, and their degrees of freedom."""
    camera = place(scene, rig)
    squared = views.weights * (image(camera, rig.optics) - views.keypoints).square().sum(-1)
    seen = views.weights > 0
    robust = (OUTLIER / squared.clamp_min(1e-12).sqrt()).clamp_max(1) * squared
    # Of the structure's unknowns the data determine as many as the prior does not.
    flat = prior.basis.flatten(0, 1)
    inner = torch.linalg.solve(prior.inner(), flat.T)  # (Q, 3 P)
    trace = covariances.diagonal(dim1=1, dim2=2).sum(-1)
    trace = trace - (inner.T * (covariances @ flat)).sum((1, 2))
    structure = flat.shape[0] - trace / (prior.scales * prior.spread).square()
    members = _members(rig)
    there = (seen.any(-1).to(squared) @ members > 0).to(squared)  # (N, G)
    poses = there @ torch.where(members.sum(0) > 1, 7.0, 6.0).to(squared)
    freedom = (2 * seen.sum((1, 2)) - structure - poses).clamp_min(0).sum()
    return float(robust.sum()), float(freedom)


def shared_prior(problem: Problem, rig: Rig) -> SharedPrior:
    """Say what is free of the rig, and how strongly it is held where."""
    views = len(rig.groups)
    total = VIEW * views
    precision = torch.zeros(total, total, dtype=torch.float64)
    free = torch.zeros(total, dtype=torch.bool)
    lenses = [camera.intrinsics if camera is not None else None for camera in problem.calibration]
    unknown = torch.tensor([k for k in range(views) if lenses[k] is None], dtype=torch.long)
    for number, (together, alone) in ((0, FOCAL_SDS), (3, RADIAL_SDS)):
        index = VIEW * unknown + number
        covariance = together**2 + alone**2 * torch.eye(len(index), dtype=torch.float64)
        precision[index[:, None], index[None]] = torch.linalg.inv(covariance)
        free[index] = True
    for number in (1, 2):
        index = VIEW * unknown + number
        precision[index, index] = 1 / (CENTRE_SD * problem.side) ** 2
        # Where a moving camera looks and where its principal point is are nearly one.
        free[index] = rig.size < views
    for k, lens in enumerate(lenses):
        if lens is not None and lens.focal_sd > 0:
            precision[VIEW * k, VIEW * k] = 1 / lens.focal_sd**2
            free[VIEW * k] = True
    first: set[int] = set()
    given = _given_poses(problem, rig)
    for k, group in enumerate(rig.groups.tolist()):
        if group in first and not given:
            free[VIEW * k + OPTICS : VIEW * (k + 1)] = True
        first.add(group)
    return SharedPrior(rig._replace(optics=problem.reference.optics), precision, free)


def _given_poses(problem: Problem, rig: Rig) -> bool:
    """Whether the rig's extrinsics are those that the user gave."""
    return any(
        camera is not None
        and camera.rotation is not None
        and torch.equal(rig.rotations[k], torch.tensor(camera.rotation, dtype=torch.float64))
        for k, camera in enumerate(problem.calibration)
    )


def _calibrated(problem: Problem, moving: State, posed: list[int]) -> tuple[State, float]:
    """Put the moving solution into the given poses of cameras `posed`; also their unit."""
    rotations, translations = moving.rig.rotations.clone(), moving.rig.translations.clone()
    for k in posed:
        camera = problem.calibration[k]
        if camera is not None and camera.rotation is not None and camera.translation is not None:
            rotations[k] = torch.tensor(camera.rotation, dtype=torch.float64)
            translations[k] = torch.tensor(camera.translation, dtype=torch.float64)
    rig = moving.rig._replace(
        groups=_grouped(posed, len(rotations)), rotations=rotations, translations=translations
    )
    scene = gather(moving.scene, rig, problem.weights.sum(-1) > 0)
    size = scene.sizes[:, 0].median()
    unit = size.exp()
    sizes, shifts = scene.sizes.clone(), scene.translations.clone()
    sizes[:, 0] -= size
    shifts[:, 0] /= unit
    rig = rig._replace(translations=rig.translations / unit)
    return moving._replace(rig=rig, scene=scene._replace(sizes=sizes, translations=shifts)), float(
        unit
    )


def _grouped(members: list[int], views: int) -> Tensor:
    """Group 0 for the members, one of its own for every other view; (K,)."""
    groups = torch.zeros(views, dtype=torch.long)
    others = [k for k in range(views) if k not in members]
    groups[others] = torch.arange(1, len(others) + 1)
    return groups


def _deviations(problem: Problem, state: State) -> Tensor:
    """Return standard deviations (K, 10) from the information; 0 for what was kept."""
    free = shared_prior(problem, state.rig).free
    deviations = torch.zeros(len(free), dtype=torch.float64)
    inverse = torch.linalg.pinv(state.information, hermitian=True)
    deviations[free] = inverse.diagonal().clamp_min(0).sqrt()
    return deviations.reshape(-1, VIEW)


def _relative(scene: Scene, seen: Tensor, j: int, k: int) -> tuple[Tensor, Tensor, float] | None:
    """Robust mean of what takes view j's frame to view k's, and its scatter in degrees."""
    both = seen[:, j] & seen[:, k]
    if both.sum() < 2:
        return None
    a, b = scene.rotations[both, j], scene.rotations[both, k]
    relative = b @ a.mT  # (n, 3, 3)
    weights = torch.ones(len(relative), dtype=relative.dtype)
    for _ in range(10):  # the median of rotations, by reweighting
        mean = _nearest(torch.einsum("n,nij->ij", weights, relative))
        angles = _angle(relative @ mean.T)
        weights = 1 / angles.clamp_min(1e-4)
    shift = scene.translations[both, k] - scene.translations[both, j] @ mean.T
    return mean, shift.median(0).values, math.degrees(float(angles.median()))


def _nearest(matrix: Tensor) -> Tensor:
    u, _, vt = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vt).sign()[..., None, None]
    nearest: Tensor = torch.cat((u[..., :2], u[..., 2:] * sign), -1) @ vt
    return nearest


def _angle(rotations: Tensor) -> Tensor:
    cosine: Tensor = (rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angles: Tensor = cosine.clamp(-1, 1).acos()
    return angles


def _find_rest(problem: Problem, moving: State, config: FitConfig) -> Steps[tuple[State, str]]:
    """Join views that rest relative to each other, as far as the keypoints bear it."""
    views = len(moving.rig.groups)
    seen = (problem.weights > 0).sum(-1) >= MIN_KEYPOINTS
    declared = config.cameras == "static"
    edges: Edges = {}
    for j in range(views):
        for k in range(j + 1, views):
            found = _relative(moving.scene, seen, j, k)
            if found is not None and (declared or found[2] < LIKELY_REST):
                edges[j, k] = found
    members = _component(edges, views)
    bound = max(REST_NOISE * moving.noise, moving.noise + REST_SLACK * problem.side)
    reason = f"no two views turn together within {LIKELY_REST:g} degrees"
    while len(members) > 1:
        state = yield from _learn(problem, _at_rest(moving, edges, members, seen))
        figures = (
            f"noise {state.measured:.3g} px if views {members} rest,"
            f" {moving.measured:.3g} px if all move"
        )
        if declared:
            return state, f"the cameras were declared static; {figures}"
        if state.noise <= bound:
            turns = max(found[2] for pair, found in edges.items() if set(pair) <= set(members))
            return state, f"{figures}; relative rotations scatter by {turns:.2g} degrees at most"
        reason = f"{figures}: too much for cameras at rest"
        worst = _worst(problem, moving, state, members)
        edges = {pair: found for pair, found in edges.items() if worst not in pair}
        members = _component(edges, views)
    return moving, reason


def _worst(problem: Problem, moving: State, state: State, members: list[int]) -> int:
    """Return the member whose median residual grows most from the one to the other."""
    seen = problem.weights > 0
    medians = []
    for rig, scene in ((moving.rig, moving.scene), (state.rig, state.scene)):
        camera = place(scene, rig)
        distances = (image(camera, rig.optics) - problem.keypoints).norm(dim=-1)
        medians.append(torch.stack([distances[:, k][seen[:, k]].median() for k in members]))
    ratios = medians[1] / (medians[0] + REST_SLACK * problem.side)
    return members[int(ratios.argmax())]


def _component(edges: Edges, views: int) -> list[int]:
    """Return the largest set of views that edges connect."""
    label = list(range(views))
    for j, k in edges:
        old, new = label[k], label[j]
        label = [new if x == old else x for x in label]
    largest = max(set(label), key=label.count)
    return [k for k in range(views) if label[k] == largest]


def _at_rest(
    moving: State,
    edges: Edges,
    members: list[int],
    seen: Tensor,
) -> State:
    """Join `members` of the moving solution to one group; the others stay on their own."""
    rig, scene = moving.rig, moving.scene
    rotations, translations = rig.rotations.clone(), rig.translations.clone()
    root = members[0]
    placed = {root}
    while len(placed) < len(members):  # along the surest edges
        options = [
            (found[2], pair, found)
            for pair, found in edges.items()
            if (pair[0] in placed) != (pair[1] in placed)
        ]
        _, (j, k), (turned, shift, _) = min(options, key=lambda o: o[0])
        if j in placed:
            rotations[k] = turned @ rotations[j]
            translations[k] = turned @ translations[j] + shift
            placed.add(k)
        else:
            rotations[j] = turned.T @ rotations[k]
            translations[j] = turned.T @ (translations[k] - shift)
            placed.add(j)
    groups = _grouped(members, len(rig.groups))
    rig = rig._replace(groups=groups, rotations=rotations, translations=translations)
    return moving._replace(rig=rig, scene=gather(scene, rig, seen))
