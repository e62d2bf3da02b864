"""Animations of fits: what other tools read is what the reconstruction has."""

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pygltflib
import pytest
from numpy.typing import NDArray
from starlette.testclient import TestClient

from models.capture.synthetic import synthetic_capture
from service.settings import Settings
from tests.service.conftest import BYTES, Live, make_dataset, problem, to_npz
from tests.service.resources.test_reconstructions import stored_fit

NAMES = [f"point {index}" for index in range(16)]
TIMES = np.arange(40) / 25 + 2


@pytest.fixture(scope="module")
def fit(live: Live) -> dict[str, Any]:
    """Fit a capture that has names, edges and times, and of which a keypoint was never seen."""
    seen = synthetic_capture(frames=40, views=2, noise=1.0, seed=3)
    seen.keypoints[:, :, 15] = np.nan
    body = to_npz(
        keypoints=seen.keypoints,
        keypoint_names=np.array(NAMES),
        edges=np.array([[n, n + 1] for n in range(15)]),
        times=TIMES,
    )
    dataset = live.http.post("/datasets", content=body, headers=BYTES).json()
    return live.finished(live.fit(dataset["id"])["id"])


@pytest.fixture(scope="module")
def points(live: Live, fit: dict[str, Any]) -> NDArray[np.float64]:
    frames = live.get(f"/fits/{fit['id']}/reconstruction")["frames"]
    nothing = [np.nan] * 3
    return np.array([[point or nothing for point in frame["points3d"]] for frame in frames])


def downloaded(live: Live, fit: dict[str, Any], query: str) -> bytes:
    answer = live.http.get(f"/fits/{fit['id']}/animation?{query}")
    assert answer.status_code == 200, answer.text
    suffix = query.partition("format=")[2].partition("&")[0].replace("csv-tidy", "tidy.csv")
    assert f'filename="{fit["id"]}.{suffix}"' in answer.headers["content-disposition"]
    return answer.content


def test_trc_has_points_names_times_and_the_unit(
    live: Live, fit: dict[str, Any], points: NDArray[np.float64]
) -> None:
    lines = downloaded(live, fit, "format=trc&unit=m").decode().split("\n")
    assert lines[2].split("\t")[4] == "m"
    assert lines[3].split("\t")[2::3][:16] == NAMES
    rows = np.array([[float(text) for text in line.split("\t")] for line in lines[6:] if line])
    np.testing.assert_allclose(rows[:, 1], TIMES, atol=1e-6)
    np.testing.assert_allclose(rows[:, 2:].reshape(40, 16, 3), points, atol=1e-5)
    assert np.isnan(points[:, 15]).all()


def test_some_frames_are_written_with_their_times(
    live: Live, fit: dict[str, Any], points: NDArray[np.float64]
) -> None:
    part = downloaded(live, fit, "format=trc&unit=m&frames=10:20:2").decode().split("\n")
    rows = np.array([[float(text) for text in line.split("\t")] for line in part[6:] if line])
    np.testing.assert_allclose(rows[:, 1], TIMES[10:20:2], atol=1e-6)
    np.testing.assert_allclose(rows[:, 2:].reshape(5, 16, 3), points[10:20:2], atol=1e-5)
    none = live.http.get(f"/fits/{fit['id']}/animation?format=csv&frames=40:")
    problem(none, 422, "invalid_input", "/frames")


def test_c3d_glb_bvh_and_csv_are_files_of_their_kind(
    live: Live, fit: dict[str, Any], points: NDArray[np.float64], tmp_path: Path
) -> None:
    file = tmp_path / "animation.c3d"
    file.write_bytes(downloaded(live, fit, "format=c3d&unit=mm"))
    found = ezc3d.c3d(str(file))
    assert found["parameters"]["POINT"]["LABELS"]["value"] == NAMES
    stored = found["data"]["points"][:3, :15].transpose(2, 1, 0)
    np.testing.assert_allclose(stored, points[:, :15], atol=1e-5)
    scene = pygltflib.GLTF2.load_from_bytes(downloaded(live, fit, "format=glb"))
    assert scene.animations
    assert downloaded(live, fit, "format=bvh").startswith(b"HIERARCHY")
    header, *rows = downloaded(live, fit, "format=csv").decode().splitlines()
    assert len(rows) == 40
    frames = live.get(f"/fits/{fit['id']}/reconstruction")["frames"]
    sds = np.array([np.array(frame["points3d_sd"], np.float64)[0] for frame in frames])
    place = header.split(",").index("point 0_sd")
    written = np.array([float(row.split(",")[place] or "nan") for row in rows])
    np.testing.assert_allclose(written, sds, rtol=1e-6)
    residuals = found["data"]["meta_points"]["residuals"]
    assert residuals.shape == (1, 16, 40)
    assert len(downloaded(live, fit, "format=csv-tidy").decode().splitlines()) > 40 * 15


def test_what_cannot_be_written_says_why(live: Live, fit: dict[str, Any]) -> None:
    url = f"/fits/{fit['id']}/animation"
    assert "give unit=m" in problem(
        live.http.get(f"{url}?format=trc"), 422, "invalid_input", "/unit"
    )
    problem(live.http.get(url), 422, "invalid_input", "/format")
    problem(live.http.get(f"{url}?format=fbx"), 422, "invalid_input", "/format")
    problem(live.http.get(f"{url}?format=csv&up=auto"), 422, "invalid_input", "/up")
    moving = problem(live.http.get(f"{url}?format=csv&frame=room"), 409, "conflict")
    assert "room" in moving
    problem(live.http.get("/fits/fit_none/animation?format=csv"), 404, "not_found")


def test_a_very_long_fit_is_written_in_parts(api: TestClient, settings: Settings) -> None:
    fit = stored_fit(settings, make_dataset(api), b"", frames=3_000_000 // 16 + 1)
    detail = problem(api.get(f"/fits/{fit}/animation?format=csv"), 422, "invalid_input", "/frames")
    assert "3000000 points at most" in detail


def test_a_fit_whose_dataset_was_deleted_has_no_times(live: Live) -> None:
    seen = synthetic_capture(frames=40, views=2, noise=1.0, seed=3)
    body = to_npz(keypoints=seen.keypoints, edges=np.array([[0, 1]]), fps=50.0)
    dataset = live.http.post("/datasets", content=body, headers=BYTES).json()
    fit = live.finished(live.fit(dataset["id"])["id"])
    assert downloaded(live, fit, "format=trc&unit=m").split()[12] == b"50"
    assert live.http.delete(f"/datasets/{dataset['id']}").status_code == 204
    assert downloaded(live, fit, "format=trc&unit=m").split()[12] == b"30"
    refused = live.http.get(f"/fits/{fit['id']}/animation?format=bvh")
    assert "edges" in problem(refused, 422, "invalid_input", "/format")
