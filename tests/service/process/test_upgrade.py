"""What the last version that knew no migrations left behind is served, and its work goes on.

How the folder was made: tests/fixtures/README.md, make_later_folder.py.
"""

import io
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, load_file

from tests.service.conftest import Live, kill_service, start_service
from tests.service.process.test_older_data_folder import named
from tests.waiting import wait_for

ARCHIVE = Path(__file__).parents[2] / "fixtures" / "data_folder_e3d0c35.tar.xz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("before")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture(scope="module")
def served(folder: Path) -> Iterator[Live]:
    live = start_service(folder)
    yield live
    kill_service(live)


def assert_equal(now: dict[str, Any], then: dict[str, Any]) -> None:
    assert now.keys() == then.keys()
    for name, array in then.items():
        np.testing.assert_array_equal(now[name], array, err_msg=name)


def content(live: Live, path: str) -> bytes:
    response = live.http.get(path)
    assert response.status_code == 200, response.text
    return response.content


def test_nothing_is_lost_or_changed(folder: Path, served: Live) -> None:
    seen, fit, model = (
        named(served, *what)
        for what in (("datasets", "figure"), ("fits", "done"), ("models", "done"))
    )
    capture = np.load(io.BytesIO(content(served, f"{seen}/capture")))
    assert_equal(dict(capture), dict(np.load(folder / "capture.npz")))
    answer = served.get(seen)
    assert (answer["tags"], answer["metadata"]) == (["pilot"], {"subject": "M7"})
    assert served.get(fit)["model_id"] in model
    for path, file in (
        (f"{fit}/reconstruction?format=safetensors", "reconstruction"),
        (f"{model}/weights", "weights"),
        (f"{named(served, 'lifts', 'lifted')}/result?format=safetensors", "lifted"),
        (f"{named(served, 'lifts', 'room')}/result?format=safetensors", "room"),
    ):
        assert_equal(load(content(served, path)), load_file(folder / f"{file}.safetensors"))
    for name in ("lifted", "room"):
        lines = content(served, f"{named(served, 'lifts', name)}/result?format=jsonl")
        assert lines == (folder / f"{name}.jsonl").read_bytes()


def test_a_lift_that_waited_is_done_as_it_would_have_been(folder: Path, served: Live) -> None:
    lift = named(served, "lifts", "waiting")
    ended = served.ended(lift)
    assert ended["status"] == "succeeded", ended["error"]
    now = load(content(served, f"{lift}/result?format=safetensors"))
    for name, array in load_file(folder / "lifted.safetensors").items():
        np.testing.assert_allclose(now[name], array, rtol=1e-3, atol=1e-3, err_msg=name)


@pytest.mark.thorough
def test_a_fit_that_was_cut_off_goes_on_from_its_checkpoint(served: Live) -> None:
    fit = named(served, "fits", "interrupted")

    def next_attempt() -> dict[str, Any] | None:
        found = served.get(fit)
        assert found["progress"]["step"] > 500, "it began anew"  # the checkpoint is of some 570
        return found if found["status"] not in ("queued", "running") else None

    ended = wait_for(next_attempt, "the fit's end")
    assert ended["status"] == "succeeded", ended["error"]
    assert ended["attempt"] == 2
    assert ended["progress"]["step"] == 3000


def test_a_request_that_is_sent_again_makes_nothing_new(served: Live) -> None:
    lift = served.get(named(served, "lifts", "lifted"))
    body = {name: lift[name] for name in ("dataset_id", "model_id", "name", "frame")}
    again = served.http.post("/lifts", json=body, headers={"Idempotency-Key": "lifted"})
    assert again.status_code == 202, again.text
    assert again.json()["id"] == lift["id"]
