"""Labels of fits over HTTP: planted errors come first, files hold what the fit accepts."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import read
from starlette.testclient import TestClient

from models.capture.synthetic import KEYPOINT_NAMES
from service.settings import Settings
from tests.models.rigs import IMAGE_SIZE, Lens, around
from tests.models.walk import walk
from tests.service.conftest import BYTES, Live, make_dataset, problem, to_npz
from tests.service.resources.test_reconstructions import stored_fit

FRAMES, LATE = 120, 6
VIEWS = ["left", "right", "front", "late"]
# Of the late view's own frames, of the second view, and of the first: all see an odd pose.
BURST, BLIND, ODD = range(40, 46), range(80, 90), 70


def uploaded(live: Live, keypoints: Any) -> str:
    body = to_npz(
        keypoints=keypoints.astype(np.float32),
        keypoint_names=np.array(KEYPOINT_NAMES),
        view_names=np.array(VIEWS),
        image_sizes=np.array([IMAGE_SIZE] * 4),
        fps=30.0,
    )
    answer = live.http.post("/datasets", content=body, headers=BYTES)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def fitted(live: Live, keypoints: Any) -> str:
    fit = live.finished(live.fit(uploaded(live, keypoints), cameras="static")["id"])
    assert fit["status"] == "succeeded", fit["error"]
    return str(fit["id"])


def filmed(odd: int) -> Any:
    """Return keypoints (N, K, P, 2) of somebody who sways, and is squashed in one frame."""
    moments = np.arange(-LATE, FRAMES)
    # Poses come again, but sooner: of a movement that repeats, a period earlier may be as true.
    cycles = moments / 66 + (moments / 240) ** 2
    points = walk(60 + 20 * np.sin(2 * np.pi * cycles))
    points[odd + LATE] *= [1.0, 0.5, 1.0]
    seen = []
    for view, (turn, shift) in enumerate(zip(*around([0, 70, 160, -100]), strict=True)):
        shown = points[:-LATE] if view == 3 else points[LATE:]
        seen.append(Lens().project(shown @ turn.T + shift))
    pixels = np.stack(seen, axis=1)
    return pixels + np.random.default_rng(0).standard_normal(pixels.shape)


@pytest.fixture(scope="module")
def right() -> Any:
    """Return what the planted film would have been without errors."""
    return filmed(ODD)


@pytest.fixture(scope="module")
def planted(live: Live, right: Any) -> str:
    """Fit a film with a wrong keypoint in the late view, a view that sees nobody, an odd pose."""
    keypoints = right.copy()
    keypoints[list(BURST), 3, 12] += [40.0, 0.0]
    keypoints[list(BLIND), 1] = np.nan
    return fitted(live, keypoints)


def test_planted_errors_come_first_and_once(live: Live, planted: str) -> None:
    found = live.get(f"/fits/{planted}/labels")
    blind, burst, odd, *others = found["images"]
    if odd["view"] == 3:
        burst, odd = odd, burst
    assert (blind["view"], blind["view_name"]) == (1, "right")
    assert blind["frame"] in BLIND
    assert blind["moment"] == blind["frame"]
    assert {reason["code"] for reason in blind["reasons"]} == {"missed"}
    assert (burst["view"], burst["view_name"]) == (3, "late")
    assert burst["frame"] in BURST
    assert abs(burst["moment"] + LATE - burst["frame"]) <= 1
    [wrong] = [r for r in burst["reasons"] if r["code"] in ("outlier", "disagreement")]
    assert wrong["keypoints"] == [12]
    assert wrong["evidence"]["error_px"] == pytest.approx(40, abs=12)
    assert odd["moment"] == ODD
    assert "unlike_fit" in [reason["code"] for reason in odd["reasons"]]
    assert all(image["score"] <= 1.5 for image in others)
    assert len(others) < 8
    assert found["candidates"] >= len(BURST) + len(BLIND)
    assert all(0.5 < noise < 2 for noise in found["noise_px"])
    assert live.get(f"/fits/{planted}/labels?limit=1")["images"] == [blind]


def unpacked(live: Live, fit: str, query: str, folder: Path) -> list[Path]:
    answer = live.http.get(f"/fits/{fit}/labels/file?{query}")
    assert answer.status_code == 200, answer.text
    assert f"{fit}-labels-" in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        archive.extractall(folder)
        return [folder / name for name in archive.namelist()]


def test_files_have_the_images_that_are_listed_put_right(
    live: Live, planted: str, right: Any, tmp_path: Path
) -> None:
    listed = live.get(f"/fits/{planted}/labels?limit=2")["images"]
    files = unpacked(live, planted, "format=coco&most=2", tmp_path)
    content = json.loads(files[0].read_text())
    names = {f"labeled-data/{one['view_name']}/img{one['frame']:04}.png" for one in listed}
    assert {image["file_name"] for image in content["images"]} == names
    for image, one in zip(content["images"], content["annotations"], strict=True):
        _, view, name = image["file_name"].split("/")
        labels = np.array(one["keypoints"]).reshape(-1, 3)
        true = right[int(name[3:7]), VIEWS.index(view)]
        there = labels[:, 2] > 0
        assert there.mean() > 0.9
        assert np.linalg.norm(labels[there, :2] - true[there], axis=-1).max() < 12
        assert (np.array(one["keypoint_weights"])[there] > 0).all()
        # What only the others saw is visible in no other sense.
        assert set(labels[there, 2]) == ({1} if view == "right" else {1, 2})


@pytest.mark.parametrize(("format", "suffix"), [("dlc", ".h5"), ("dlc", ".csv")])
@pytest.mark.parametrize("source", ["keypoints", "reprojections"])
def test_all_that_is_accepted_trains_a_detector(
    live: Live, planted: str, right: Any, tmp_path: Path, format: str, suffix: str, source: str
) -> None:
    query = f"format={format}&images=all&source={source}&scorer=anna"
    files = unpacked(live, planted, query, tmp_path)
    mine = [file for file in files if file.suffix == suffix]
    assert {file.name for file in files} == {"CollectedData_anna.csv", "CollectedData_anna.h5"}
    capture = read(mine)
    assert capture.view_names is not None
    order = [capture.view_names.index(name) for name in VIEWS]
    assert capture.keypoint_names == KEYPOINT_NAMES
    numbers = np.arange(len(capture.keypoints)) if capture.numbers is None else capture.numbers
    off = np.linalg.norm(capture.keypoints[:, order] - right[numbers], axis=-1)
    assert np.isfinite(off).mean() > 0.85
    assert np.nanquantile(off, 0.99) < (5 if source == "reprojections" else 0.01)
    assert np.isnan(off[list(BLIND), 1]).all() == (source == "keypoints")


def test_machine_labels_have_weights_and_lightning_pose_the_same_moments(
    live: Live, planted: str, tmp_path: Path
) -> None:
    files = unpacked(live, planted, "format=dlc-machine&images=all&most=10", tmp_path / "dlc")
    assert {file.name for file in files} == {"machinelabels.csv", "machinelabels-iter0.h5"}
    capture = read([file for file in files if file.suffix == ".h5"])
    assert capture.confidence is not None
    assert ((capture.confidence > 0) == np.isfinite(capture.keypoints[..., 0])).all()
    assert (np.isfinite(capture.keypoints).any((2, 3)).sum(0) == 10).all()
    sure = unpacked(
        live, planted, "format=dlc-machine&images=all&most=10&least_weight=0.8", tmp_path / "sure"
    )
    weights = read([file for file in sure if file.suffix == ".h5"]).confidence
    assert weights is not None
    assert weights[weights > 0].min() >= 0.8
    files = unpacked(live, planted, "format=lightning-pose&most=2", tmp_path / "lightning")
    assert [file.name for file in files] == [f"CollectedData_{name}.csv" for name in VIEWS]
    rows = [[line.split(",")[0] for line in file.read_text().splitlines()[3:]] for file in files]
    frames = [[int(row[-8:-4]) for row in of_view] for of_view in rows]
    assert frames[0] == frames[1] == frames[2]
    assert [frame - LATE for frame in frames[3]] == frames[0]


def test_what_is_asked_wrongly_is_refused(live: Live, planted: str) -> None:
    url = f"/fits/{planted}/labels"
    problem(live.http.get(f"{url}/file"), 422, "invalid_input", "/format")
    problem(live.http.get(f"{url}/file?format=sleap"), 422, "invalid_input", "/format")
    problem(live.http.get(f"{url}/file?format=dlc&source=all"), 422, "invalid_input", "/source")
    problem(live.http.get(f"{url}/file?format=dlc&scorer=../a"), 422, "invalid_input", "/scorer")
    problem(live.http.get(f"{url}?limit=501"), 422, "invalid_input", "/limit")
    problem(live.http.get(f"{url}?limit=0"), 422, "invalid_input", "/limit")
    problem(live.http.get("/fits/fit_none/labels"), 404, "not_found")


def test_a_fit_that_has_not_succeeded_or_lost_its_dataset_has_none(live: Live) -> None:
    dataset = make_dataset(live.http, frames=2)  # of which none is unlike the others
    fit = live.fit(dataset["id"], steps=5, refine="off")["id"]
    live.finished(fit)
    assert live.get(f"/fits/{fit}/labels")["images"] == []
    url = f"/fits/{fit}/labels/file?format=coco"
    assert "images=all" in problem(live.http.get(url), 422, "invalid_input", "/images")
    assert live.http.delete(f"/datasets/{dataset['id']}").status_code == 204
    assert dataset["id"] in problem(live.http.get(f"/fits/{fit}/labels"), 404, "not_found")


def test_a_fit_in_the_queue_has_no_labels(api: TestClient) -> None:
    body = {"dataset_id": make_dataset(api)["id"]}
    fit = api.post("/fits", json=body).json()["id"]
    problem(api.get(f"/fits/{fit}/labels"), 409, "conflict")
    problem(api.get(f"/fits/{fit}/labels/file?format=dlc"), 409, "conflict")


def test_a_very_long_fit_is_refused(api: TestClient, settings: Settings) -> None:
    fit = stored_fit(settings, make_dataset(api), b"", frames=2_000_000 // 32 + 1)
    detail = problem(api.get(f"/fits/{fit}/labels"), 422, "invalid_input", "/fit_id")
    assert "2000000 keypoints at most" in detail
