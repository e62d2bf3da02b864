"""Cameras of a model as files of other tools: the capture is the calibration."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview.calibration import read_cameras

from tests.models.rigs import IMAGE_SIZE, RigCapture, make_rig_capture
from tests.service.conftest import BYTES, Live, make_dataset, problem, to_npz


@pytest.fixture(scope="module")
def rig() -> RigCapture:
    return make_rig_capture([0.0, 80.0, -120.0], frames=40, seed=3)


@pytest.fixture(scope="module")
def model(live: Live, rig: RigCapture) -> str:
    arrays = {"keypoints": rig.keypoints.astype(np.float32), "image_sizes": [IMAGE_SIZE] * 3}
    body = to_npz(**arrays, view_names=["left 1", "right", "top"])
    dataset = live.http.post("/datasets", content=body, headers=BYTES).json()
    fit = live.finished(live.fit(dataset["id"], cameras="static", steps=30)["id"])
    assert fit["status"] == "succeeded", fit["error"]
    return str(fit["model_id"])


@pytest.mark.parametrize(
    ("kind", "media_type", "name"),
    [
        ("anipose", "application/toml", "cameras.toml"),
        ("opencv", "application/yaml", "cameras.yml"),
        ("colmap", "application/zip", "colmap"),
    ],
)
def test_files_mean_what_json_means(
    live: Live, model: str, tmp_path: Path, kind: str, media_type: str, name: str
) -> None:
    fields: list[dict[str, Any]] = live.get(f"/models/{model}/cameras")["views"]
    answer = live.http.get(f"/models/{model}/cameras?format={kind}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == media_type
    assert model in answer.headers["content-disposition"]
    target = tmp_path / name
    if kind == "colmap":
        with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
            archive.extractall(target)
    else:
        target.write_bytes(answer.content)
    found = read_cameras(target, kind)
    first = "left_1" if kind == "colmap" else "left 1"  # COLMAP knows no blanks
    assert [camera.name for camera in found] == [first, "right", "top"]
    points = np.random.default_rng(0).standard_normal((20, 3))
    for camera, view in zip(found, fields, strict=True):
        assert camera.size == IMAGE_SIZE
        np.testing.assert_allclose(camera.matrix[[0, 1], [0, 1]], view["focal"], rtol=1e-9)
        np.testing.assert_allclose(camera.matrix[:2, 2], view["principal_point"], rtol=1e-9)
        in_camera = points @ np.array(view["rotation"]).T + view["translation"]
        assert camera.rotation is not None
        assert camera.translation is not None
        placed = points @ camera.rotation.T + camera.translation
        np.testing.assert_allclose(placed, in_camera, atol=1e-6)


def test_what_a_format_cannot_say_is_refused(live: Live, model: str) -> None:
    weights = live.http.get(f"/models/{model}/weights").content
    imported = live.http.post("/models", content=weights, headers=BYTES).json()["id"]
    refused = live.http.get(f"/models/{imported}/cameras?format=anipose")
    assert "image size" in problem(refused, 409, "conflict")
    assert live.http.get(f"/models/{imported}/cameras?format=opencv").status_code == 200
    dataset = make_dataset(live.http, frames=30)
    fit = live.finished(live.fit(dataset["id"], steps=5, refine="off")["id"])
    refused = live.http.get(f"/models/{fit['model_id']}/cameras?format=opencv")
    problem(refused, 409, "conflict")
    problem(live.http.get(f"/models/{model}/cameras?format=obj"), 422, "invalid_input")
