"""What the settled structures of well-seen frames are worth to the others."""

import numpy as np
import pytest
import torch

from models.capture.metrics import pa_mpjpe
from models.capture.observations import as_observations
from models.capture.synthetic import SyntheticCapture, synthetic_capture
from models.network.priors.hierarchical import HierarchicalPrior
from models.settings.config import FitConfig, Refine
from models.training.teachers import Teachers, find_teachers
from models.training.trainer import Trainer, fit
from models.training.virtual_views import virtual_views
from tests.tiers import thorough_after

Tensor = torch.Tensor


def _mostly_single_views(frames: int = 400) -> SyntheticCapture:
    capture = synthetic_capture(frames=frames, views=3, seed=21)
    capture.keypoints[np.arange(frames) % 3 > 0, 1:] = np.nan
    return capture


def _observed(capture: SyntheticCapture) -> tuple[Tensor, Tensor]:
    seen = as_observations(capture.keypoints)
    frames = seen.usable.any(1)  # as in the trainer
    return torch.from_numpy(seen.keypoints[frames]), torch.from_numpy(seen.weights[frames])


def _network(keypoints: int) -> HierarchicalPrior:
    network = HierarchicalPrior(keypoints, (16, 8))
    network.initialise(0)
    return network


def _teachers(keypoints: Tensor, weights: Tensor, *, most: int = 50) -> Teachers:
    found = find_teachers(_network(16), keypoints, weights, most=most, seed=[0])
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("refine", "frames", "steps"), thorough_after(1, [("off", 200, 300), ("auto", 150, 300)])
)
def test_frames_with_one_view_learn_from_frames_with_several(
    refine: Refine, frames: int, steps: int
) -> None:
    capture = _mostly_single_views(frames)
    single = np.arange(frames) % 3 > 0

    def error(*, distillation: bool) -> float:
        config = FitConfig(steps=steps, distillation=distillation, refine=refine, cameras="moving")
        lift = fit(capture.keypoints, config).lift(capture.keypoints)
        return float(pa_mpjpe(lift.points3d, capture.points3d).per_frame[single].mean())

    assert error(distillation=True) < 0.9 * error(distillation=False)


def test_without_two_views_there_are_no_teachers() -> None:
    keypoints, weights = _observed(synthetic_capture(frames=6, views=1))
    assert find_teachers(_network(16), keypoints, weights, most=50, seed=[0]) is None


def test_teachers_are_few_and_come_from_frames_with_two_views() -> None:
    keypoints, weights = _observed(_mostly_single_views())
    teachers = _teachers(keypoints, weights)
    taught = teachers.taught.nonzero()[:, 0]
    assert len(taught) == len(teachers.points) == 50
    assert ((weights[taught].sum(-1) > 0).sum(1) > 1).all()
    assert sorted(teachers.indices[taught].tolist()) == list(range(50))
    torch.testing.assert_close(teachers.points.square().sum(-1).mean(-1), torch.ones(50))


def test_virtual_views_have_the_gaps_of_the_capture_and_are_normalised() -> None:
    capture = synthetic_capture(frames=60, views=3, hidden_views=0.3, hidden_keypoints=0.1, seed=2)
    keypoints, weights = _observed(capture)
    teachers = _teachers(keypoints, weights)
    points, views, shown = virtual_views(teachers, weights, 200, np.random.default_rng(0))
    assert points.shape == (200, 16, 3)
    assert views.shape == (200, 3, 16, 2)
    there = shown.sum(-1) > 0
    assert there.any(1).all()  # at least one view each
    assert (there.sum(1) == 1).float().mean() > 0.2  # often only one
    assert (views[shown == 0] == 0).all()
    mean = (shown[..., None] * views).sum(-2)[there]
    torch.testing.assert_close(mean, torch.zeros_like(mean), atol=1e-3, rtol=0)
    size = ((shown[..., None] * views.square()).sum((-2, -1)) / shown.sum(-1).clamp_min(1))[there]
    torch.testing.assert_close(size, torch.ones_like(size), atol=1e-3, rtol=0)


@pytest.mark.parametrize("stop", thorough_after(1, [15, 14, 16, 22, 23, 25]))
def test_a_fit_resumes_bit_for_bit_around_its_refreshes(stop: int) -> None:
    capture = synthetic_capture(frames=21, views=2, noise=2, hidden_views=0.2, seed=3)
    config = FitConfig(steps=30, dictionary_sizes=(16, 8), batch_size=8, refine="off")
    whole = Trainer(capture.keypoints, config)
    data = b""
    for progress in whole.run():
        if progress.step == stop:
            data = whole.checkpoint()
    rest = Trainer(capture.keypoints, config, checkpoint=data)
    for _ in rest.run():
        pass
    assert rest.result().to_bytes() == whole.result().to_bytes()
