"""The server as it is installed: from its wheel, in an environment with modules of like names."""

import os
import subprocess
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

from service.page.serving import BUILT
from tests.service.conftest import kill_service, start_service
from worker.process import python

ROOT = Path(__file__).parent.parent
FLOORS = ("models", "store", "worker", "service")


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel into a folder that has modules with the names of all floors."""
    folder = tmp_path_factory.mktemp("environment")
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(folder / "dist"), versions=["standard"])
    packages = folder / "packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)  # noqa: S202 (our own)
    for floor in FLOORS:
        (packages / f"{floor}.py").write_text("raise RuntimeError('not a part of Fewview')\n")
    return packages


def test_the_wheel_claims_one_import_name(environment: Path) -> None:
    names = {entry.name for entry in environment.iterdir() if entry.is_dir()}
    (about,) = (name for name in names if name.endswith(".dist-info"))
    assert names == {"fewview_server", about}
    assert {f.name for f in (environment / "fewview_server").iterdir()} == {"__init__.py", *FLOORS}
    metadata = message_from_bytes((environment / about / "METADATA").read_bytes())
    assert metadata["Name"] == "fewview-server"
    installed = {file.relative_to(environment / "fewview_server") for file in _sources(environment)}
    written = {file.relative_to(ROOT) for floor in FLOORS for file in (ROOT / floor).rglob("*.py")}
    assert written <= installed


def test_wheel_and_sdist_have_the_page_in_them(environment: Path, tmp_path: Path) -> None:
    if not (BUILT / "index.html").exists():
        pytest.skip("the page was not built: `make page`, which needs npm's registry")
    built = {str(file.relative_to(BUILT)) for file in BUILT.rglob("*") if file.is_file()}
    installed = environment / "fewview_server" / "service" / "page" / "built"
    assert built == {str(f.relative_to(installed)) for f in installed.rglob("*") if f.is_file()}
    (sdist,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with tarfile.open(sdist) as tarball:
        packed = {name.partition("/")[2] for name in tarball.getnames()}
    assert {f"service/page/built/{name}" for name in built} <= packed
    assert not any("node_modules" in name for name in packed)


def test_a_service_of_the_wheel_runs_its_own_modules(environment: Path, tmp_path: Path) -> None:
    within = ("/usr/bin/env", f"PYTHONPATH={environment}{os.pathsep}{ROOT / 'client'}")
    program = [*within, *python("-m", "fewview.cli")]
    live = start_service(tmp_path / "data", program=program, popen=subprocess.Popen)
    try:
        assert live.http.get("/health/ready").status_code == 200
    finally:
        kill_service(live)
    elsewhere = subprocess.run(
        [*within, *python("-c", "import fewview_server, models")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "not a part of Fewview" in elsewhere.stderr  # the environment's module is still its own


def _sources(environment: Path) -> list[Path]:
    return list((environment / "fewview_server").rglob("*.py"))
