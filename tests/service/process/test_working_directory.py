"""Nothing of the folder that the service is started in is imported, whatever lies there."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from models.capture.synthetic import SyntheticCapture
from tests.service.conftest import (
    BYTES,
    Live,
    frames_of,
    kill_service,
    start_service,
    to_npz,
)

PACKAGES = ("models", "store", "service", "worker")
MODULES = ("numba", "redis", "rq", "torch", "uvicorn")  # what children import first, and later
RAISE = "raise SystemExit(f'{__file__} was imported')\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder of somebody else's packages and modules, by the names of ours."""
    folder = tmp_path_factory.mktemp("elsewhere")
    for name in PACKAGES:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(RAISE)
    for name in MODULES:
        (folder / f"{name}.py").write_text(RAISE)
    return folder


@pytest.fixture(scope="module")
def live(folder: Path) -> Iterator[Live]:
    script = Path(sys.executable).with_name("fewview")
    live = start_service(folder / "data", program=[str(script)], cwd=folder, popen=subprocess.Popen)
    yield live
    kill_service(live)


@pytest.mark.thorough
def test_a_fit_runs_and_a_lift_answers(live: Live, capture: SyntheticCapture) -> None:
    data = to_npz(keypoints=capture.keypoints)
    dataset = live.http.post("/datasets", content=data, headers=BYTES).json()["id"]
    fit = live.finished(live.fit(dataset, steps=20)["id"])
    assert fit["status"] == "succeeded", fit["error"]
    body = {"model": fit["model_id"], "frames": frames_of(capture.keypoints[:2])}
    lifted = live.http.post("/lift", json=body)
    assert lifted.status_code == 200, lifted.text
    assert [frame["status"] for frame in lifted.json()["frames"]] == ["ok", "ok"]
    job = live.http.post("/lifts", json={"model_id": fit["model_id"], "dataset_id": dataset})
    assert live.ended(job.headers["location"])["status"] == "succeeded"
