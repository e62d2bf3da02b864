"""Workers and services that are pointed at the objects of others."""

import os
from pathlib import Path

import pytest
from redis import Redis

from store import fits
from store.database import Store
from tests.fork_server import run
from worker.process import python
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings


@pytest.mark.parametrize("command", ["worker", "serve"])
def test_a_forgotten_setting_of_the_records_is_refused_and_harms_nothing(
    command: str,
    store: Store,
    redis: Redis,
    settings: WorkerSettings,
    dataset_id: str,
    tmp_path: Path,
) -> None:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config={"steps": 20})
    enqueue(open_queue(redis), fit)
    forgotten = settings.to_environment() | {
        "FEWVIEW_DATA_DIR": str(tmp_path / "new"),
        "FEWVIEW_STORE_URL": store.objects.url,
        "FEWVIEW_PORT": "0",
    }
    forgotten.pop("FEWVIEW_DATABASE_URL", None)
    before = sorted(store.objects.list())
    refused = run(python("-m", "service.cli", command), env=os.environ | forgotten)
    assert refused.returncode == 2, refused
    assert "FEWVIEW_DATABASE_URL" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1, refused.stderr
    assert sorted(store.objects.list()) == before
    assert open_queue(redis).get_job_ids() == [fit.job_id]  # left for a worker that knows it
