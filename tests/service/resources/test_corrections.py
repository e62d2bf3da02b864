"""Keypoints are corrected over HTTP, fitted again, and written back as labels."""

import io
import json
import zipfile
from typing import Any

import numpy as np
from starlette.testclient import TestClient

from tests.deployments import on_every_deployment
from tests.service.conftest import JSON, Live, make_dataset, problem

MOVED: dict[str, Any] = {"frame": 3, "view": 1, "keypoint": 2, "position": [300.25, 200.5]}
REMOVED: dict[str, Any] = {"frame": 4, "view": 0, "keypoint": 0, "position": None}


def place(correction: dict[str, Any]) -> dict[str, Any]:
    return {name: correction[name] for name in ("frame", "view", "keypoint")}


@on_every_deployment
def test_corrections_are_put_listed_and_undone(api: TestClient) -> None:
    url = f"/datasets/{make_dataset(api)['id']}"
    detected = api.get(f"{url}/capture")
    nothing = api.get(f"{url}/corrections")
    assert nothing.json() == {"count": 0, "checksum": None, "items": []}
    tried = api.patch(f"{url}/corrections?dry_run=true", json={"correct": [MOVED]})
    assert tried.json()["count"] == 1
    assert api.get(f"{url}/corrections").json() == nothing.json()
    made = api.patch(f"{url}/corrections", json={"correct": [REMOVED, MOVED]})
    assert made.status_code == 200, made.text
    listed = api.get(f"{url}/corrections")
    assert listed.json() == made.json() | {"items": [MOVED, REMOVED]}
    assert listed.headers["ETag"] == made.headers["ETag"] == api.get(url).headers["ETag"]
    assert api.get(url).json()["corrections"] == made.json() != tried.json()
    again = api.patch(f"{url}/corrections", json={"correct": [MOVED, REMOVED]})
    assert again.headers["ETag"] == made.headers["ETag"]

    corrected = api.get(f"{url}/capture")
    assert corrected.headers["ETag"] != detected.headers["ETag"]
    pixels = np.load(io.BytesIO(corrected.content))["keypoints"]
    assert pixels[3, 1, 2].tolist() == MOVED["position"]
    assert np.isnan(pixels[4, 0, 0]).all()
    assert api.get(f"{url}/capture?corrected=false").content == detected.content
    part = api.get(f"{url}/capture", headers={"Range": "bytes=100-2099"}).content
    assert part == corrected.content[100:2100]

    undone = api.patch(f"{url}/corrections", json={"undo": [place(MOVED), place(REMOVED)]})
    assert undone.json() == {"count": 0, "checksum": None}
    assert api.get(f"{url}/capture").content == detected.content


@on_every_deployment
def test_of_two_who_correct_the_second_learns_of_the_first(api: TestClient) -> None:
    url = f"/datasets/{make_dataset(api)['id']}"
    tag = {"If-Match": api.get(f"{url}/corrections").headers["ETag"]}
    first = api.patch(f"{url}/corrections", json={"correct": [MOVED]}, headers=tag)
    assert first.status_code == 200
    second = api.patch(f"{url}/corrections", json={"correct": [REMOVED]}, headers=tag)
    assert "read it again" in problem(second, 412, "precondition_failed")
    tag = {"If-Match": first.headers["ETag"]}
    second = api.patch(f"{url}/corrections", json={"correct": [REMOVED]}, headers=tag)
    assert second.json()["count"] == 2


def test_what_is_no_correction_is_refused_by_its_field(api: TestClient) -> None:
    url = f"/datasets/{make_dataset(api, image_sizes=[[640, 480], None])['id']}/corrections"
    for change, pointer in (
        ({"frame": 6}, "/correct/0/frame"),
        ({"frame": -1}, "/correct/0/frame"),
        ({"view": 2}, "/correct/0/view"),
        ({"keypoint": 16}, "/correct/0/keypoint"),
        ({"view": 0, "position": [961.0, 0.0]}, "/correct/0/position"),
        ({"position": [1.0]}, "/correct/0/position"),
        ({"position": [1e9, 0.0]}, "/correct/0/position/0"),
        ({"note": "x"}, "/correct/0/note"),
    ):
        body = {"correct": [MOVED | change]}
        problem(api.patch(url, json=body), 422, "invalid_input", pointer)
    infinite = b'{"correct": [{"frame": 0, "view": 0, "keypoint": 0, "position": [1e999, 0]}]}'
    assert api.patch(url, content=infinite, headers=JSON).status_code in (400, 422)
    left_out = {"correct": [place(MOVED)]}
    problem(api.patch(url, json=left_out), 422, "invalid_input", "/correct/0/position")
    wrong = {"undo": [place(MOVED) | {"view": 2}]}
    problem(api.patch(url, json=wrong), 422, "invalid_input", "/undo/0/view")
    problem(api.patch(url, json={"correct": [MOVED] * 5001}), 422, "invalid_input", "/correct")
    assert api.get(url).json()["count"] == 0
    problem(api.get("/datasets/ds_none/corrections"), 404, "not_found")
    problem(api.patch("/datasets/ds_none/corrections", json={}), 404, "not_found")


def test_what_is_corrected_is_fitted_again_and_in_the_labels(live: Live) -> None:
    dataset = make_dataset(live.http, frames=30, view_names=["left", "right"])["id"]
    url = f"/datasets/{dataset}/corrections"
    state = live.http.patch(url, json={"correct": [MOVED, REMOVED]}).json()
    fit = live.finished(live.fit(dataset, steps=5, refine="off")["id"])
    assert fit["status"] == "succeeded", fit["error"]
    assert fit["corrections"] == state == live.get(f"/datasets/{dataset}")["corrections"]
    for images in ("all", "worth-labelling"):
        file = f"/fits/{fit['id']}/labels/file?format=coco&images={images}&most=1"
        answer = live.http.get(file)
        assert answer.status_code == 200, answer.text
        with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
            [name] = archive.namelist()
            content = json.loads(archive.read(name))
        names = {one["file_name"]: one["id"] for one in content["images"]}
        labels = {one["image_id"]: one for one in content["annotations"]}
        mine = labels[names["labeled-data/right/img0003.png"]]
        assert mine["keypoints"][6:9] == [*MOVED["position"], 2]
        assert mine["keypoint_weights"][2] == 1
        other = labels.get(names["labeled-data/left/img0004.png"])
        assert other is None or other["keypoints"][:3] == [0, 0, 0]
    later = live.http.patch(url, json={"undo": [place(REMOVED)]}).json()
    assert live.get(f"/fits/{fit['id']}")["corrections"] == state != later
