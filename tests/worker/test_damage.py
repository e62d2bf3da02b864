"""Damaged objects end what needs them, and no worker."""

from redis import Redis

from store import attempts, datasets, fits, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.records import LiftRecord
from tests.damage import flip, truncate
from tests.waiting import wait_for
from tests.worker.conftest import CONFIG, FitHere, StartWorker, wait_until
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings


def test_a_damaged_object_fails_what_needs_it_and_the_worker_goes_on(
    store: Store,
    settings: WorkerSettings,
    redis: Redis,
    capture: Capture,
    fit_here: FitHere,
    start_worker: StartWorker,
) -> None:
    objects = settings.data_dir / "objects"
    weights = fit_here(CONFIG).to_bytes()
    columns = {
        "name": "damaged",
        "keypoints": capture.keypoints.shape[2],
        "config": {},
        "training_curve": [],
        "metrics": {},
    }
    model = models.create(store, weights, **columns)
    truncate(objects / model.weights_key)
    whole, harmed = (datasets.create(store, capture, CaptureDescription(n)).id for n in ("a", "b"))
    (chunk,) = (objects / "datasets" / harmed).iterdir()
    flip(chunk)
    sound = fits.create(store, dataset_id=whole, name="sound", config=CONFIG)
    attempt = attempts.claim(store, sound.id, lease_seconds=60)
    assert attempt is not None
    attempts.save_checkpoint(store, attempt, b"a checkpoint that nobody can read any more")
    attempts.release(store, attempt)
    (checkpoint,) = (objects / "fits" / sound.id).iterdir()
    flip(checkpoint)

    hopeless = fits.create(store, dataset_id=harmed, name="hopeless", config=CONFIG)
    lift = lifts.create(store, model_id=model.id, dataset_id=whole, name="lift", chunk_frames=4096)
    queue = open_queue(redis)
    for job in (hopeless, lift, sound):
        enqueue(queue, job)
    worker = start_worker()
    record = wait_until(store, hopeless.id, "failed", "succeeded")
    assert record.error is not None
    assert record.error["code"] == "object_damaged"
    assert harmed in record.error["message"]
    wait_for(lambda: lookup.get(store, LiftRecord, lift.id).status == "failed", "the lift to fail")
    error = lookup.get(store, LiftRecord, lift.id).error
    assert error is not None
    assert error["code"] == "object_damaged"
    assert wait_until(store, sound.id, "succeeded", "failed").error is None
    assert worker.poll() is None
