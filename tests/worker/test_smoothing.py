"""Datasets with times: their fits and lifts are smoothed, whatever parts they are done in."""

from copy import copy
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from redis import Redis
from safetensors.numpy import load

from models.capture.clocks import Clocks
from models.lifting.film import film_of, read_film
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import fit
from store import datasets, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.lift_files import result_file
from store.records import LiftRecord
from tests.models.lifting.comparison import without
from tests.models.walk import film
from tests.sharing import fitted_once
from tests.waiting import wait_for
from tests.worker.conftest import StartWorker
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings

FRAMES, CHUNK, FPS, NOISE = 300, 64, 50.0, 8.0
MOMENTS = np.arange(FRAMES, dtype=np.float64)
TIMES = MOMENTS / FPS
CONFIG = FitConfig(steps=40, batch_size=16, refine="off")


@pytest.fixture(scope="module")
def keypoints() -> NDArray[np.float64]:
    return film([0, 90, 200], MOMENTS, noise=NOISE)


@pytest.fixture(scope="module")
def prior(keypoints: NDArray[np.float64]) -> FittedPrior:
    return fitted_once("film", lambda: fit(keypoints, CONFIG, times=TIMES))


@pytest.fixture
def settings(settings: WorkerSettings) -> WorkerSettings:
    return settings.model_copy(update={"lift_chunk_frames": CHUNK})


def test_times_smooth_a_lift_and_its_order_matters_only_then(
    prior: FittedPrior, keypoints: NDArray[np.float64]
) -> None:
    assert prior.smooths
    # Frames after the fit, as of its own frames a fit knows much without times, too. They are held
    # against clean ones that are not denoised: that would bring them to where noisy ones come.
    after = film([0, 90, 200], MOMENTS + FRAMES)
    later = after + NOISE * np.random.default_rng(1).standard_normal(after.shape)
    clear = without(prior, "denoiser", "motion").lift(after).points3d

    def off(points: NDArray[np.float32]) -> float:
        return float(np.linalg.norm(points - clear, axis=-1).mean())

    smoothed = prior.lift(later, times=TIMES)
    assert off(smoothed.points3d) < 0.85 * off(prior.lift(later).points3d)
    alone, together = prior.lift(keypoints), prior.lift(keypoints, times=TIMES)
    order = np.random.default_rng(0).permutation(FRAMES)
    shuffled = prior.lift(keypoints[order]).points3d
    np.testing.assert_allclose(shuffled, alone.points3d[order], atol=1e-3)
    again = FittedPrior.from_bytes(prior.to_bytes()).lift(keypoints, times=TIMES)
    np.testing.assert_array_equal(again.points3d, together.points3d)
    some = prior.lift(keypoints, times=TIMES, only=slice(100, 110))
    np.testing.assert_allclose(some.points3d, together.points3d[100:110], atol=1e-5)


def test_a_part_of_a_film_with_late_views_is_that_of_the_whole(
    prior: FittedPrior, keypoints: NDArray[np.float64]
) -> None:
    late, shown, own = copy(prior), keypoints.astype(np.float32), slice(100, 110)
    late.capture = prior.capture._replace(clocks=Clocks(TIMES[:1], np.array([[0, 0.05, -0.09]])))
    whole = film_of(late, (shown, None, TIMES))
    part = read_film(late, lambda a, b: (shown[a:b], None, TIMES[a:b]), own, FRAMES)
    np.testing.assert_array_equal(part.keypoints[part.own], whole.keypoints[own])
    assert (np.abs(part.keypoints[part.own] - shown[own]).max((0, 2, 3)) > [-1, 1, 1]).all()
    found = part.lift(part.own).points3d
    np.testing.assert_allclose(found, whole.lift(own).points3d, atol=1e-5)


def test_a_lift_job_in_chunks_is_the_whole(
    store: Store,
    redis: Redis,
    prior: FittedPrior,
    keypoints: NDArray[np.float64],
    settings: WorkerSettings,
    start_worker: StartWorker,
) -> None:
    description = CaptureDescription(name="film", fps=FPS)
    dataset = datasets.create(store, Capture.checked(keypoints), description)
    columns: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    model = models.create(store, prior.to_bytes(), name="m", keypoints=16, **columns)
    lift = lifts.create(
        store,
        dataset_id=dataset.id,
        model_id=model.id,
        name="l",
        chunk_frames=settings.lift_chunk_frames,
    )
    enqueue(open_queue(redis), lift)
    start_worker()
    wait_for(
        lambda: lookup.get(store, LiftRecord, lift.id).status in ("succeeded", "failed"), "the lift"
    )
    record = lookup.get(store, LiftRecord, lift.id)
    assert record.error is None
    file = result_file(record, lifts.finished_chunks(store, record), "safetensors", {})
    found = load(b"".join(file.read(store.objects.get_range, 0, file.size)))
    whole = prior.lift(keypoints, times=TIMES)
    # Parts are smoothed with 200 frames around them, which leave a little to say to those beyond.
    np.testing.assert_allclose(found["points3d"], whole.points3d, atol=2e-3)
