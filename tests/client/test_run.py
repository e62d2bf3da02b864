"""``fewview run``: files of keypoints in, an animation, cameras and a model out."""

import csv
import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from fewview.calibration import Camera, read_cameras, write_cameras
from safetensors import safe_open
from scipy.spatial.transform import Rotation

from tests import fork_server
from tests.models.rigs import IMAGE_SIZE, RigCapture, make_rig_capture
from worker.process import python

NAMES = [f"k{p}" for p in range(16)]
MOVED = 24  # the first frame after a camera was moved
QUICK = ("-c", "steps=40", "-c", "dictionary_sizes=[16,8]", "-c", "batch_size=16")


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    return make_rig_capture([0.0, 80.0, -120.0], frames=40, seed=3)


@pytest.fixture(scope="module")
def files(capture: RigCapture, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return written(capture, tmp_path_factory.mktemp("files"))


def written(capture: RigCapture, folder: Path) -> list[str]:
    """Write what DeepLabCut would, a file for each camera."""
    for view in range(3):
        with (folder / f"cam{view}.csv").open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["scorer", *["net"] * 48])
            rows.writerow(["bodyparts", *np.repeat(NAMES, 3)])
            rows.writerow(["coords", *["x", "y", "likelihood"] * 16])
            for n, shown in enumerate(capture.keypoints[:, view]):
                cells = [("", "", 0.0) if np.isnan(x) else (x, y, 1.0) for x, y in shown]
                rows.writerow([n, *[value for cell in cells for value in cell]])
    return [str(folder / f"cam{view}.csv") for view in range(3)]


def command(*words: str) -> list[str]:
    return python("-m", "fewview.cli", "run", *words)


def run(*words: str) -> "subprocess.CompletedProcess[str]":
    env = {name: value for name, value in os.environ.items() if not name.startswith("FEWVIEW_")}
    env["FEWVIEW_KEY"] = "is of another service"  # and no key that any would take
    return fork_server.run(command(*words), env=env)


def test_files_become_an_animation_cameras_and_a_model(
    files: list[str], capture: RigCapture, tmp_path: Path
) -> None:
    size = "x".join(map(str, IMAGE_SIZE))
    words = [*files, "-o", str(tmp_path / "out"), "--json", "--image-size", size, *QUICK]
    words += ["--fps", "50", "--formats", "trc,npz,csv", "--known-distance", "cam2,1,2.5"]
    first = run(*words, "--first")
    assert first.returncode == 0, first.stderr
    answer = json.loads(first.stdout)
    early = answer["first"]
    assert (early["model"], early["arrangement"], early["in_room"]) == (None, "static", 40)
    assert set(early["files"]) == {file for file in answer["files"] if "model" not in file}
    assert answer["arrangement"] == "static"
    assert answer["frames"] == answer["in_room"] == 40
    written = {Path(file).name for file in answer["files"]}
    assert {"animation.trc", "animation.npz", "animation.csv", "cameras.toml"} <= written
    assert {"cameras.yml", "model.safetensors"} <= written

    # The capture is the calibration: these cameras project these points to where they were seen.
    with np.load(tmp_path / "out" / "animation.npz") as arrays:
        points = arrays["points"]
    cameras = read_cameras(tmp_path / "out" / "cameras.toml")
    assert [camera.name for camera in cameras] == ["cam0", "cam1", "cam2"]
    for view, camera in enumerate(cameras):
        apart = np.linalg.norm(camera.project(points) - capture.keypoints[:, view], axis=-1)
        assert np.nanmedian(apart) < 2
    turns = np.array([camera.rotation for camera in cameras])
    places = -np.einsum("kji,kj->ki", turns, [camera.translation for camera in cameras])
    assert np.linalg.norm(places[2] - places[1]) == pytest.approx(2.5)

    again = run(*words)
    assert json.loads(again.stdout)["model"] == answer["model"]
    in_words = run(*[word for word in words if word != "--json"])
    verdict = answer["verdict"]
    assert verdict["code"] in {None, *(finding["code"] for finding in answer["findings"])}
    assert f"{verdict['level']:<10} {verdict['reliable']}\n" in in_words.stdout
    assert run(*words, "-c", "seed=5", "--formats", "obj").returncode == 2


def test_a_camera_that_was_moved_counts_as_two(tmp_path: Path) -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=44, seed=3)
    rays = np.concatenate(
        ((capture.keypoints[MOVED:, 1] - [640, 512]) / 1100, np.ones((20, 16, 1))), axis=-1
    )
    turned = rays @ Rotation.from_rotvec([0.05, 0.06, 0.03]).as_matrix().T
    capture.keypoints[MOVED:, 1] = turned[..., :2] / turned[..., 2:] * 1100 + [640, 512]
    size = "x".join(map(str, IMAGE_SIZE))
    words = [*written(capture, tmp_path), "-o", str(tmp_path / "out"), "--json", *QUICK]
    words += ["--image-size", size, "--formats", "npz,trc", "--unit", "m"]
    done = run(*words)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    (note,) = [note for note in answer["notes"] if "was moved at frame" in note]
    first = int(note.partition("frame ")[2].partition(":")[0])
    assert abs(first - MOVED) <= 1
    assert answer["arrangement"] == "static"
    # A unit that nothing gives is none, so TRC, which needs one, is not written.
    assert any(note.startswith("no unit: ") for note in answer["notes"])
    with np.load(tmp_path / "out" / "animation.npz") as arrays:
        points = arrays["points"]
        assert "unit" not in arrays
    cameras = {camera.name: camera for camera in read_cameras(tmp_path / "out" / "cameras.toml")}
    assert set(cameras) == {"cam0", "cam1", "cam2", f"cam1@{first}"}
    for name, frames in (("cam1", slice(0, MOVED - 1)), (f"cam1@{first}", slice(MOVED + 1, 44))):
        shown = cameras[name].project(points[frames])
        assert np.nanmedian(np.linalg.norm(shown - capture.keypoints[frames, 1], axis=-1)) < 3


def test_it_goes_on_where_it_was_stopped(files: list[str], tmp_path: Path) -> None:
    words = [*files, "-o", str(tmp_path), *QUICK, "-c", "refine=off", "-c", "cameras=moving"]
    words += ["-c", "steps=600", "--formats", "csv"]
    # In another order than the views, and one more than there are.
    lenses = [Camera(f"CAM-{v}", np.diag([500 + v, 500, 1])) for v in (2, 0, 3, 1)]
    words += ["--calibration", str(write_cameras(tmp_path / "rig.yml", lenses))]
    with fork_server.Popen(command(*words), stderr=subprocess.PIPE, text=True) as process:
        notes = tmp_path / "run.json"
        deadline = time.monotonic() + 120
        while not (notes.exists() and json.loads(notes.read_text())["fit_id"]):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)  # Ctrl-C is ignored in the background
        _, message = process.communicate(timeout=300)
    assert process.returncode == 130, message
    assert "goes on" in message
    before = json.loads(notes.read_text())
    ended = run(*words)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(notes.read_text()) == before
    assert (tmp_path / "animation.csv").exists()
    with safe_open(tmp_path / "model.safetensors", "numpy") as file:
        config = json.loads(json.loads(file.metadata()["fewview"])["config"])
    assert [answer["intrinsics"]["fx"] for answer in config["calibration"]] == [500, 501, 502]
    assert "calibration with the views' names" in ended.stdout


def test_sizes_of_files_go_before_those_of_a_calibration(tmp_path: Path) -> None:
    frame = [{"x": x, "y": 0.5, "visibility": 1.0} for x in np.linspace(0.1, 0.9, 33)]
    for name, size in (("cam1", {"width": 1080, "height": 1920}), ("cam2", {})):
        (tmp_path / f"{name}.json").write_text(json.dumps({"frames": [frame] * 9, **size}))
    files = [str(tmp_path / f"cam{view}.json") for view in (1, 2)]
    lenses = [Camera(f"cam{v}.png", np.diag([500, 500, 1]), size=(1920, 1080)) for v in (2, 1)]
    rig = write_cameras(tmp_path / "rig.yml", lenses)
    words = [*files, "-o", str(tmp_path / "out"), "--calibration", str(rig), "--url", "nowhere"]

    def shown(*more: str) -> dict[str, str]:
        lines = [line.strip() for line in run(*words, *more).stdout.splitlines()]
        assert any("cam1: " in line and "1920x1080" in line for line in lines)
        return {line[:4]: line.partition("gaps  ")[2] for line in lines if "gaps  " in line}

    assert shown() == {"cam1": "1080 x 1920", "cam2": "1920 x 1080"}
    given = shown("--image-size", "cam1=540x960")
    assert given == {"cam1": "540 x 960", "cam2": "1920 x 1080"}


def test_what_is_asked_wrongly_is_said_in_one_line(files: list[str], tmp_path: Path) -> None:
    out = ["-o", str(tmp_path)]
    two = [Camera(f"c{v}", np.eye(3)) for v in range(2)]
    rig = str(write_cameras(tmp_path / "two.yml", two))
    for words in (
        [*files, *out, "--known-length", "k0,k16,0.4"],
        [*files, *out, "--known-length", "0,16,0.4"],
        [*files, *out, "--known-length", "k0,k1"],
        [*files, *out, "--known-distance", "cam0,cam3,2"],
        [*files, *out, "--known-distance", "cam0,0,2"],
        [*files, *out, "--known-distance", "cam0,cam1,-2"],
        [*files, *out, "--height", "1.7"],  # of no joints that are known
        [*files, *out, "--formats", "obj"],
        [*files, *out, "--calibration", rig],
        [str(tmp_path / "none.csv"), *out],
        [*files, *out, "--url", "nowhere", "--json"],
    ):
        refused = run(*words)
        assert refused.returncode == (1 if "--url" in words else 2)
        assert len(refused.stderr.splitlines()) == 1
        assert refused.stderr.startswith("fewview run: ")
        if words[-2].startswith("--known-"):  # before a service is started
            assert words[-2] in refused.stderr
            assert not (tmp_path / "fewview-data").exists()
