"""Lifting with perspective, through `fit` and `lift` alone."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.capture.metrics import pa_mpjpe
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import CAMERA_MODELS, LiftedFrames
from models.settings.config import FitConfig
from models.training.trainer import Trainer, fit
from tests.models.lifting.comparison import same
from tests.models.rigs import FOCAL, IMAGE_SIZE, Lens, RigCapture, keypoint, make_rig_capture
from tests.sharing import fitted_once
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]
QUICK: dict[str, Any] = {"steps": 30, "dictionary_sizes": (16, 8), "batch_size": 8}
AZIMUTHS = [0.0, 80.0, -120.0]
PERSPECTIVE = CAMERA_MODELS.index("perspective")
OF_VIEWS = (
    *("rotations", "scales", "translations", "focals", "principal_points", "distortions"),
    *("camera_models", "reprojection_errors", "outlier_probability", "keypoints_used"),
)
SHIN = (keypoint("left_knee"), keypoint("left_ankle"))


def filmed(azimuths: list[float], frames: slice) -> RigCapture:
    """Film one and the same figure with lenses that bend a little."""
    lens = Lens(distortion=(-0.12, 0.03))
    return make_rig_capture(azimuths, frames=80, lenses=(lens,), distance=3).part(frames)


SEEN, UNSEEN = slice(0, 60), slice(60, 80)


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    return filmed(AZIMUTHS, SEEN)


@pytest.fixture(scope="module")
def prior(capture: RigCapture) -> FittedPrior:
    sizes = [IMAGE_SIZE] * 3
    return fitted_once(
        "lifting", lambda: fit(capture.keypoints, FitConfig(steps=80), image_sizes=sizes)
    )


def some(lift: LiftedFrames, frames: Any, views: Any = slice(None)) -> LiftedFrames:
    """Return some of the frames, and of their views."""
    chosen = LiftedFrames._make(value[frames] for value in lift)
    parts = {n: getattr(chosen, n)[:, views] for n in OF_VIEWS}
    return chosen._replace(**parts)


def test_perspective_cameras_project_the_structure_to_the_reported_error(
    capture: RigCapture, prior: FittedPrior
) -> None:
    lift = prior.lift(capture.keypoints)
    assert (lift.camera_models == PERSPECTIVE).mean() > 0.9
    checked = 0
    for n, k in zip(*np.nonzero(lift.camera_models == PERSPECTIVE), strict=True):
        lens = Lens(
            focal=float(lift.focals[n, k, 0]),
            centre=(float(lift.principal_points[n, k, 0]), float(lift.principal_points[n, k, 1])),
            distortion=tuple(lift.distortions[n, k, :2].tolist()),
        )
        assert (lift.distortions[n, k, 2:] == 0).all()
        assert lift.focals[n, k, 0] == lift.focals[n, k, 1]
        camera = lift.points3d[n].astype(np.float64) @ lift.rotations[n, k].T
        camera += lift.translations[n, k]
        distances = np.linalg.norm(lens.project(camera) - capture.keypoints[n, k], axis=-1)
        assert np.nanmean(distances) == pytest.approx(lift.reprojection_errors[n, k], abs=0.01)
        assert lift.scales[n, k] == pytest.approx(lens.focal / lift.translations[n, k, 2], rel=1e-5)
        checked += 1
    assert checked > 150
    assert np.abs(lift.distortions[..., 0]).max() > 0.02  # lenses that bend were put to the test
    np.testing.assert_allclose(lift.points3d.mean(1), 0, atol=1e-5)
    turned = lift.rotations @ lift.rotations.mT
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-5)


def test_refinement_is_worth_it(capture: RigCapture, prior: FittedPrior) -> None:
    def error(refine: Any) -> float:
        lift = prior.lift(capture.keypoints, refine=refine)
        return pa_mpjpe(lift.points3d, capture.points3d, reflection="never").mean

    assert error("auto") < 0.5 * error("off")
    assert error("auto") < 0.02
    assert error("full") < 0.02
    plain = fit(capture.keypoints, FitConfig(steps=200, refine="off")).lift(capture.keypoints)
    assert error("auto") < pa_mpjpe(plain.points3d, capture.points3d, reflection="never").mean


def test_refinement_can_be_left_out(capture: RigCapture, prior: FittedPrior) -> None:
    lift = prior.lift(capture.keypoints[:8], refine="off")
    assert (lift.camera_models == 0).all()
    assert np.isnan(lift.focals).all()
    assert np.isnan(lift.translations[..., 2]).all()
    assert np.isfinite(lift.translations[..., :2]).all()
    # The settings of a fit are the defaults of its lifts.
    same(prior.lift(capture.keypoints[:8]), prior.lift(capture.keypoints[:8], refine="auto"))
    never = fit(capture.keypoints[:8], FitConfig(**QUICK, refine="off"))
    assert never.cameras is None
    assert np.isnan(never.noise)
    for refine in ("auto", "full"):
        refined = never.lift(capture.keypoints[:8], refine=refine)
        same(refined, never.lift(capture.keypoints[:8], refine="off"))


def test_what_is_saved_and_loaded_lifts_alike(capture: RigCapture, prior: FittedPrior) -> None:
    copy = FittedPrior.from_bytes(prior.to_bytes())
    assert copy.to_bytes() == prior.to_bytes()
    frames = capture.keypoints[:10]
    for more in ({}, {"refine": "full"}, {"refine": "off"}, {"views": [1, 2, 0]}):
        same(copy.lift(frames, **more), prior.lift(frames, **more))
    same(copy.lift(frames[:, 1:], views=[1, 2]), prior.lift(frames[:, 1:], views=[1, 2]))
    assert prior.cameras is not None
    assert copy.cameras is not None
    for field in dataclasses.fields(prior.cameras):
        ours, theirs = getattr(prior.cameras, field.name), getattr(copy.cameras, field.name)
        np.testing.assert_array_equal(ours, theirs)
    assert copy.noise == prior.noise


def test_frames_lifted_together_and_one_by_one_are_alike(
    capture: RigCapture, prior: FittedPrior
) -> None:
    frames = capture.keypoints[:12].copy()
    frames[3, 1] = np.nan
    frames[5, 1:] = np.nan
    frames[7] = np.nan
    together = prior.lift(frames, refine="full")
    for n in np.flatnonzero(np.arange(12) != 7):
        alone = prior.lift(frames[n : n + 1], refine="full")
        same(alone, some(together, [n]), tolerance=1e-3)
    nothing = prior.lift(frames[7:8], refine="full")
    same(nothing, some(together, [7]))
    order = np.random.default_rng(0).permutation(12)
    same(prior.lift(frames[order], refine="full"), some(together, order), tolerance=1e-3)


def test_views_may_come_in_any_order_if_they_are_named(
    capture: RigCapture, prior: FittedPrior
) -> None:
    frames = capture.keypoints[:10]
    plain = prior.lift(frames)
    turned = prior.lift(frames[:, [2, 0, 1]], views=[2, 0, 1])
    same(turned, some(plain, slice(None), [2, 0, 1]), tolerance=1e-2)
    # Two of the views, by their names: lenses and relative poses are known.
    pair = prior.lift(frames[:, [2, 0]], views=[2, 0])
    assert pa_mpjpe(pair.points3d, capture.points3d[:10], reflection="never").mean < 0.04
    np.testing.assert_array_equal(pair.focals[:, 1], plain.focals[:, 0])
    truth = capture.rotations[0, 2] @ capture.rotations[0, 0].T
    for rotations in pair.rotations:
        off = Rotation.from_matrix(rotations[0] @ rotations[1].T @ truth.T).magnitude()
        assert np.degrees(off) < 2
    # One alone keeps its lens.
    single = prior.lift(frames[:, 1:2], views=[1])
    assert np.isfinite(single.points3d).all()
    refined = single.camera_models[:, 0] == PERSPECTIVE
    np.testing.assert_array_equal(single.focals[refined, 0], plain.focals[refined, 1])


@pytest.mark.parametrize("views", [[0], [0, 1, 2], [1, 1], [0, 3], [-1, 0]])
def test_views_must_be_different_ones_of_the_fit(
    capture: RigCapture, prior: FittedPrior, views: list[int]
) -> None:
    with pytest.raises(ValueError, match="2 different views of the 3 of the fit"):
        prior.lift(capture.keypoints[:2, :2], views=views)


def test_cameras_that_the_fit_does_not_know_are_lifted_too(prior: FittedPrior) -> None:
    other = filmed([-40, 30, 150, 100], UNSEEN)
    lift = prior.lift(other.keypoints)
    assert set(lift.status) == {"ok"}
    assert np.isfinite(lift.points3d).all()
    weak = prior.lift(other.keypoints, refine="off")
    error = pa_mpjpe(lift.points3d, other.points3d, reflection="never").mean
    assert error < pa_mpjpe(weak.points3d, other.points3d, reflection="never").mean
    assert error < 0.05


def test_a_camera_that_was_moved_since_does_no_harm(prior: FittedPrior) -> None:
    later = filmed([0, 80, -90], UNSEEN)
    lift = prior.lift(later.keypoints)
    assert np.median(lift.reprojection_errors) < 2
    assert pa_mpjpe(lift.points3d, later.points3d, reflection="never").mean < 0.04


def test_a_lift_may_start_from_the_one_before(capture: RigCapture, prior: FittedPrior) -> None:
    first = prior.lift(capture.keypoints)
    assert not first.continued.any()
    again = prior.lift(capture.keypoints, previous=first)
    assert again.continued.mean() > 0.9
    assert (again.continued <= (again.camera_models == PERSPECTIVE).all(1)).all()
    error, before = (
        pa_mpjpe(x.points3d, capture.points3d, reflection="never").mean for x in (again, first)
    )
    assert error == pytest.approx(before, rel=0.02)
    assert again.reprojection_errors.mean() <= 1.001 * first.reprojection_errors.mean()


def test_what_was_before_may_be_anything(capture: RigCapture, prior: FittedPrior) -> None:
    plain = prior.lift(capture.keypoints)
    blind = prior.lift(np.full_like(capture.keypoints, np.nan))
    same(prior.lift(capture.keypoints, previous=blind), plain)
    weak = prior.lift(capture.keypoints, refine="off")
    same(prior.lift(capture.keypoints, previous=weak), plain)
    # Somebody else, elsewhere, upside down: the network's answer is the better start.
    other = plain._replace(rotations=plain.rotations @ np.diag([1, -1, -1]).astype(np.float32))
    same(prior.lift(capture.keypoints, previous=other), plain)


def test_what_was_before_must_be_of_the_same_frames_and_views(
    capture: RigCapture, prior: FittedPrior
) -> None:
    plain = prior.lift(capture.keypoints)
    for wrong in (some(plain, slice(1, None)), some(plain, slice(None), [0, 1])):
        with pytest.raises(ValueError, match="previous must have the shape"):
            prior.lift(capture.keypoints, previous=wrong)


def test_several_threads_lift_as_one(capture: RigCapture, prior: FittedPrior) -> None:
    keypoints = np.tile(capture.keypoints, (5, 1, 1, 1))  # more than a slice
    alone = prior.lift(keypoints)
    torch.set_num_threads(2)
    try:
        same(prior.lift(keypoints), alone)
        same(prior.lift(keypoints, refine="off"), prior.lift(keypoints, refine="off"))
    finally:
        torch.set_num_threads(1)


def test_results_have_the_users_unit_and_the_users_rig() -> None:
    capture = filmed(AZIMUTHS, slice(0, 20))
    shin = float(np.linalg.norm(capture.points3d[0, SHIN[0]] - capture.points3d[0, SHIN[1]]))
    lens = {"fx": FOCAL, "fy": FOCAL, "cx": 640, "cy": 512, "distortion": [-0.12, 0.03]}
    rig = [
        {
            "intrinsics": lens,
            "rotation": capture.rotations[0, k].tolist(),
            "translation": (100 * capture.translations[0, k]).tolist(),
        }
        for k in range(3)
    ]
    for given in (
        {"known_length": {"keypoints": SHIN, "length": 100 * shin}},
        {"calibration": rig},
    ):
        prior = fit(capture.keypoints, FitConfig.model_validate(QUICK | given))
        lift = prior.lift(capture.keypoints, refine="full")
        lengths = np.linalg.norm(lift.points3d[:, SHIN[0]] - lift.points3d[:, SHIN[1]], axis=-1)
        assert np.median(lengths) == pytest.approx(100 * shin, rel=0.03)
    # The calibration was last: cameras have the given poses.
    assert prior.cameras is not None
    np.testing.assert_allclose(prior.cameras.rotations, capture.rotations[0], atol=1e-6)
    world = prior.cameras.rotations.mT @ (lift.translations - prior.cameras.translations)[..., None]
    truth = 100 * capture.points3d.mean(1)
    for k in range(3):  # all three say where the subject is
        assert np.median(np.linalg.norm(world[:, k, :, 0] - truth, axis=-1)) < 8


@pytest.fixture(scope="module", params=["by geometry", "with the network"])
def interrupted(
    request: pytest.FixtureRequest,
) -> tuple[Float64, FitConfig, dict[str, bytes], bytes]:
    """Fit a small capture; return it with what was asked, checkpoints, and the weights at the end.

    Geometry finds static cameras before the first step, moving ones are sought with the network's
    help.
    """
    by_geometry = request.param == "by geometry"
    moving = () if by_geometry else (0, 1, 2)
    config = FitConfig.model_validate(QUICK | {"cameras": "auto" if by_geometry else "moving"})
    keypoints = make_rig_capture(AZIMUTHS, frames=15, noise=2, moving=moving).keypoints
    trainer = Trainer(keypoints, config)
    checkpoints: dict[str, bytes] = {}
    sought = 0
    for progress in trainer.run():
        if progress.stage == "refining" and progress.step == (0 if by_geometry else 10):
            sought += 1
            when = f"sought {sought}"
        elif progress.stage == "refining":
            when = "taught anew"
        else:
            when = f"step {progress.step}"
        if when not in checkpoints:
            checkpoints[when] = trainer.checkpoint()
    checkpoints["last step"] = checkpoints[f"step {trainer.step - 1}"]
    assert trainer.result().cameras is not None
    return keypoints, config, checkpoints, trainer.result().to_bytes()


@pytest.mark.parametrize(
    "when",
    thorough_after(
        2, ["sought 4", "taught anew", "step 9", "sought 1", "sought 12", "step 2", "last step"]
    ),
)
def test_a_fit_stopped_while_it_seeks_the_cameras_resumes_bit_for_bit(
    interrupted: tuple[Float64, FitConfig, dict[str, bytes], bytes], when: str
) -> None:
    keypoints, config, checkpoints, expected = interrupted
    rest = Trainer(keypoints, config, checkpoint=checkpoints[when])
    for _ in rest.run():
        pass
    assert rest.result().to_bytes() == expected
