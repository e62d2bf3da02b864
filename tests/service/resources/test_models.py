"""Models: their figures, their weights out and in again."""

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import orjson
import pytest
from safetensors.numpy import load
from starlette.testclient import TestClient

from models.calibrating.result import CameraReport
from models.capture.metrics import pa_mpjpe, pck
from models.capture.synthetic import SyntheticCapture, synthetic_capture
from models.findings.finding import Finding
from models.settings.config import FitConfig
from models.training.trainer import fit
from service.realtime.engine import Engine
from service.settings import Settings
from store import models
from store.database import Store
from store.errors import NotFoundError
from tests.service.conftest import (
    BYTES,
    CONFIG,
    JSON,
    Live,
    frames_of,
    make_dataset,
    problem,
    to_npz,
)

FIXTURES = Path(__file__).parents[2] / "fixtures"


def lift(client: Any, model: str, capture: SyntheticCapture) -> Any:
    body = {"model": model, "frames": frames_of(capture.keypoints[:5])}
    return client.post("/lift", content=orjson.dumps(body), headers=JSON)


def test_a_fitted_model_is_described(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture
) -> None:
    found = live.get(f"/models/{fitted['model_id']}")
    assert found["fit_id"] == fitted["id"]
    assert found["dataset_id"] == fitted["dataset_id"]
    assert found["config"] == fitted["config"]
    assert [found[name] for name in ("frames", "views", "keypoints")] == [60, 3, 16]
    steps = [point["step"] for point in found["training_curve"]]
    assert steps == sorted(steps)
    assert steps[-1] == CONFIG["steps"]
    assert all(point["loss"] > 0 for point in found["training_curve"])

    url = f"/fits/{fitted['id']}/reconstruction?format=safetensors"
    arrays = load(live.http.get(url).content)
    accuracy = pa_mpjpe(arrays["points3d"], capture.points3d)
    assert found["pa_mpjpe"] == pytest.approx(accuracy.mean, rel=1e-6)
    assert found["pck"] == pytest.approx(pck(accuracy, 0.2), rel=1e-6)
    assert found["pck_threshold"] == 0.2
    assert 0 < found["pa_mpjpe"] < 1
    error = float(np.nanmean(arrays["reprojection_errors"]))
    assert found["reprojection_error"] == pytest.approx(error, rel=1e-4)
    assert found["frames_lifted"] == 60
    assert found["id"] in [item["id"] for item in live.get("/models")["items"]]


def found_cameras() -> CameraReport:
    """Return a view that rests, known without doubt, and a fisheye one that moves."""
    nan = np.nan
    return CameraReport(
        arrangement="mixed",
        reason="because",
        findings=(Finding.of("calibration_disagrees", views=[0]),),
        camera_models=("perspective", "fisheye"),
        focals=np.array([[900.0, 910.0], [300.0, 300.0]]),
        focal_sds=np.array([0.0, 4.0]),
        principal_points=np.array([[640.0, 512.0], [320.0, 240.0]]),
        principal_point_sds=np.zeros((2, 2)),
        distortions=np.zeros((2, 8)),
        distortion_sds=np.zeros((2, 2)),
        static=np.array([True, False]),
        rotations=np.stack((np.eye(3), np.full((3, 3), nan))),
        rotation_sds=np.array([0.1, nan]),
        translations=np.array([[0.0, 1.0, 2.0], [nan] * 3]),
        translation_sds=np.array([[0.1, 0.1, 0.2], [nan] * 3]),
        reprojection_errors=np.array([1.5, 2.5]),
        noise=1.2,
        handedness_certainty=0.75,
    )


def test_the_cameras_that_were_found(
    api: TestClient, weights: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = api.post("/models", content=weights, headers=BYTES).json()["id"]
    engine = api.app.state.engine  # type: ignore[attr-defined]
    monkeypatch.setattr(engine.models.get("default", model).prior, "cameras", found_cameras())
    found = api.get(f"/models/{model}/cameras").json()
    assert (found["model"], found["arrangement"], found["noise"]) == (model, "mixed", 1.2)
    assert found["handedness_certainty"] == 0.75
    assert found["reason"] == "because"
    (finding,) = found["findings"]
    assert (finding["code"], finding["views"]) == ("calibration_disagrees", [0])
    first, second = found["views"]
    assert [view["index"] for view in found["views"]] == [0, 1]
    assert (first["camera"], second["camera"]) == ("perspective", "fisheye")
    assert (first["focal"], first["focal_sd"]) == ([900.0, 910.0], 0.0)
    assert first["rotation"] == np.eye(3).tolist()
    assert (first["translation"], first["translation_sd"]) == ([0, 1, 2], [0.1, 0.1, 0.2])
    assert second["static"] is False
    assert second["rotation"] is second["rotation_sd"] is None
    assert second["translation"] is second["translation_sd"] is None
    assert second["reprojection_error"] == 2.5

    count = engine.models.get("default", model).prior.capture.views
    body = {"model": model, "frames": [[None, None]], "views": [0, count]}
    detail = problem(api.post("/lift", json=body), 422, "invalid_input", "/views")
    assert f"views of the fit, 0 to {count - 1}, got {count}" in detail


def test_without_refinement_no_cameras_are_found(live: Live, api: TestClient) -> None:
    dataset = make_dataset(live.http, frames=30)
    fit = live.finished(live.fit(dataset["id"], steps=5, refine="off")["id"])
    found = live.get(f"/models/{fit['model_id']}/cameras")
    assert (found["arrangement"], found["views"], found["noise"]) == ("unknown", [], None)
    assert "refine: off" in found["reason"]
    problem(api.get("/models/mdl_no/cameras"), 404, "not_found")


def test_one_view_does_not_determine_cameras(api: TestClient) -> None:
    seen = synthetic_capture(frames=20, views=1)
    config = FitConfig.model_validate(CONFIG | {"steps": 5, "refine": "full"})
    weights = fit(seen.keypoints, config).to_bytes()
    model = api.post("/models", content=weights, headers=BYTES).json()["id"]
    found = api.get(f"/models/{model}/cameras").json()
    assert (found["arrangement"], found["views"]) == ("unknown", [])
    assert "a single view" in found["reason"]


def test_the_cameras_of_a_capture_are_found(live: Live, capture: SyntheticCapture) -> None:
    """By the fit itself; they travel with the weights."""
    few = live.http.post(
        "/datasets", content=to_npz(keypoints=capture.keypoints[:20]), headers=BYTES
    )
    fit = live.finished(live.fit(few.json()["id"], cameras="auto")["id"])
    found = live.get(f"/models/{fit['model_id']}/cameras")
    assert found["arrangement"] in ("static", "moving", "mixed")
    assert found["reason"]
    assert found["noise"] > 0
    assert [view["index"] for view in found["views"]] == [0, 1, 2]
    for view in found["views"]:
        assert view["camera"] == "perspective"
        assert view["focal"][0] > 0
        assert view["focal_sd"] >= 0
        assert (view["rotation"] is None) is not view["static"]
    best = ("canonical", "room", "upright").index(found["frame_of_reference"])
    for frame, query in enumerate(("frame=canonical", "frame=room", "frame=room&up=auto")):
        asked = live.http.get(f"/fits/{fit['id']}/reconstruction?frames=:1&{query}")
        assert (asked.status_code == 200) is (frame <= best), asked.text
    weights = live.http.get(f"/models/{fit['model_id']}/weights").content
    copy = live.http.post("/models", content=weights, headers=BYTES).json()["id"]
    bare = "room" if best else "canonical"  # there are no frames to estimate up from
    assert live.get(f"/models/{copy}/cameras") == found | {
        "model": copy,
        "frame_of_reference": bare,
    }


def test_without_truth_there_is_no_error(live: Live) -> None:
    dataset = make_dataset(live.http, frames=30, name="no truth", skeleton={"edges": [[0, 1]]})
    fit = live.finished(live.fit(dataset["id"], steps=5, refine="off")["id"])
    found = live.get(f"/models/{fit['model_id']}")
    assert (found["pa_mpjpe"], found["pck"], found["pck_threshold"]) == (None, None, None)
    assert found["reprojection_error"] > 0
    assert found["skeleton"] == dataset["skeleton"]
    # The model outlives its dataset and its fit.
    assert live.http.delete(f"/datasets/{dataset['id']}").status_code == 204
    assert live.http.delete(f"/fits/{fit['id']}").status_code == 204
    found = live.get(f"/models/{fit['model_id']}")
    assert found["fit_id"] is None


def test_weights_travel(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture, api: TestClient
) -> None:
    weights = live.http.get(f"/models/{fitted['model_id']}/weights")
    assert weights.headers["content-type"] == "application/octet-stream"
    assert fitted["model_id"] in weights.headers["content-disposition"]
    described = live.get(f"/models/{fitted['model_id']}")
    assert described["weights_bytes"] < len(weights.content)

    answer = lift(live.http, fitted["model_id"], capture).json()["frames"]
    form = {
        "name": "travelled",
        "skeleton": orjson.dumps({"edges": [[0, 1], [1, 2]]}).decode(),
    }
    for response in (
        live.http.post("/models?name=travelled", content=weights.content, headers=BYTES),
        api.post("/models", data=form, files={"file": ("w.safetensors", weights.content)}),
    ):
        assert response.status_code == 201, response.text
        found = response.json()
        assert response.headers["Location"] == f"/models/{found['id']}"
        assert found["name"] == "travelled"
        own = {"id", "created_at", "name", "skeleton"}
        for field in described.keys() - own - {"fit_id", "dataset_id"}:
            assert found[field] == described[field], field
        assert found["fit_id"] is found["dataset_id"] is None
        client = api if found["skeleton"] else live.http
        assert lift(client, found["id"], capture).json()["frames"] == answer
        assert client.get(f"/models/{found['id']}").json() == found


def test_the_network_is_downloaded_as_onnx(
    api: TestClient, weights: bytes, capture: SyntheticCapture
) -> None:
    model = api.post("/models", content=weights, headers=BYTES).json()["id"]
    file = api.get(f"/models/{model}/network")
    assert f"{model}.onnx" in file.headers["content-disposition"]
    network = onnxruntime.InferenceSession(file.content)
    keypoints = capture.keypoints[:9].astype(np.float32)  # frame 7 lacks a view
    given = {"keypoints": keypoints, "confidence": np.ones(keypoints.shape[:3], np.float32)}
    (points,) = network.run(["points3d"], given)
    body = {"model": model, "frames": frames_of(keypoints), "refine": "off"}
    answer = api.post("/lift", content=orjson.dumps(body), headers=JSON).json()["frames"]
    np.testing.assert_allclose(points, [frame["points3d"] for frame in answer], atol=1e-4)

    noisy = (FIXTURES / "denoised.safetensors").read_bytes()
    model = api.post("/models", content=noisy, headers=BYTES).json()["id"]
    assert "denoising" in problem(api.get(f"/models/{model}/network"), 409, "conflict")
    problem(api.get("/models/mdl_none/network"), 404, "not_found")


LABELS = {"tags": ["pilot"], "metadata": {"subject": ["M7"]}}


def test_a_model_travels_with_all_that_is_known_of_it(
    live: Live, fitted: dict[str, Any], api: TestClient
) -> None:
    """It is named after the fit: an export has the present name."""
    url = f"/models/{fitted['model_id']}"
    named = live.http.patch(url, json={"name": "Maki 猕猴"} | LABELS).json()
    file = live.http.get(f"{url}/weights")
    made = api.post("/models", content=file.content, headers=BYTES).json()
    links = {"id", "created_at", "fit_id", "dataset_id"}
    assert {field for field in named if named[field] != made[field]} == links
    assert made["pa_mpjpe"] is not None
    assert made["version"] == fitted["version"] == version("fewview-server")
    assert (made["views"], made["frames"]) == (3, 60)
    again = api.get(f"/models/{made['id']}/weights")
    assert again.content == file.content
    assert again.headers["etag"] == file.headers["etag"]

    skeleton = {"keypoint_names": [f"k {p}" for p in range(16)], "edges": [[0, 15]]}
    form = {"skeleton": orjson.dumps(skeleton).decode()}
    drawn = api.post("/models", data=form, files={"file": ("w", file.content)}).json()
    assert (drawn["skeleton"], drawn["name"]) == (skeleton, named["name"])
    file = api.get(f"/models/{drawn['id']}/weights")
    made = live.http.post("/models", content=file.content, headers=BYTES).json()
    assert {field for field in drawn if drawn[field] != made[field]} == {"id", "created_at"}


def test_a_deleted_model_lifts_no_more(
    api: TestClient, weights: bytes, capture: SyntheticCapture
) -> None:
    model = api.post("/models", content=weights, headers=BYTES).json()["id"]
    assert lift(api, model, capture).status_code == 200  # and is warm from here on
    assert api.delete(f"/models/{model}").status_code == 204
    problem(lift(api, model, capture), 404, "not_found")
    for url in (f"/models/{model}", f"/models/{model}/weights"):
        problem(api.get(url), 404, "not_found")
    problem(api.delete(f"/models/{model}"), 404, "not_found")


def test_models_come_in_pages(api: TestClient, weights: bytes) -> None:
    made = [api.post("/models", content=weights, headers=BYTES).json()["id"] for _ in range(5)]
    cursor, seen = "", []
    while cursor is not None:
        page = api.get(f"/models?limit=2{cursor and f'&cursor={cursor}'}").json()
        seen += [item["id"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert len(seen) == len(set(seen))
    assert set(made) <= set(seen)


def test_warm_models_are_read_once_and_given_up_when_there_are_too_many(
    settings: Settings, api: TestClient, weights: bytes
) -> None:
    ids = [api.post("/models", content=weights, headers=BYTES).json()["id"] for _ in range(3)]
    store = Store(settings)
    engine = Engine(store, max_bytes=2 * len(weights))
    first = [engine.models.get("default", model).prior for model in ids[:2]]
    assert [engine.models.get("default", model).prior for model in ids[:2]] == first
    engine.models.get("default", ids[2])  # takes the place of the one not used for longest
    assert engine.models.get("default", ids[1]).prior is first[1]
    assert engine.models.get("default", ids[0]).prior is not first[0]
    models.delete(store, ids[1])  # by another process, say
    with pytest.raises(NotFoundError):
        engine.models.get("default", ids[1])
    engine.close()
    store.close()
