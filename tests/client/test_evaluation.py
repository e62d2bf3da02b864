"""Errors against a ground truth: those of the service, and such as are known beforehand."""

import json
from dataclasses import replace
from pathlib import Path

import fewview
import numpy as np
import pytest
from fewview import Animation
from fewview.calibration import Camera, rotation_matrix, write_cameras
from fewview.evaluation import evaluate
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.capture.metrics import pa_mpjpe
from tests.client.test_cli import run

Float64 = NDArray[np.float64]


@pytest.fixture
def truth() -> Float64:
    rng = np.random.default_rng(0)
    return rng.standard_normal((30, 9, 3)) + np.linspace(0, 5, 30)[:, None, None]


def moved(points: Float64) -> Float64:
    turn = Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
    return np.asarray(2.5 * points @ turn.T + [3.0, -1, 2], np.float64)


def test_a_similarity_is_no_error_and_a_mirror_image_is(truth: Float64) -> None:
    same = evaluate(moved(truth), truth)
    assert same.pa_mpjpe == pytest.approx(0, abs=1e-9)
    assert same.mpjpe == pytest.approx(0, abs=1e-9)
    assert same.pck[1:].min() == 1
    assert same.auc > 0.98
    mirrored = evaluate(-moved(truth), truth)
    assert mirrored.pa_mpjpe > 0.1
    forgiven = evaluate(-moved(truth), truth, mirrored_too=True)
    assert forgiven.mirrored
    assert forgiven.pa_mpjpe == pytest.approx(0, abs=1e-9)


def test_frames_in_axes_of_their_own_have_no_room(truth: Float64) -> None:
    turns = Rotation.random(len(truth), random_state=1).as_matrix()
    canonical = (truth - truth.mean(1, keepdims=True)) @ turns.mT
    found = evaluate(canonical, truth)
    assert found.pa_mpjpe == pytest.approx(0, abs=1e-9)
    assert found.mpjpe > 0.5


def test_errors_are_those_of_the_service(truth: Float64) -> None:
    rng = np.random.default_rng(1)
    points = moved(truth + 0.1 * rng.standard_normal(truth.shape))
    points[rng.random(points.shape[:2]) < 0.2] = np.nan
    truth[4] = np.nan
    for forgive in (False, True):
        found = evaluate(points, truth, mirrored_too=forgive)
        expected = pa_mpjpe(points, truth, reflection="either" if forgive else "never")
        assert found.pa_mpjpe == pytest.approx(expected.mean, rel=1e-9)
        np.testing.assert_allclose(found.per_frame, expected.per_frame, rtol=1e-9)
    assert found.frames == 29


def test_what_cannot_be_compared_is_refused(truth: Float64) -> None:
    with pytest.raises(ValueError, match="one shape"):
        evaluate(truth[:5], truth)
    with pytest.raises(ValueError, match="three keypoints"):
        evaluate(truth * np.nan, truth)


def test_the_command(truth: Float64, tmp_path: Path) -> None:
    np.savez(
        tmp_path / "found.npz", points=moved(truth), keypoint_names=[f"k{p}" for p in range(9)]
    )
    np.savez(tmp_path / "truth.npz", points3d=truth)
    files = (str(tmp_path / "found.npz"), str(tmp_path / "truth.npz"))
    answer = json.loads(run("evaluate", *files, "--json", "--reach", "0.5").stdout)
    assert answer["pa_mpjpe"] == pytest.approx(0, abs=1e-9)
    assert answer["keypoint_names"][8] == "k8"
    assert answer["thresholds"][-1] == 0.5
    assert "PA-MPJPE" in run("evaluate", *files).stdout
    lens = np.array([[1000.0, 0, 640], [0, 1000, 512], [0, 0, 1]])
    cameras = [
        Camera(
            name, lens, np.zeros(5), rotation_matrix([0, angle, 0]), np.array([0, 0, 4.0]), (9, 9)
        )
        for name, angle in (("left", 0.0), ("right", 1.0))
    ]
    expected = write_cameras(tmp_path / "truth.toml", cameras)
    longer = replace(cameras[1], matrix=lens * [[1.02], [1.02], [1]], name="Right")
    measured = write_cameras(tmp_path / "found.yml", [longer, cameras[0]])
    words = ("evaluate", str(measured), "--cameras", str(expected))
    assert "+2.00 +2.00 %" in run(*words).stdout
    one, other = json.loads(run(*words, "--json").stdout)["cameras"]
    assert (one["name"], other["name"]) == ("right", "left")  # matched by their names
    assert one["focal"] == pytest.approx([2, 2])
    assert one["rotation"] == pytest.approx(0, abs=1e-6)
    assert "--cameras" in run("evaluate", files[0]).stderr
    written = fewview.write(tmp_path / "found.safetensors", Animation(moved(truth)))
    again = json.loads(run("evaluate", str(written), files[1], "--json").stdout)
    assert again["pa_mpjpe"] == pytest.approx(0, abs=1e-9)
    (tmp_path / "broken.safetensors").write_bytes(written.read_bytes()[:60])
    for name in ("none.npz", "broken.safetensors"):
        refused = run("evaluate", files[0], str(tmp_path / name))
        assert refused.returncode == 2
        assert refused.stderr.count("\n") == 1
