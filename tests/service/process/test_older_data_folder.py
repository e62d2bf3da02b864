"""A data folder that an older version left behind is served, and its work goes on.

How the folder was made: tests/fixtures/README.md.
"""

import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, load_file

from store.database import Store
from store.lookup import get
from store.records import FitRecord
from store.settings import StoreSettings
from tests.service.conftest import Live, kill_service, problem, start_service

ARCHIVE = Path(__file__).parents[2] / "fixtures" / "data_folder.tar.xz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("older")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.fixture(scope="module")
def served(folder: Path) -> Iterator[Live]:
    live = start_service(folder)
    yield live
    kill_service(live)


def named(live: Live, kind: str, name: str) -> str:
    """Return the path of the only dataset, fit, lift or model with this name."""
    (found,) = [item for item in live.get(f"/{kind}")["items"] if item["name"] == name]
    return f"/{kind}/{found['id']}"


def test_what_was_finished_is_served_as_it_was(folder: Path, served: Live) -> None:
    fit, lift = named(served, "fits", "done"), named(served, "lifts", "lifted")
    assert served.get(fit)["status"] == served.get(lift)["status"] == "succeeded"
    for path, file in (
        (f"{fit}/reconstruction?format=safetensors", "reconstruction.safetensors"),
        (f"{lift}/result?format=safetensors", "result.safetensors"),
    ):
        now, then = load(served.http.get(path).content), load_file(folder / file)
        assert now.keys() == then.keys()
        for name, array in then.items():
            np.testing.assert_array_equal(now[name], array)
    lines = served.http.get(f"{lift}/result?format=jsonl").content
    assert lines == (folder / "result.jsonl").read_bytes()
    seen = served.get(named(served, "datasets", "figure"))
    assert (seen["frames"], seen["views"], seen["keypoints"]) == (40, 3, 16)
    assert seen["image_sizes"] == [[1280, 1024]] * 3
    assert served.get(fit)["dataset_id"] == seen["id"]


def test_what_it_held_takes_tags_and_metadata(served: Live) -> None:
    for kind, name in (("datasets", "figure"), ("fits", "done"), ("models", "done")):
        path = named(served, kind, name)
        assert served.get(path)["tags"] == []
        fields = {"tags": ["old"], "metadata": {"from": "before"}}
        assert served.http.patch(path, json=fields).status_code == 200
        (found,) = served.get(f"/{kind}?tag=old&metadata.from=before")["items"]
        assert found["id"] in path


def test_its_model_lifts_and_its_reconstruction_is_refined_otherwise(
    folder: Path, served: Live
) -> None:
    fit, model = named(served, "fits", "done"), named(served, "models", "done")
    assert served.get(model)["fit_id"] == served.get(fit)["id"]
    assert served.get(f"{model}/cameras")["arrangement"] == "static"
    # Refined as in the fit, but today and from the stored keypoints: the same again.
    dataset, name = served.get(fit)["dataset_id"], "again"
    body = {"model_id": model.rpartition("/")[2], "dataset_id": dataset, "name": name}
    made = served.http.post("/lifts", json=body)
    assert made.status_code == 202, made.text
    path = f"/lifts/{made.json()['id']}"
    ended = served.ended(path)
    assert ended["status"] == "succeeded", ended["error"]
    now = load(served.http.get(f"{path}/result?format=safetensors").content)
    for name, array in load_file(folder / "result.safetensors").items():
        np.testing.assert_allclose(now[name], array, rtol=1e-3, atol=1e-3, err_msg=name)
    weak = load(served.http.get(f"{fit}/reconstruction?format=safetensors&refine=off").content)
    assert (weak["camera_models"] == 0).all()


def test_a_failed_fit_still_gives_the_reason(served: Live) -> None:
    fit = named(served, "fits", "failed")
    found = served.get(fit)
    assert (found["status"], found["error"]["code"]) == ("failed", "unusable_capture")
    assert "usable view" in found["error"]["message"]
    problem(served.http.get(f"{fit}/reconstruction"), 409, "conflict")


def test_an_interrupted_fit_is_brought_to_its_end(served: Live) -> None:
    fit = named(served, "fits", "interrupted")
    ended = served.ended(fit)
    assert ended["status"] == "succeeded", ended["error"]
    assert ended["attempt"] == 2
    assert ended["progress"]["step"] == 600
    assert served.http.get(f"{fit}/reconstruction").status_code == 200


def test_the_interrupted_fit_left_a_checkpoint(tmp_path: Path) -> None:
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    store = Store(StoreSettings(data_dir=tmp_path))
    try:
        (key,) = [key for key, _ in store.objects.list() if "checkpoint" in key]
        fit = get(store, FitRecord, key.split("/")[1])
        assert (fit.status, fit.checkpoint_key) == ("running", key)
    finally:
        store.close()
