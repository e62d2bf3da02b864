"""One attempt, in this process: it heeds what is asked of it while it lifts, too."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load

from models.lifting import film
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.training.trainer import Trainer
from store import answers, attempts, datasets, fits, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.records import FitRecord, ModelRecord
from tests.worker.conftest import CONFIG
from worker import fitting
from worker.heartbeat import Heartbeat
from worker.settings import WorkerSettings

LIFT = FittedPrior.lift
RESULT = Trainer.result
SIZES = [[1280, 1024], None, [640, 480]]
EDGES = [[0, 1], [1, 2]]


@pytest.fixture
def store(tmp_path: Path) -> Any:
    store = Store(WorkerSettings(data_dir=tmp_path))
    yield store
    store.close()


def run(store: Store, capture: Capture, monkeypatch: pytest.MonkeyPatch, **asked: Any) -> FitRecord:
    """Fit in slices of 5 frames; after the second slice set what is ``asked`` of the heartbeat."""
    described = CaptureDescription("figure", skeleton={"edges": EDGES}, image_sizes=SIZES)
    dataset_id = datasets.create(store, capture, described).id
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=CONFIG | {"steps": 5})
    attempt = attempts.claim(store, fit.id, lease_seconds=60)
    assert attempt is not None
    heartbeat = Heartbeat(partial(attempts.beat, store, attempt))
    lifted: list[int] = []

    def lift(prior: FittedPrior, keypoints: Any, **more: Any) -> LiftedFrames:
        lifted.append(len(keypoints))
        if len(lifted) == 2:
            vars(heartbeat).update(asked)
        return LIFT(prior, keypoints, **more)

    def result(trainer: Trainer) -> FittedPrior:
        prior = RESULT(trainer)
        monkeypatch.setattr(FittedPrior, "lift", lift)  # trainers lift, too: that does not count
        return prior

    monkeypatch.setattr(film, "PART_FRAMES", 5)
    monkeypatch.setattr(Trainer, "result", result)
    # Checkpoints by the clock would depend on how busy the machine is.
    settings = WorkerSettings(data_dir=Path("unused"), checkpoint_seconds=3600)
    fitting.run_attempt(store, attempt, heartbeat, settings)
    assert lifted == ([5, 5] if asked else [5, 5, 5, 1])
    return lookup.get(store, FitRecord, fit.id)


def test_slices_make_the_whole(
    store: Store, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = run(store, capture, monkeypatch)
    assert fit.status == "succeeded"
    found = load(answers.load_reconstruction(store, fit))
    assert fit.model_id is not None
    prior = FittedPrior.from_bytes(
        models.load_weights(store, lookup.get(store, ModelRecord, fit.model_id))
    )
    whole = LIFT(prior, capture.keypoints, confidence=capture.confidence)
    assert found.keys() == whole.arrays.keys()
    for name, array in found.items():
        np.testing.assert_allclose(array, getattr(whole, name), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("asked", "status"), [("cancel", "cancelled"), ("leave", "queued"), ("lost", "running")]
)
def test_what_is_asked_counts_between_two_slices(
    store: Store,
    capture: Capture,
    monkeypatch: pytest.MonkeyPatch,
    asked: str,
    status: str,
) -> None:
    fit = run(store, capture, monkeypatch, **{asked: True})
    assert fit.status == status
    assert fit.model_id is None
    assert (fit.checkpoint_key is not None) == (asked == "leave")


def test_the_trainer_gets_the_image_sizes_and_the_edges(
    store: Store, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []

    def trainer(*arguments: Any, **more: Any) -> Trainer:
        given.extend((more["image_sizes"], more["edges"]))
        return Trainer(*arguments, **more)

    monkeypatch.setattr(fitting, "Trainer", trainer)
    run(store, capture, monkeypatch)
    assert given == [[(1280, 1024), None, (640, 480)], EDGES]
