"""Lifting with perspective: what a fit found out about its cameras, applied to any frames."""

import json
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from models.adjustment import Rig, Scene, ShapePrior, Views, refine
from models.discovery import Answers, Discovery, gather, size_precision, starting_scene
from models.found import FoundCameras
from models.optics import COEFFICIENTS, Optics, image
from models.posterior import OPTICS
from models.refinement import mirrored
from models.shape import Doubts, ShapeModel, align
from models.weights import Arrays, Shapes, WeightsError

ITERATIONS = 12
LOST = 3.0  # noise standard deviations of a frame's mean residual that a rig at rest cannot explain
BETTER = 0.5  # share of its cost that such a frame must do with if its cameras move
BOUND = 10_000_000  # numbers in the normal equations of a slice of frames: 80 MB


Placed = tuple[Tensor, Tensor, Tensor]  # structures, and every view's R and t


class Perspective(NamedTuple):
    """Structures and cameras of N frames of K views, units of the user; NaN without an answer."""

    points: Tensor  # (N, P, 3) centred
    rotations: Tensor  # (N, K, 3, 3)
    translations: Tensor  # (N, K, 3)
    optics: Optics
    errors: Tensor  # (N, K) pixels, mean over what was observed
    fine: Tensor  # (N,) whether there is an answer


def refine_frames(
    found: Discovery,
    keypoints: Tensor,
    weights: Tensor,
    answers: Answers,
    views: Sequence[int] | None,
) -> Perspective:
    """Refine frames from the network's weak-perspective answers, as for `discover`.

    `views` says which of the fit's views these are; None: cameras of which only the lenses are
    known, as the mean of the fit's. All arrays are float64.
    """
    rig = sub_rig(found, views, keypoints.shape[1])
    apart = _apart(rig)
    seen = weights.sum(-1) > 0
    sight = Views(keypoints, weights / found.noise**2)
    hands = [answers, (*mirrored(*answers[:2]), *answers[2:])]

    placed, costs = _attempt(found, sight, hands[0], rig)
    # Frames that the network sees mirrored show, and cameras that were bumped or moved since.
    mean = (_errors(placed, rig.optics, sight) * seen).sum(1) / seen.sum(1).clamp_min(1)
    lost = ((mean > LOST * found.noise) & (seen.sum(1) > 1)).nonzero()[:, 0]
    for cameras in (rig, apart) if rig.size < len(rig.groups) else (rig,):
        for hand in hands:
            if not len(lost) or (cameras is rig and hand is hands[0]):
                continue
            part = Views(*(a[lost] for a in sight))
            other, other_costs = _attempt(
                found, part, (hand[0][lost], hand[1][lost], hand[2][lost], hand[3][lost]), cameras
            )
            better = other_costs < BETTER * costs[lost]
            for mine, theirs in zip(placed, other, strict=True):
                mine[lost[better]] = theirs[better]
            costs[lost[better]] = other_costs[better]
    points, rotations, translations = placed
    errors = _errors(placed, rig.optics, sight)
    centre = points.mean(1, keepdim=True)
    translations = translations + (rotations @ centre.mT[:, None])[..., 0]
    fine = costs.isfinite() & errors.isfinite().all(-1)
    return Perspective(
        found.unit * (points - centre),
        rotations,
        found.unit * translations,
        rig.optics,
        errors,
        fine,
    )


def _attempt(found: Discovery, sight: Views, answers: Answers, rig: Rig) -> tuple[Placed, Tensor]:
    """Refine from the network's answers; also minus twice the log posterior of each frame (N,)."""
    points, rotations, scales, translations = answers
    seen = sight.weights.sum(-1) > 0
    # Into the frame of reference of the shape model.
    aligned, moved = align(points, found.shapes.mean)
    start = starting_scene(
        aligned,
        rotations @ moved.rotations[:, None],
        scales / moved.scales[:, None],
        translations
        + scales[..., None] * (rotations[..., :2, :] @ moved.centres.mT[:, None])[..., 0],
        rig,
    )
    if rig.size < len(rig.groups):
        start = gather(start, rig, seen)
    scene, costs = _refine(sight, rig, _shape_prior(found, aligned, seen), start)
    return _cameras(scene, rig), costs


def _shape_prior(found: Discovery, points: Tensor, seen: Tensor) -> ShapePrior:
    """Say what is believed of the structures of frames where the network answered `points`."""
    doubts = found.doubts
    if not len(doubts.scales):
        mean, ones = found.shapes.mean.expand_as(points), points.new_ones(len(points))
        return ShapePrior(mean, found.shapes.basis, found.shapes.spread, ones)
    scales = doubts.scales[seen.sum(1).clamp(1, len(doubts.scales)) - 1]
    return ShapePrior(points, doubts.basis, doubts.spread, scales, heavy=True)


def _refine(views: Views, rig: Rig, prior: ShapePrior, scene: Scene) -> tuple[Scene, Tensor]:
    """Refine in slices, whose normal equations take bounded memory."""
    frames, count, _ = scene.points.shape
    size = max(1, BOUND // (3 * count * (7 * rig.size + prior.basis.shape[-1]) * 2))
    precision = size_precision(rig)
    parts = [
        refine(
            Views(*(a[start : start + size] for a in views)),
            rig,
            prior.of(slice(start, start + size)),
            Scene(*(a[start : start + size] for a in scene)),
            size_precision=precision,
            iterations=ITERATIONS,
        )
        for start in range(0, max(frames, 1), size)
    ]
    scenes = zip(*(scene for scene, _ in parts), strict=True)
    return Scene(*(torch.cat(a) for a in scenes)), torch.cat([costs for _, costs in parts])


def _cameras(scene: Scene, rig: Rig) -> Placed:
    """Structures (N, P, 3) of their size, and R (N, K, 3, 3) and t (N, K, 3) of every view."""
    size = scene.sizes[:, 0].exp()  # views that move on their own have size 1, their distance tells
    relative = (scene.sizes.exp() / size[:, None])[:, rig.groups]  # (N, K)
    rotations = rig.rotations @ scene.rotations[:, rig.groups]
    shifts = (rig.rotations @ scene.translations[:, rig.groups, :, None])[..., 0] + rig.translations
    return scene.points * size[:, None, None], rotations, shifts / relative[..., None]


def _errors(placed: Placed, optics: Optics, sight: Views) -> Tensor:
    points, rotations, translations = placed
    camera = points[:, None] @ rotations.mT + translations[:, :, None]
    there = sight.weights > 0
    distances = (image(camera, optics) - sight.keypoints).norm(dim=-1) * there
    mean: Tensor = distances.sum(-1) / there.sum(-1).clamp_min(1)
    return mean


def _apart(rig: Rig) -> Rig:
    """Let every view of a rig move on its own."""
    return rig._replace(
        groups=torch.arange(len(rig.groups)),
        rotations=torch.eye(3, dtype=torch.float64).expand_as(rig.rotations),
        translations=torch.zeros_like(rig.translations),
    )


def sub_rig(found: Discovery, views: Sequence[int] | None, count: int) -> Rig:
    """Return the rig of some views of a fit, or of `count` cameras that it does not know."""
    rig, optics = found.rig, found.rig.optics
    if views is None:
        usual = Optics(
            optics.focals.log().mean(0, keepdim=True).exp().expand(count, -1),
            optics.centres.mean(0, keepdim=True).expand(count, -1),
            optics.distortion.mean(0, keepdim=True).expand(count, -1),
            optics.fisheye[:1].expand(count),
        )
        eye = torch.eye(3, dtype=torch.float64).expand(count, -1, -1)
        still = torch.zeros(count, 3, dtype=torch.float64)
        return Rig(usual, torch.arange(count), eye, still)
    index = torch.tensor(list(views), dtype=torch.long)
    _, groups = torch.unique(rig.groups[index], return_inverse=True)
    alone = (torch.bincount(groups)[groups] == 1)[:, None]  # such a view is its own group's frame
    return Rig(
        Optics(*(a[index] for a in optics)),
        groups,
        torch.where(alone[..., None], torch.eye(3, dtype=torch.float64), rig.rotations[index]),
        torch.where(alone, 0.0, rig.translations[index]),
    )


def report(found: Discovery) -> FoundCameras:
    """Return what was found in the words and units of the user."""
    rig, deviations = found.rig, found.deviations
    resting = found.resting
    focals = rig.optics.focals
    nothing = torch.nan
    at_rest = resting[:, None]
    pose = deviations[:, OPTICS:]
    arrangement = "static" if bool(resting.all()) else "mixed" if bool(resting.any()) else "moving"
    return FoundCameras(
        arrangement=arrangement,
        reason=found.reason,
        warnings=found.warnings,
        fisheye=rig.optics.fisheye.numpy().copy(),
        focals=focals.numpy().copy(),
        focal_sds=(deviations[:, 0] * focals.mean(-1)).numpy(),
        principal_points=rig.optics.centres.numpy().copy(),
        principal_point_sds=deviations[:, 1:3].numpy().copy(),
        distortions=rig.optics.distortion.numpy().copy(),
        distortion_sds=deviations[:, 3].numpy().copy(),
        resting=resting.numpy(),
        rotations=torch.where(at_rest[..., None], rig.rotations, nothing).numpy(),
        rotation_sds=torch.where(
            resting, torch.rad2deg(pose[:, :3].square().sum(-1).sqrt()), nothing
        ).numpy(),
        translations=torch.where(at_rest, found.unit * rig.translations, nothing).numpy(),
        translation_sds=torch.where(at_rest, found.unit * pose[:, 3:], nothing).numpy(),
        reprojection_errors=found.errors.numpy().copy(),
        noise=found.noise,
    )


def to_arrays(found: Discovery) -> tuple[Arrays, str]:
    """Return a discovery as tensors and a line of text, for a file."""
    optics = found.rig.optics
    arrays = {
        "focals": optics.focals,
        "centres": optics.centres,
        "distortion": optics.distortion,
        "fisheye": optics.fisheye.to(torch.float64),
        "groups": found.rig.groups.to(torch.float64),
        "extrinsic_rotations": found.rig.rotations,
        "extrinsic_translations": found.rig.translations,
        "deviations": found.deviations,
        "errors": found.errors,
        "shape_mean": found.shapes.mean,
        "shape_basis": found.shapes.basis,
        "doubt_basis": found.doubts.basis,
        "doubt_scales": found.doubts.scales,
        "numbers": torch.tensor(
            [found.shapes.spread, found.doubts.spread, found.trusted, found.noise, found.unit],
            dtype=torch.float64,
        ),
    }
    words = json.dumps({"reason": found.reason, "warnings": found.warnings})
    return {name: value.contiguous() for name, value in arrays.items()}, words


def array_shapes(keypoints: int, views: int | None) -> Shapes:
    """Shapes of what `to_arrays` returns; None stands for any length."""
    return {
        "focals": (views, 2),
        "centres": (views, 2),
        "distortion": (views, COEFFICIENTS),
        "fisheye": (views,),
        "groups": (views,),
        "extrinsic_rotations": (views, 3, 3),
        "extrinsic_translations": (views, 3),
        "deviations": (views, 10),
        "errors": (views,),
        "shape_mean": (keypoints, 3),
        "shape_basis": (keypoints, 3, None),
        "doubt_basis": (keypoints, 3, None),
        "doubt_scales": (None,),
        "numbers": (5,),
    }


def from_arrays(arrays: Arrays, words: str) -> Discovery:
    """Read what `to_arrays` returned.

    Raises
    ------
    WeightsError
        When the tensors contradict each other or the text is not what was written.
    """
    try:
        said = json.loads(words)
        reason, warnings = str(said["reason"]), tuple(str(w) for w in said["warnings"])
    except (ValueError, KeyError, TypeError) as error:
        raise WeightsError("the file does not say what was found of the cameras") from error
    a = {name: value.to(torch.float64) for name, value in arrays.items()}
    groups = a["groups"].long()
    views = len(groups)
    spread, doubt, trusted, noise, unit = a["numbers"].tolist()
    consistent = (
        views > 0
        and all(
            len(a[name]) == views
            for name in array_shapes(0, 0)
            if not name.startswith(("shape", "doubt", "numbers"))
        )
        and torch.equal(torch.unique(groups), torch.arange(int(groups.max()) + 1))
        and bool((a["focals"] > 0).all())
        and bool((a["doubt_scales"] > 0).all())
        and min(spread, doubt, noise, unit) > 0
        and trusted >= 0
        and math.isfinite(spread + doubt + trusted + noise + unit)
    )
    if not consistent:
        raise WeightsError("the file contradicts itself about the cameras")
    optics = Optics(a["focals"], a["centres"], a["distortion"], a["fisheye"] > 0.5)
    return Discovery(
        Rig(optics, groups, a["extrinsic_rotations"], a["extrinsic_translations"]),
        a["deviations"],
        ShapeModel(a["shape_mean"], a["shape_basis"], spread),
        Doubts(a["doubt_basis"], doubt, a["doubt_scales"]),
        trusted,
        noise,
        unit,
        a["errors"],
        reason,
        warnings,
    )
