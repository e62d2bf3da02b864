"""POST /evaluations: figures of structures and cameras that are known beforehand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import Client
from fewview.calibration import Camera, write_cameras
from fewview.evaluation import evaluate
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture, synthetic_capture
from tests.service.conftest import Live, frames_of, make_dataset, problem


def figures(client: Any, **asked: Any) -> dict[str, Any]:
    response = client.post("/evaluations", json=asked)
    assert response.status_code == 200, response.text
    found: dict[str, Any] = response.json()
    return found


def lists(points: np.ndarray[Any, Any]) -> list[Any]:
    return [
        [None if np.isnan(point).any() else point.tolist() for point in frame] for frame in points
    ]


def test_points_that_are_sent_are_measured(api: TestClient) -> None:
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((20, 9, 3))
    points = truth + 0.1 * rng.standard_normal(truth.shape)
    points[rng.random(points.shape[:2]) < 0.1] = np.nan
    answer = figures(api, points=lists(points), truth=lists(truth), reach=0.5)
    expected = evaluate(points, truth, reach=0.5).plain()
    assert answer.keys() == expected.keys() | {"keypoint_names", "cameras", "triangulation"}
    for name, value in expected.items():
        if isinstance(value, list):
            np.testing.assert_allclose(answer[name], value, rtol=1e-4)
        else:
            assert answer[name] == pytest.approx(value, rel=1e-4), name
    assert (answer["keypoint_names"], answer["cameras"], answer["triangulation"]) == (
        None,
        None,
        None,
    )

    mirrored = figures(api, points=lists(-points), truth=lists(truth))
    assert not mirrored["mirrored"]
    assert mirrored["pa_mpjpe"] > 3 * answer["pa_mpjpe"]
    forgiven = figures(api, points=lists(-points), truth=lists(truth), mirrored_too=True)
    assert forgiven["mirrored"]
    assert forgiven["pa_mpjpe"] == pytest.approx(answer["pa_mpjpe"])


def test_what_cannot_be_measured_is_refused(api: TestClient) -> None:
    some = np.random.default_rng(0).standard_normal((2, 4, 3)).tolist()
    dataset = make_dataset(api, frames=2)["id"]
    for asked, pointer in (
        ({}, "/fit_id"),
        ({"points": some, "fit_id": "fit_a"}, "/fit_id"),
        ({"points": some}, "/truth"),
        ({"points": some, "dataset_id": dataset}, "/truth"),
        ({"points": some, "truth": some[:1]}, "/points"),
        ({"points": [[[0, 0]]], "truth": some}, "/points"),
        ({"points": some, "truth": [[None] * 4] * 2}, "/points"),
        ({"points": some, "truth": some, "reach": 0}, "/reach"),
        ({"points": some, "truth": some, "triangulate": "found"}, "/triangulate"),
        ({"points": [some[0]] * 401, "truth": [some[0]] * 401}, "/truth"),
    ):
        problem(api.post("/evaluations", json=asked), 422, "invalid_input", pointer)
    for asked in ({"fit_id": "fit_none"}, {"points": some, "dataset_id": "ds_none"}):
        problem(api.post("/evaluations", json=asked), 404, "not_found")


def test_a_dataset_of_too_many_frames_is_compared_in_parts(api: TestClient) -> None:
    made = make_dataset(api, frames=201)["id"]
    more = {"keypoints": frames_of(synthetic_capture(frames=200, views=2, seed=1).keypoints)}
    assert api.post(f"/datasets/{made}/frames", json=more).status_code == 200
    asked = {"points": [[[0, 0, 0]] * 16] * 2, "dataset_id": made}
    refused = api.post("/evaluations", json=asked)
    assert "400 frames at most, got 401" in problem(refused, 422, "invalid_input", "/dataset_id")


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_known_cameras_triangulate_beside_it(api: TestClient, model: str) -> None:
    lens = {"model": model, "fx": 1000.0, "cx": 640.0, "cy": 512.0}
    turns = [np.eye(3), np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])]
    rng = np.random.default_rng(2)
    truth = rng.uniform(-1, 1, (6, 7, 3))
    seen = np.stack([truth @ turn.T + (0, 0, 5) for turn in turns], 1)
    directions = seen[..., :2] / seen[..., 2:]
    radii = np.linalg.norm(directions, axis=-1, keepdims=True)
    bent = np.arctan(radii) / radii if model == "fisheye" else 1  # Kannala and Brandt, equidistant
    pixels = 1000 * bent * directions + (640, 512)
    confidence = np.ones(pixels.shape[:3])
    pixels[2, 0, 3], confidence[2, 0, 3] = 0, 0  # as detectors write what they did not see
    body = {"keypoints": frames_of(pixels), "points3d": truth.tolist()}
    body["confidence"] = confidence.tolist()
    made = api.post("/datasets", json=body).json()["id"]
    cameras: list[dict[str, Any]] = [
        {"intrinsics": lens, "rotation": turn.tolist(), "translation": [0, 0, 5]} for turn in turns
    ]
    asked = {"points": (truth + 0.2).tolist(), "dataset_id": made, "calibration": cameras}
    answer = figures(api, **asked, triangulate="calibration")
    assert answer["triangulation"]["mpjpe"] < 1e-3
    assert answer["triangulation"]["auc"] > 0.98
    assert answer["mpjpe"] == pytest.approx(0, abs=1e-4)  # a shift is no error
    for broken in (cameras[:1], [cameras[0], {"intrinsics": {"fx": 1000.0}}], [None, None]):
        refused = api.post(
            "/evaluations", json=asked | {"calibration": broken, "triangulate": "calibration"}
        )
        assert refused.status_code == 422, refused.text


def test_a_fit_is_measured_against_its_dataset(
    live: Live, fitted: dict[str, Any], capture: SyntheticCapture, tmp_path: Path
) -> None:
    model = live.get(f"/models/{fitted['model_id']}")
    answer = figures(live.http, fit_id=fitted["id"], mirrored_too=True, reach=0.2)
    assert answer["pa_mpjpe"] == pytest.approx(model["pa_mpjpe"], rel=1e-4)
    assert answer["pck"][-1] == pytest.approx(model["pck"], abs=1e-3)
    assert answer["frames"] == len(capture.keypoints)
    assert len(answer["per_keypoint"]) == capture.keypoints.shape[2]
    lens = {"intrinsics": {"fx": 1000.0, "cx": 640.0, "cy": 512.0}}
    with Client(live.url) as client:
        compared = client.evaluations.create(fitted["id"], calibration=[lens] * 3)["cameras"]
        file = write_cameras(
            tmp_path / "rig.yml",
            [
                Camera(f"c{v}", np.array([[1000, 0, 640], [0, 1000, 512], [0, 0, 1]]))
                for v in range(3)
            ],
        )
        by_file = client.evaluations.create(fitted["id"], calibration=file)["cameras"]
        points = client.fits.reconstruction(fitted["id"]).points3d.copy()
        points[3, 2] = np.nan
        sent = client.evaluations.create(points=points, truth=capture.points3d)
    found = live.get(f"/models/{model['id']}/cameras")["views"]
    for view, camera in zip(found, compared, strict=True):
        assert camera["focal"] == pytest.approx([focal / 10 - 100 for focal in view["focal"]])
        assert camera["rotation"] is None
    assert by_file == compared
    assert sent["per_keypoint"] == pytest.approx(answer["per_keypoint"], rel=0.2)
    other = synthetic_capture(frames=4, views=3, seed=8)
    wrong = {"fit_id": fitted["id"], "truth": other.points3d.tolist()}
    problem(live.http.post("/evaluations", json=wrong), 422, "invalid_input", "/truth")
