"""The programs in examples/ that speak to a stream, and those that project lifts into images.

Each is there in Python, C++ and TypeScript; the C++ is compiled where there is a g++.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import httpx2
import numpy as np
import orjson
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save

from models.capture.synthetic import SyntheticCapture
from tests.node import NODE
from tests.service.conftest import BYTES, JSON, frames_of
from tests.service.realtime.conftest import as_bytes, lifted, started

EXAMPLES = Path(__file__).parents[3] / "examples"
FIXTURES = Path(__file__).parents[2] / "fixtures"
BENT = (-0.1, 0.02, 0.003, -0.002, -0.004, 0.01, 0.02, 0.005)  # of OpenCV's 8 coefficients, all
every_language = pytest.mark.parametrize("language", ["py", "cpp", "ts"])


def printed_by(name: str, language: str, folder: Path, data: bytes, *arguments: str) -> str:
    """Run an example and return what it prints."""
    source = EXAMPLES / f"{name}.{language}"
    command = {"py": [sys.executable, str(source)], "ts": [NODE, str(source)]}.get(language)
    if command is None:
        if shutil.which("g++") is None:
            pytest.skip("there is no g++ on this machine")
        command = [str(folder / name)]
        flags = ("-std=c++17", "-Wall", "-Wextra", "-Werror")
        subprocess.run(["g++", *flags, str(source), "-o", *command], check=True)
    done = subprocess.run(
        [*command, *arguments], input=data, capture_output=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode()


@every_language
def test_a_capture_loop_gets_what_lifts_return(
    http: httpx2.Client,
    model: str,
    capture: SyntheticCapture,
    language: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = np.ascontiguousarray(capture.keypoints[:12], np.float32)
    expected = [frame["points3d"] for frame in lifted(http, model, frames)]
    host, port = http.base_url.host, str(http.base_url.port)
    arguments, data = [model, "3", "16"], frames.tobytes()
    if language == "py":
        monkeypatch.setenv("FEWVIEW_URL", str(http.base_url))
        np.save(tmp_path / "keypoints.npy", frames)
        arguments, data = [model], (tmp_path / "keypoints.npy").read_bytes()
    before = [f"ws://{host}:{port}/lift/stream"] if language == "ts" else [host, port]
    arguments = arguments if language == "py" else before + arguments
    lines = printed_by("stream", language, tmp_path, data, *arguments).splitlines()
    assert len((EXAMPLES / f"stream.{language}").read_text().splitlines()) < 60
    assert len(lines) == len(frames)
    for n, line in enumerate(lines):
        sequence, *points = line.split()
        assert int(sequence) == n
        np.testing.assert_allclose(
            np.array(points, float).reshape(-1, 3), expected[n], rtol=1e-3, atol=1e-4
        )


@pytest.fixture(scope="module")
def bent(http: httpx2.Client) -> str:
    """Import a model whose first view is a fisheye, and whose second has 8 coefficients."""
    file = FIXTURES / "fisheye.safetensors"
    with safe_open(file, "np") as opened:
        about = opened.metadata()
    arrays = load_file(file)
    arrays["cameras.distortion"][1] = BENT
    weights = save(arrays, about)
    return str(http.post("/models", content=weights, headers=BYTES).json()["id"])


def by_opencv(points: Any, view: dict[str, Any]) -> Any:
    if view["camera"] == "weak_perspective":  # which OpenCV does not know
        turned = np.array(points) @ np.array(view["rotation"])[:2].T
        return view["scale"] * turned + view["translation"]
    turn, shift = cv2.Rodrigues(np.array(view["rotation"]))[0], np.array(view["translation"])
    (fx, fy), (cx, cy) = view["focal"], view["principal_point"]
    matrix, lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(view["distortion"])
    points = np.array(points).reshape(-1, 1, 3)
    if view["camera"] == "fisheye":
        return cv2.fisheye.projectPoints(points, turn, shift, matrix, lens[:4])[0][:, 0]
    return cv2.projectPoints(points, turn, shift, matrix, lens)[0][:, 0]


@every_language
@pytest.mark.parametrize("more", [{"refine": "full"}, {"frame": "room"}, {"refine": "off"}])
def test_points_project_to_where_lifts_and_opencv_say(
    http: httpx2.Client, bent: str, language: str, more: dict[str, str], tmp_path: Path
) -> None:
    """By every camera model: weak perspective, 8 coefficients, a fisheye."""
    keypoints = load_file(FIXTURES / "fisheye_lifts.safetensors")["keypoints"]
    body = orjson.dumps({"model": bent, "frames": frames_of(keypoints)} | more)
    answer = http.post("/lift", content=body, headers=JSON)
    frames = answer.json()["frames"]
    if language == "cpp":
        with started(http, bent, **more) as socket:
            messages: list[str | bytes] = []
            for n, frame in enumerate(keypoints):
                socket.send(as_bytes(n, frame))
                messages.append(socket.recv(timeout=300))
        text = printed_by(
            "projection",
            language,
            tmp_path,
            b"".join(m for m in messages if isinstance(m, bytes)),
            "16",
        )
        found = np.array(text.split(), float).reshape(keypoints.shape)
    else:
        message = json.loads(printed_by("projection", language, tmp_path, answer.content))
        found = np.full(keypoints.shape, np.nan)
        for n, k in np.argwhere([[view is not None for view in frame] for frame in message]):
            found[n, k] = message[n][k]
    models, compared = set(), 0
    for n, frame in enumerate(frames):
        for k, view in enumerate(frame["views"]):
            if view is None:
                assert np.isnan(found[n, k]).all()
                continue
            models.add(view["camera"])
            np.testing.assert_allclose(found[n, k], by_opencv(frame["points3d"], view), atol=0.05)
            errors = np.linalg.norm(found[n, k] - keypoints[n, k], axis=-1)
            mine = np.nanmean(errors)
            assert mine == pytest.approx(view["reprojection_error"], rel=0.01, abs=0.05)
            compared += 1
    assert compared == 27
    weak = more == {"refine": "off"}
    assert models == ({"weak_perspective"} if weak else {"fisheye", "perspective"})
