"""First answers: what geometry found is there while the network is still taught."""

import os
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np
import orjson
import pytest
from safetensors.numpy import load

from benchmarks.captures import studio
from models.capture.metrics import pa_mpjpe
from tests.processes import command_of, descendants, processes
from tests.service.conftest import (
    BYTES,
    SEEKING,
    Live,
    assert_can_be_resumed,
    job_events,
    problem,
    to_safetensors,
)
from tests.waiting import wait_for

STUDIO = studio(3, 15, frames=40, seed=2)
TRUTH = np.asarray(STUDIO.points3d)
ACCURATE = 0.02  # metres, of a figure some 1.7 m tall, where keypoints are off by a pixel


def objects_of(live: Live, fit: dict[str, Any]) -> set[str]:
    folder = live.data_dir / "objects" / "fits" / fit["id"]
    return {file.name.split("_")[0] for file in folder.glob("*")}


def first_answer(live: Live, dataset_id: str, **config: Any) -> dict[str, Any]:
    """Fit, and return the fit as the event of its first answer has it."""
    made = live.http.post("/fits", json={"dataset_id": dataset_id, "config": SEEKING | config})
    assert made.status_code == 202, made.text
    fit = made.json()
    detail = problem(live.http.get(f"/fits/{fit['id']}/reconstruction"), 409, "conflict")
    assert "answer_stage" in detail
    for _, _, seen in job_events(live, f"/fits/{fit['id']}"):
        if seen["answer_stage"] is not None:
            assert (seen["status"], seen["answer_stage"]) == ("running", "geometry")
            found: dict[str, Any] = seen
            return found
    raise AssertionError("the fit ended without a first answer")


@pytest.fixture(scope="module")
def dataset_id(live: Live) -> str:
    body = to_safetensors(
        keypoints=STUDIO.keypoints, points3d=TRUTH, image_sizes=STUDIO.image_sizes
    )
    made = live.http.post("/datasets", content=body, headers=BYTES)
    assert made.status_code == 201, made.text
    return str(made.json()["id"])


@pytest.fixture
def long(live: Live, dataset_id: str) -> Iterator[dict[str, Any]]:
    """Give a fit that has its first answer and whose network is taught for ever."""
    fit = first_answer(live, dataset_id, steps=1_000_000, early_stopping=False)
    yield fit
    live.http.post(f"/fits/{fit['id']}/cancel")
    live.finished(fit["id"])


def test_geometry_answers_while_the_network_is_taught(live: Live, long: dict[str, Any]) -> None:
    url = f"/fits/{long['id']}"
    octets = live.http.get(f"{url}/reconstruction?format=safetensors").content
    assert orjson.loads(octets[8 : 8 + int.from_bytes(octets[:8], "little")])["__metadata__"][
        "stage"
    ] == ("geometry")
    arrays = load(octets)
    assert pa_mpjpe(arrays["points3d"], TRUTH).mean < ACCURATE
    assert (arrays["points3d_sd"] > 0).all()
    assert_can_be_resumed(live, f"{url}/reconstruction?format=npz")

    body = live.get(f"{url}/reconstruction?frame=room&up=auto&frames=:2")
    assert (body["stage"], body["model_id"], len(body["frames"])) == ("geometry", None, 2)
    assert body["findings"] == long["findings"]
    cameras = live.get(f"{url}/cameras")
    assert (cameras["stage"], cameras["model"]) == ("geometry", None)
    assert cameras["arrangement"] == "static"
    assert "[cam_2]" in live.http.get(f"{url}/cameras?format=anipose").text
    tidy = live.http.get(f"{url}/animation?format=csv-tidy&frame=room&up=auto").text
    assert len(tidy.splitlines()) > TRUTH.size / 3

    # What comes with the model says so, and when.
    for path in ("reconstruction?refine=off", "reconstruction?uncertainty=full", "labels"):
        detail = problem(live.http.get(f"{url}/{path}"), 409, "conflict")
        assert "when it has succeeded" in detail
    assert "only a fit that succeeded" in problem(live.http.get(f"{url}/report"), 409, "conflict")


def wait_for_a_step(live: Live, url: str) -> None:
    before = live.get(url)["progress"]["step"]
    wait_for(lambda: live.get(url)["progress"]["step"] > before or None, "a step")


def test_a_first_answer_outlives_its_worker_and_goes_with_a_cancelled_fit(
    live: Live, long: dict[str, Any]
) -> None:
    url = f"/fits/{long['id']}"
    first = live.http.get(f"{url}/reconstruction?format=npz").content
    wait_for(lambda: "checkpoint" in objects_of(live, long) or None, "a checkpoint")
    for _ in range(2):  # by then it is recorded: nobody deletes one that is not
        wait_for_a_step(live, url)
    parents = processes()
    workers = {pid for pid in descendants(live.process.pid) if b"worker" in command_of(pid)}
    for horse in {pid for pid in workers if parents[pid] in workers}:
        os.kill(horse, signal.SIGKILL)
    wait_for(lambda: live.get(url)["attempt"] > 1 or None, "another attempt")
    assert live.get(url)["answer_stage"] == "geometry"
    assert live.http.get(f"{url}/reconstruction?format=npz").content == first
    live.http.post(f"{url}/cancel")
    ended = live.finished(long["id"])
    assert (ended["status"], ended["answer_stage"], ended["findings"]) == ("cancelled", None, [])
    problem(live.http.get(f"{url}/reconstruction"), 409, "conflict")
    problem(live.http.get(f"{url}/cameras"), 409, "conflict")
    wait_for(lambda: not objects_of(live, long) or None, "the end of its objects")


def test_the_network_takes_its_place(live: Live, dataset_id: str) -> None:
    fit = first_answer(live, dataset_id)
    url = f"/fits/{fit['id']}"
    first = live.http.get(f"{url}/reconstruction?format=npz")
    ended = live.finished(fit["id"])
    assert (ended["status"], ended["answer_stage"]) == ("succeeded", "network")
    after = live.http.get(f"{url}/reconstruction?format=npz")
    assert after.headers["etag"] != first.headers["etag"]
    assert live.get(f"{url}/reconstruction?frames=:1")["stage"] == "network"
    cameras = live.get(f"{url}/cameras")
    assert (cameras.pop("stage"), cameras.pop("fit_id")) == ("network", fit["id"])
    assert cameras == live.get(f"/models/{ended['model_id']}/cameras")
    wait_for(lambda: len(objects_of(live, fit)) == 2 or None, "the end of what came first")
    assert objects_of(live, fit) == {"reconstruction", "report"}

    known = {"If-None-Match": live.http.get(url).headers["etag"]}
    assert live.http.get(url, headers=known).status_code == 304
    live.http.delete(f"/models/{ended['model_id']}").raise_for_status()
    assert live.http.get(url, headers=known).json()["model_id"] is None
