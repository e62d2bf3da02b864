"""The program's compiled code against the plain one of `reference.py`, on small cases."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from models.bundle.problem import LENS, VIEW, Scene, Views, make_rig, make_shape_prior
from models.bundle.separate_frames import adjust_frames
from models.capture.observations import as_observations
from models.epipolar.pairs import Beliefs
from models.epipolar.static_rig import find_static_rig
from models.network.answers import make_answers, nothing_unusual
from models.network.feed_forward import feed_forward
from models.network.losses import Batch, objective
from models.network.priors.hierarchical import HierarchicalPrior
from models.network.settling import SETTLE_NONE
from models.numerics.steps import finished
from models.optics.lenses.projection import Lenses
from models.posterior.frames import Frames, LearntShapes, covariances_of
from tests.models import reference
from tests.models.epipolar.exact_rigs import FOCALS, exact_points, exact_rig, images_of
from tests.models.reference import Dictionaries, Frame
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]

SIZES = [(9,), (16, 8), (24, 12, 5)]


def drawn(sizes: tuple[int, ...], keypoints: int) -> HierarchicalPrior:
    """Draw a network whose thresholds matter."""
    network = HierarchicalPrior(keypoints, sizes).double()
    network.initialise(0)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim == 1:
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    return network


def plain(network: HierarchicalPrior) -> Dictionaries:
    """Return the weights as the reference names them."""
    return Dictionaries(
        network.first.reshape(network.keypoints, 3, -1),
        list(network.dictionaries),
        list(network.encoder_thresholds),
        list(network.decoder_thresholds),
        (network.unrotate.weight, network.unrotate.bias),
        (network.rotate.weight, network.rotate.bias),
    )


def views_of(frames: int, keypoints: int, *, gaps: bool) -> NDArray[np.float32]:
    """Draw keypoints (N, 3, P, 2) in pixels."""
    rng = np.random.default_rng(3)
    pixels = rng.normal(500, 80, (frames, 3, keypoints, 2)).astype(np.float32)
    if gaps:
        pixels[rng.random(pixels.shape[:3]) < 0.2] = np.nan
        pixels[0, 1] = np.nan
    return pixels


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("gaps", [False, True])
def test_the_network_reads_frames_as_the_paper_does(sizes: tuple[int, ...], *, gaps: bool) -> None:
    network, pixels = drawn(sizes, 7), views_of(4, 7, gaps=gaps)
    confidence = np.random.default_rng(4).uniform(0.3, 1, pixels.shape[:3]) if gaps else None
    seen = as_observations(pixels, confidence)
    answers = make_answers(*seen.weights.shape)
    arrays = {name: part.detach().float() for name, part in network.named_parameters()}
    laid_out = network.lay_out(arrays, sizes)
    feed_forward(laid_out, seen, 0.0, SETTLE_NONE, nothing_unusual(), 0, 4, answers)
    for n in range(4):
        keypoints, weights = (torch.from_numpy(part[n]).double() for part in seen[:2])
        points, cameras = reference.reconstruct(plain(network), keypoints, weights)
        np.testing.assert_allclose(answers.points3d[n], points.detach(), atol=2e-4)
        for k, camera in enumerate(cameras):
            assert (camera is None) == bool(np.isnan(answers.rotations[n, k]).all())
            if camera is None:
                continue
            size, centre = seen.sizes[n, k], seen.centres[n, k]
            scale, shift = (part.detach().numpy() * size for part in camera[1:])
            np.testing.assert_allclose(answers.rotations[n, k], camera.rotation.detach(), atol=2e-3)
            np.testing.assert_allclose(answers.scales[n, k], scale, rtol=2e-3)
            np.testing.assert_allclose(answers.translations[n, k, :2], shift + centre, atol=0.1)


@pytest.mark.parametrize("gaps", [False, True])
def test_a_step_of_training_follows_the_slope_of_the_papers_loss(*, gaps: bool) -> None:
    network, frames = drawn((16, 8), 7), 3
    seen = as_observations(views_of(frames, 7, gaps=gaps), None)
    keypoints, weights = (torch.from_numpy(part).double() for part in seen[:2])
    points, projected, _ = network.reproject(keypoints, weights)
    none = torch.zeros(frames).double()
    batch = Batch(keypoints, weights, weights.sum(-1), none + 1, torch.zeros_like(points), none)
    total, figures = objective(points, projected, batch)
    slopes = torch.autograd.grad(total, list(network.parameters()))

    views = (weights.sum(-1) > 0).sum(-1)
    expected = torch.zeros(()).double()
    for n in range(frames):
        found = reference.reconstruct(plain(network), keypoints[n], weights[n])
        expected = expected + views[n] * reference.loss(*found, keypoints[n], weights[n])
    expected = expected / views.sum()
    assert float(figures[0]) == pytest.approx(float(expected.detach()), rel=1e-6)
    for slope, plainly in zip(
        slopes, torch.autograd.grad(expected, list(network.parameters())), strict=True
    ):
        np.testing.assert_allclose(slope, plainly, rtol=1e-4, atol=1e-6)


def degrees(first: Float64, second: Float64) -> float:
    """Return the largest angle between rotations (K, 3, 3)."""
    return float(np.degrees(Rotation.from_matrix(first @ second.mT).magnitude()).max())


@pytest.mark.parametrize("noise", thorough_after(1, [5e-4, 0.0]))
def test_static_cameras_are_those_of_plain_bundle_adjustment(noise: float) -> None:
    truth, count = exact_rig(3), 60
    seen = images_of(truth, exact_points(count), noise)
    wanted, _ = reference.static_cameras(torch.from_numpy(seen.images).mT.contiguous(), 1.1)
    if noise == 0:
        np.testing.assert_allclose(wanted.focals, FOCALS[:3], rtol=1e-5)
        assert degrees(wanted.rotations.numpy(), truth.rotations) < 1e-3
    # No lens but the focal length is open here, as in the reference.
    held = 1e-5**2 * np.eye(3)
    believed = Beliefs(np.full(3, 1.1), np.eye(3), held, np.stack((held, held)), alike=False)
    images = seen.images.mT.reshape(3, 10, 6, 2).transpose(1, 0, 2, 3)  # ten frames of six
    sizes = np.sqrt(np.square(seen.images - seen.images.mean(2, keepdims=True)).sum(1).mean(1))
    geometry = finished(find_static_rig(images, np.ones(images.shape[:3]), believed, sizes))
    assert geometry.rig is not None
    rig = geometry.rig.best.rig
    turns = rig.rotations @ rig.rotations[0].T
    shifts = rig.translations - turns @ rig.translations[0]
    np.testing.assert_allclose(np.exp(rig.log_focals), wanted.focals, rtol=1e-3 + 20 * noise)
    assert degrees(turns, wanted.rotations.numpy()) < 0.05 + 300 * noise
    np.testing.assert_allclose(
        shifts / np.linalg.norm(shifts[1]), wanted.translations, atol=2e-3 + 20 * noise
    )


POINTS, COMPONENTS, NOISE = 5, 2, 2.0


def a_frame(static: list[bool], *, noise: float = 0.0, seed: int = 0) -> Frame:
    """Draw a frame of which one view hides a keypoint; without noise the answer is exact."""
    rng, views = np.random.default_rng(seed), len(static)
    mean = rng.standard_normal((POINTS, 3))
    mean -= mean.mean(0)
    basis = 0.3 * rng.standard_normal((POINTS, 3, COMPONENTS))
    spread = np.sqrt(rng.uniform(0.01, 0.05, POINTS))
    turn = Rotation.from_rotvec(rng.standard_normal(3)).as_matrix()
    matrix, middle = 1.3 * turn, np.array([0.1, -0.2, 0.3])
    axes = [[0.0, 1.2 * k, 0.1 * k] for k in range(views)]
    weights = rng.uniform(0.5, 1, (views, POINTS)) / NOISE**2
    weights[0, 2] = 0
    parts = (
        np.zeros((views, POINTS, 2)),
        weights,
        np.full((views, 2), 900.0),
        np.full((views, 2), [500.0, 400.0]),
        0.05 * rng.standard_normal((views, 2)),
        Rotation.from_rotvec(axes).as_matrix(),
        np.tile([0.1, -0.2, 9.0], (views, 1)),
        np.array(static),
        mean,
        basis,
        spread,
        mean @ matrix.T + middle,
    )
    similarity = torch.from_numpy(matrix), torch.from_numpy(middle)
    frame = Frame(similarity, *(torch.from_numpy(part) for part in parts))
    pixels = reference.pixels_of(frame, frame.points, torch.zeros(views, VIEW).double())
    return frame._replace(
        keypoints=pixels + noise * torch.from_numpy(rng.uniform(-1, 1, pixels.shape))
    )


def lenses_of(frame: Frame) -> Lenses:
    """Return the lenses as the program has them."""
    views = len(frame.radial)
    distortion = np.concatenate((frame.radial.numpy(), np.zeros((views, 6))), 1)
    return Lenses(frame.focals.numpy(), frame.centres.numpy(), distortion, np.zeros(views, np.int8))


def as_answer(frame: Frame, growth: float, rotation: Float64, middle: Float64) -> Frames:
    """Return the frame with points Y where X = rotation Y / growth + middle."""
    turns, shifts = frame.rotations.numpy(), frame.translations.numpy()
    points = growth * (frame.points.numpy() - middle) @ rotation
    return Frames(
        points[None],
        np.ascontiguousarray(turns @ rotation)[None],
        (growth * (turns @ middle + shifts))[None],
        lenses_of(frame),
        frame.static.numpy()[None],
        (growth * shifts)[None],
        np.array([growth]),
        frame.keypoints.numpy()[None],
        frame.weights.numpy()[None],
        (growth * rotation.T @ frame.similarity[0].numpy())[None],
        np.zeros(1),
        np.ones((1, POINTS)),
    )


@pytest.mark.parametrize(
    "static",
    [[True, True, True], [True, True], [False, False, False], [True, True, False], [True]],
)
@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_a_frames_covariance_is_the_inverse_of_the_hessian(
    static: list[bool], shared: float
) -> None:
    frame, rng, views = a_frame(static), np.random.default_rng(1), len(static)
    factor = shared * 0.02 * rng.standard_normal((views, VIEW, 4))
    factor[:, 1:3] *= 100
    growth, rotation = 0.7, Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    answer = as_answer(frame, growth, rotation, np.array([0.2, 0.1, -0.4]))
    shapes = LearntShapes(frame.mean.numpy(), frame.basis.numpy(), frame.spread.numpy() ** 2)
    if not any(static):  # then the unit of a camera's pose is the structure's
        factor[:, LENS:] = 0
    found = covariances_of(answer, shapes, factor)
    columns = np.concatenate((found.modes[0], found.by_cameras[0]), -1).reshape(3 * POINTS, -1)
    apart = 1 - block_diag(*np.ones((POINTS, 3, 3)))
    ours = block_diag(*found.blocks[0]) + columns @ columns.T * apart

    turn = block_diag(*[growth * rotation.T] * POINTS)
    expected = turn @ reference.covariance(frame, torch.from_numpy(factor)).numpy() @ turn.T
    sized = 6 if sum(static) > 1 else 7
    kept = reference.without_pose(torch.from_numpy(answer.points[0]), sized).numpy()
    np.testing.assert_allclose(kept @ ours @ kept, expected, rtol=2e-3, atol=1e-8)


def test_a_frames_answer_is_the_maximum_of_its_posterior() -> None:
    frame = a_frame([True, True, True], noise=2.0)
    frame = frame._replace(spread=torch.full((POINTS,), 0.2).double())
    wanted = reference.most_likely(frame)
    matrix, middle = (part.numpy() for part in frame.similarity)
    size = np.cbrt(np.linalg.det(matrix))
    rig = make_rig(
        lenses_of(frame),
        np.zeros(3, np.int64),
        frame.rotations.numpy(),
        frame.translations.numpy(),
    )._replace(size_precision=np.full(1, 1e-12))  # the reference has no prior of sizes
    basis = frame.basis.numpy()
    prior = make_shape_prior(frame.mean.numpy()[None], basis, 0.2)
    start = Scene(
        frame.mean.numpy()[None],
        (matrix / size)[None, None],
        middle[None, None],
        np.full((1, 1), np.log(size)),
    )
    views = Views(frame.keypoints.numpy()[None], frame.weights.numpy()[None])
    scene, _ = adjust_frames(views, rig, prior, start, iterations=200)
    turned = np.exp(scene.sizes[0, 0]) * scene.points[0] @ scene.rotations[0, 0].T
    found = turned + scene.translations[0, 0]
    assert np.abs(found - frame.points.numpy()).max() > 1e-3
    np.testing.assert_allclose(found, wanted, atol=1e-5)
