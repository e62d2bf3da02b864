"""Fitting and lifting through the public face, on a capture whose truth is known."""

import concurrent.futures
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import load

from models.capture.metrics import pa_mpjpe, pck
from models.capture.synthetic import SyntheticCapture, synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.numerics.tensor_files import WeightsError, pack, read_about
from models.settings.config import FitConfig
from models.training.budget import WARM_UP_STEPS
from models.training.progress import Progress
from models.training.trainer import Trainer, fit
from tests.sharing import fitted_once
from tests.tiers import thorough_after

QUICK = FitConfig(steps=30, dictionary_sizes=(16, 8), batch_size=8)


@pytest.fixture(scope="module")
def capture() -> SyntheticCapture:
    return synthetic_capture(frames=120, views=4, noise=1, hidden_keypoints=0.03, seed=8)


@pytest.fixture(scope="module")
def prior(capture: SyntheticCapture) -> FittedPrior:
    """Fit every second frame; the others are lifted unseen."""
    keypoints, confidence = capture.keypoints[::2], capture.confidence[::2]
    config = FitConfig(steps=150, cameras="moving", dictionary_sizes=(64, 16))
    return fitted_once("refined", lambda: fit(keypoints, config, confidence=confidence))


@pytest.fixture(scope="module")
def weak(capture: SyntheticCapture) -> FittedPrior:
    """Fit as the paper does, with weak perspective alone."""
    keypoints, confidence = capture.keypoints, capture.confidence
    config = FitConfig(steps=400, refine="off", dictionary_sizes=(64, 16))
    return fitted_once("weak", lambda: fit(keypoints, config, confidence=confidence))


@pytest.fixture(scope="module")
def small() -> SyntheticCapture:
    return synthetic_capture(frames=15, views=2, seed=9)


@pytest.fixture(scope="module")
def small_prior(small: SyntheticCapture) -> FittedPrior:
    return fit(small.keypoints, QUICK)


@pytest.mark.parametrize("refined", [False, True])
def test_structures_are_found_with_their_true_handedness(
    capture: SyntheticCapture, prior: FittedPrior, weak: FittedPrior, *, refined: bool
) -> None:
    lift = (prior if refined else weak).lift(capture.keypoints, confidence=capture.confidence)
    accuracy = pa_mpjpe(lift.points3d, capture.points3d, reflection="never")
    # Keypoints lie 470 mm from their mean; a rigid mean figure is off by about 150 mm.
    assert accuracy.mean < 0.05
    assert pck(accuracy, 0.1) > 0.9
    assert set(lift.status) == {"ok"}


def test_rotations_agree_with_the_true_cameras(
    capture: SyntheticCapture, prior: FittedPrior
) -> None:
    lift = prior.lift(capture.keypoints)
    # The turn from one camera to another does not depend on the canonical frame.
    found = lift.rotations[:, 1] @ lift.rotations[:, 0].mT
    truth = capture.rotations[:, 1] @ capture.rotations[:, 0].mT
    cosine = (np.trace(found @ truth.mT, axis1=1, axis2=2) - 1) / 2
    assert np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))) < 8


def test_cameras_project_the_structure_to_the_reported_error(
    capture: SyntheticCapture, weak: FittedPrior
) -> None:
    lift = weak.lift(capture.keypoints[:50])
    np.testing.assert_allclose(
        lift.rotations @ lift.rotations.mT, np.tile(np.eye(3), (50, 4, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(lift.rotations), 1, atol=1e-5)
    camera = np.einsum("nkij,npj->nkpi", lift.rotations, lift.points3d)
    image = lift.scales[..., None, None] * camera[..., :2] + lift.translations[:, :, None, :2]
    distance = np.linalg.norm(image - capture.keypoints[:50], axis=-1)
    np.testing.assert_allclose(np.nanmean(distance, -1), lift.reprojection_errors, rtol=1e-3)
    assert np.median(lift.reprojection_errors) < 10  # of a figure some 300 pixels tall
    assert (lift.scales > 0).all()
    np.testing.assert_array_equal(
        lift.keypoints_used, np.isfinite(capture.keypoints[:50]).all(-1).sum(-1)
    )
    np.testing.assert_allclose(lift.points3d.mean(1), 0, atol=1e-5)
    np.testing.assert_allclose(np.square(lift.points3d).sum(-1).mean(1), 1, rtol=1e-4)
    assert (lift.camera_models == 0).all()
    for lens in (lift.focals, lift.principal_points, lift.distortions, lift.translations[..., 2]):
        assert np.isnan(lens).all()


def test_a_frame_does_not_depend_on_its_neighbours(
    capture: SyntheticCapture, prior: FittedPrior
) -> None:
    frames = capture.keypoints[:40].copy()
    frames[::3, 1] = np.nan  # a mixture of full and partial frames
    frames[5] = np.nan
    together = prior.lift(frames)
    reversed_ = prior.lift(frames[::-1])
    np.testing.assert_allclose(together.points3d, reversed_.points3d[::-1], atol=2e-4)
    for frame in (0, 4, 7, 21):
        alone = prior.lift(frames[frame : frame + 1])
        np.testing.assert_allclose(alone.points3d[0], together.points3d[frame], atol=2e-4)
        np.testing.assert_allclose(alone.rotations[0], together.rotations[frame], atol=2e-4)


def test_views_may_be_missing_reordered_or_more_than_in_the_fit(
    capture: SyntheticCapture, weak: FittedPrior
) -> None:
    frames = capture.keypoints[:20]
    padded = np.concatenate((frames, np.full_like(frames, np.nan)), 1)
    plain, extra = weak.lift(frames), weak.lift(padded)
    np.testing.assert_allclose(plain.points3d, extra.points3d, atol=2e-4)
    assert np.isnan(extra.rotations[:, 4:]).all()
    assert np.isnan(extra.reprojection_errors[:, 4:]).all()
    turned = weak.lift(frames[:, ::-1])
    np.testing.assert_allclose(plain.points3d, turned.points3d, atol=2e-4)
    single = weak.lift(frames[:, :1])
    assert np.isfinite(single.points3d).all()


def test_frames_without_an_answer_are_marked(prior: FittedPrior, capture: SyntheticCapture) -> None:
    frames = capture.keypoints[:3].copy()
    frames[1] = np.nan
    frames[2, :, 3:] = np.nan
    lift = prior.lift(frames)
    assert lift.status == ("ok", "too_few_keypoints", "too_few_keypoints")
    assert lift.reasons[0] == ""
    assert "4 keypoints" in lift.reasons[1]
    for answer in (lift.points3d, lift.rotations, lift.scales, lift.translations):
        assert np.isfinite(answer[0]).all()
        assert np.isnan(answer[1:]).all()
    none = prior.lift(frames[:0])
    assert none.points3d.shape == (0, 16, 3)
    assert none.status == ()


def test_pixels_may_be_moved_and_magnified(weak: FittedPrior, capture: SyntheticCapture) -> None:
    frames = capture.keypoints[:10]
    plain, moved = weak.lift(frames), weak.lift(2 * frames + np.float32(100))
    np.testing.assert_allclose(plain.points3d, moved.points3d, atol=2e-3)
    np.testing.assert_allclose(2 * plain.scales, moved.scales, rtol=2e-3)


def test_lifting_from_threads_gives_the_same(prior: FittedPrior, capture: SyntheticCapture) -> None:
    frames = [capture.keypoints[i : i + 1] for i in range(24)]
    expected = [prior.lift(frame).points3d for frame in frames]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda frame: prior.lift(frame).points3d, frames))
    np.testing.assert_array_equal(np.stack(found), np.stack(expected))


def test_another_number_of_keypoints_is_refused(prior: FittedPrior) -> None:
    with pytest.raises(ValueError, match="fitted to 16 keypoints per view, got 17"):
        prior.lift(np.zeros((1, 1, 17, 2)))


def test_a_prior_survives_its_bytes(small: SyntheticCapture, small_prior: FittedPrior) -> None:
    copy = FittedPrior.from_bytes(small_prior.to_bytes())
    assert copy.config == small_prior.config
    assert copy.curve == small_prior.curve
    lifts = (prior.lift(small.keypoints) for prior in (copy, small_prior))
    for found, expected in zip(*lifts, strict=True):
        np.testing.assert_array_equal(found, expected)


def _spoiled(data: bytes, case: str) -> bytes:  # noqa: PLR0911 - one return per kind of damage
    (length,) = struct.unpack("<Q", data[:8])
    match case:
        case "empty":
            return b""
        case "truncated":
            return data[:-100]
        case "header cut":
            return data[: 8 + length // 2]
        case "huge header":
            return struct.pack("<Q", 2**62) + data[8:]
        case "not finite":
            nothing = struct.pack("<f", np.nan)
            return data[: 8 + length] + nothing * ((len(data) - 8 - int(length)) // 4)
        case "other sizes":
            return data.replace(b"[16,8]", b"[16,4]")
        case "absurd sizes":
            return data.replace(b"[16,8]", b"[1,99]")
        case "checkpoint":
            return Trainer(synthetic_capture(frames=4).keypoints, QUICK).checkpoint()
        case "nested":
            return struct.pack("<Q", 100_000) + b"[" * 100_000
        case _:
            return b"PK\x03\x04" + data


@pytest.mark.parametrize(
    "case",
    [
        "empty",
        "truncated",
        "header cut",
        "huge header",
        "not finite",
        "other sizes",
        "absurd sizes",
        "checkpoint",
        "nested",
        "foreign",
    ],
)
def test_spoiled_bytes_are_refused(small_prior: FittedPrior, case: str) -> None:
    data = small_prior.to_bytes()
    spoiled = _spoiled(data, case)
    assert spoiled != data
    with pytest.raises(WeightsError):
        FittedPrior.from_bytes(spoiled)


def test_a_resumed_fit_ends_bit_for_bit_where_an_uninterrupted_one_does() -> None:
    capture = synthetic_capture(frames=21, views=2, noise=2, hidden_views=0.2, seed=3)
    whole = Trainer(capture.keypoints, QUICK, confidence=capture.confidence)
    for _ in whole.run():
        pass
    data = Trainer(capture.keypoints, QUICK, confidence=capture.confidence).checkpoint()
    for stop in (1, 7, 13, 30):  # 21 frames in batches of 8: inside epochs and across them
        part = Trainer(capture.keypoints, QUICK, confidence=capture.confidence, checkpoint=data)
        for progress in part.run():
            if progress.step == stop:
                break
        data = part.checkpoint()
    first, second = whole.result(), part.result()
    assert first.to_bytes() == second.to_bytes()


@pytest.mark.thorough
def test_a_fit_resumes_bit_for_bit_while_its_cameras_are_found() -> None:
    """Wherever it is interrupted: in the search, and while teachers are made with its outcome."""
    capture = synthetic_capture(frames=15, views=3, noise=1, hidden_keypoints=0.05, seed=1)
    config = QUICK.model_copy(update={"batch_size": 16})
    whole = Trainer(capture.keypoints, config)
    data = [whole.checkpoint() for progress in whole.run() if progress.stage == "refining"]
    about = [read_about(checkpoint, kind="checkpoint") for checkpoint in data]
    searching = next(number for number, one in enumerate(about) if "cameras" in one)
    assert searching > 5
    for checkpoint in (data[0], data[searching // 2], data[searching], data[-1]):
        part = Trainer(capture.keypoints, config, checkpoint=checkpoint)
        for _ in part.run():
            pass
        assert part.result().to_bytes() == whole.result().to_bytes()


def test_the_seed_decides_the_outcome(small: SyntheticCapture, small_prior: FittedPrior) -> None:
    assert fit(small.keypoints, QUICK).to_bytes() == small_prior.to_bytes()
    other = fit(small.keypoints, QUICK.model_copy(update={"seed": 1}))
    assert not np.array_equal(
        other.lift(small.keypoints).points3d, small_prior.lift(small.keypoints).points3d
    )


def test_progress_counts_to_the_end_and_the_error_falls(small: SyntheticCapture) -> None:
    seen: list[Progress] = []
    config = QUICK.model_copy(update={"steps": 250, "cameras": "moving"})
    prior = fit(small.keypoints, config, on_progress=seen.append)
    trained = [progress.step for progress in seen if progress.stage == "training"]
    assert trained == list(range(1, 251))
    found = [progress.step for progress in seen if progress.stage == "refining"]
    assert min(found) == 83
    assert found.count(83) > 10  # chances to stop while the cameras are sought, after a third
    assert [progress.step for progress in seen] == sorted(trained + found)
    assert seen[-1].seconds_left == 0
    assert all(progress.seconds_left is None for progress in seen[:WARM_UP_STEPS])
    assert all((progress.seconds_left or 0) > 0 for progress in seen[WARM_UP_STEPS:-1])
    assert seen[-1].loss < 0.5 * seen[0].loss
    assert seen[-1].reprojection_error < 0.5 * seen[0].reprojection_error
    assert prior.curve[-1] == (250, seen[-1].loss, seen[-1].reprojection_error)
    assert 100 <= len(prior.curve) <= 300


def _with_state(checkpoint: bytes, state: str | None) -> bytes:
    """Return a checkpoint with other numbers or, as the first version had it, as a tensor."""
    about = read_about(checkpoint, kind="checkpoint")
    arrays = load(checkpoint)
    del about["state"]
    if state is None:
        arrays["state"] = torch.zeros(17, dtype=torch.float64)
    else:
        about["state"] = state
    return pack(arrays, kind="checkpoint", about=about)


def test_checkpoints_of_another_version_are_refused(small: SyntheticCapture) -> None:
    data = Trainer(small.keypoints, QUICK).checkpoint()
    state = read_about(data, kind="checkpoint")["state"]
    Trainer(small.keypoints, QUICK, checkpoint=_with_state(data, state))  # the same again
    others = (None, "", "{}", state.replace('"step"', '"stage"'), state.replace("sought", "asked"))
    for other in others:
        with pytest.raises(WeightsError, match="another version"):
            Trainer(small.keypoints, QUICK, checkpoint=_with_state(data, other))


@pytest.mark.parametrize("case", ["config", "keypoints", "confidence", "prior", "truncated"])
def test_checkpoints_of_something_else_are_refused(
    small: SyntheticCapture, small_prior: FittedPrior, case: str
) -> None:
    data = Trainer(small.keypoints, QUICK).checkpoint()
    keypoints, config, confidence = small.keypoints, QUICK, None
    match case:
        case "config":
            config = QUICK.model_copy(update={"learning_rate": 1e-3})
        case "keypoints":
            keypoints = (
                small.keypoints + np.eye(2, dtype=np.float32)[0] * 10 * np.arange(16)[:, None]
            )
        case "confidence":
            confidence = np.full(small.confidence.shape, 0.5)
        case "prior":
            data = small_prior.to_bytes()
        case "truncated":
            data = data[:-10]
    with pytest.raises(WeightsError):
        Trainer(keypoints, config, confidence=confidence, checkpoint=data)


@pytest.mark.parametrize("case", thorough_after(2, ["line", "one place", "5 keypoints", "rigid"]))
def test_odd_captures_give_finite_answers(case: str) -> None:
    rng = np.random.default_rng(0)
    shape = (15, 3, 5, 2) if case == "5 keypoints" else (15, 2, 9, 2)
    keypoints = rng.uniform(100, 900, shape)
    if case == "line":
        keypoints[..., 1] = 300
    elif case == "rigid":
        keypoints[:] = keypoints[:1, :1]
    elif case == "one place":
        keypoints[:, 1] = 77  # the second camera sees nothing but one spot
    prior = fit(keypoints, QUICK)
    lift = prior.lift(keypoints)
    usable = slice(0, 1) if case == "one place" else slice(None)
    assert np.isfinite(lift.points3d).all()
    assert np.isfinite(lift.rotations[:, usable]).all()
    assert np.isfinite(lift.reprojection_errors[:, usable]).all()
    np.testing.assert_allclose(np.linalg.det(lift.rotations[:, usable]), 1, atol=1e-3)
    assert all(np.isfinite(row).all() for row in prior.curve)


def test_the_papers_deep_dictionaries_run(small: SyntheticCapture) -> None:
    sizes = (256, 128, 64, 32, 16, 8)
    config = FitConfig(steps=3, dictionary_sizes=sizes, learning_rate=1e-3)
    assert np.isfinite(fit(small.keypoints, config).lift(small.keypoints).points3d).all()


def test_a_capture_without_a_usable_view_is_refused() -> None:
    with pytest.raises(ValueError, match="no frame has a usable view"):
        fit(np.full((3, 2, 8, 2), np.nan), QUICK)
