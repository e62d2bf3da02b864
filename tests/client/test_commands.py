"""Commands that talk to a service, from files to 3D."""

import json
import subprocess
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import cli
from fewview.calibration import Camera, read_cameras, rotation_matrix, write_cameras
from fewview.commands.talking import fields_in
from fewview.errors import Conflict
from typer.testing import CliRunner

from tests.client.conftest import Served, a_capture
from tests.processes import free_port
from tests.waiting import wait_for

Ran = subprocess.CompletedProcess[str]


def fewview(*words: str) -> Ran:
    """Run a command in this process: to start one takes longer than most commands."""
    ran = CliRunner().invoke(cli.app, words)
    if ran.exception is not None and not isinstance(ran.exception, SystemExit):
        raise ran.exception
    return subprocess.CompletedProcess(words, ran.exit_code, ran.stdout, ran.stderr)


def said(ran: Ran) -> Any:
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def refused(ran: Ran, status: int) -> str:
    assert ran.returncode == status, ran.stderr
    assert ran.stdout == ""
    assert ran.stderr.startswith("fewview: ")
    assert ran.stderr.count("\n") == 1
    return ran.stderr


def test_from_files_to_3d(served: Served, tmp_path: Path) -> None:
    file, url = tmp_path / "figure.npz", f"--url={served.live.url}"
    times = 100 + np.arange(60) / 25
    np.savez(file, allow_pickle=False, times=times, **served.capture.arrays())
    dataset = fewview("upload", str(file), url).stdout.strip()
    assert served.client.datasets.get(dataset).name == "figure"

    small = ["-c", '{"dictionary_sizes": [16, 8], "batch_size": 16}', "-c", "cameras=moving"]
    followed = fewview("fit", dataset, "--follow", *small, "-c", "steps=60", "--name=walk", url)
    assert followed.returncode == 0, followed.stderr
    assert "60/60" in followed.stderr
    model = followed.stdout.strip()
    assert served.client.models.get(model).name == "walk"

    assert "moving" in fewview("cameras", model, url).stdout
    assert said(fewview("cameras", model, "--json", url))["model"] == model
    lifted = fewview("lift", model, str(file), "-o", str(tmp_path / "out.npz"), url)
    assert "60 of 60 frames lifted" in lifted.stdout, lifted.stderr
    with np.load(tmp_path / "out.npz") as arrays:
        assert arrays["points3d"].shape == (60, served.capture.keypoints.shape[2], 3)
    (tmp_path / "out.npz").unlink()
    command = ("lift", model, str(file), "-o", str(tmp_path / "out.npz"), "--json", url)
    assert said(fewview(*command, "--views=0,1,2"))["frames_lifted"] == 60
    assert said(fewview(*command, "--uncertainty=full"))["frames_lifted"] == 60
    with np.load(tmp_path / "out.npz") as arrays:
        assert {"points3d_sd", "points3d_covariance", "points3d_modes"} <= set(arrays)
    assert fewview(*command, "--uncertainty=some").returncode == 2

    fit = str(served.client.models.get(model).fit_id)
    expected = served.client.fits.report(fit).verdict.expected
    assert expected is not None
    printed = fewview("report", fit, url).stdout
    assert expected in printed
    assert "expected error" in printed
    report = said(fewview("report", fit, "--json", url))
    assert report["verdict"]["expected"] == expected
    page = tmp_path / "report.html"
    assert fewview("report", fit, "-o", str(page), url).returncode == 0
    assert page.read_text().startswith("<!doctype html>")
    assert said(fewview("report", fit, "--json", "-o", str(page), url))["file"] == str(page)
    assert json.loads(page.read_text()) == report
    assert "fit_0" in refused(fewview("report", "fit_0", url), 2)
    out = tmp_path / "out"
    exported = said(fewview("export", fit, "-o", str(out), "--formats=csv,npz", "--json", url))
    written = {Path(file).name for file in exported["files"]}
    assert {"animation.csv", "animation.npz", "model.safetensors"} <= written
    with np.load(out / "animation.npz") as arrays:
        assert arrays["points"].shape == (60, served.capture.keypoints.shape[2], 3)
        np.testing.assert_allclose(arrays["times"], times)  # the dataset's
        plain, plain_sd = arrays["points"], arrays["points_sd"]
        lift = served.client.fits.reconstruction(fit).arrays()
        np.testing.assert_allclose(plain_sd, lift["points3d_sd"], rtol=1e-6)
    tall = ["--height=1.8", "--formats=npz", "--json", url]
    assert said(fewview("export", fit, "-o", str(out), *tall))["frames"] == 60
    with np.load(out / "animation.npz") as arrays:
        assert arrays["unit"] == "m"
        joints = arrays["points"][:, :8].reshape(60, 4, 2, 3)
        ratios = arrays["points"] / plain
        np.testing.assert_allclose(ratios, ratios[0, 0, 0], rtol=1e-4)
        np.testing.assert_allclose(arrays["points_sd"] / plain_sd, ratios[0, 0, 0], rtol=1e-4)
    trunk, legs = joints[:, 0].mean(1) - joints[:, 1].mean(1), np.diff(joints[:, 1:], axis=1)
    chain = np.linalg.norm(trunk, axis=-1) + np.linalg.norm(legs, axis=-1).sum(1).mean(1)
    assert np.quantile(chain, 0.8) == pytest.approx(0.779 * 1.8, rel=1e-3)
    calibration = out / "cameras.yml"
    assert fewview("cameras", model, "-o", str(calibration), url).returncode == 0
    assert len(read_cameras(calibration)) == 3
    assert "anipose" in refused(fewview("cameras", model, "-o", str(out / "a.obj"), url), 2)

    assert fewview("datasets", "download", dataset, "-o", str(out / "a.npz"), url).returncode == 0
    again = fewview("upload", str(out / "a.npz"), "--json", url)
    stored = served.client.datasets.get(dataset)
    assert said(again)["checksum"] == stored.checksum
    for field in ("image_sizes", "fps", "has_times"):
        assert said(again)[field] == stored.raw[field]
    weights = str(out / "copy.safetensors")
    assert said(fewview("models", "download", model, "-o", weights, "--json", url))
    uploaded = fewview("models", "upload", weights, "--tag=copy", url).stdout.strip()
    copy = served.client.models.get(uploaded)
    assert (copy.name, copy.tags) == ("walk", ("copy",))
    lost = refused(fewview("models", "upload", str(out / "lost.safetensors"), url), 2)
    assert "lost.safetensors: No such file" in lost

    for kind, identifier in (("datasets", dataset), ("models", model)):
        listed = fewview(kind, "list", url).stdout
        assert identifier in listed
        assert listed.startswith("id ")
        assert (f" {version('fewview-server')} " in listed) == (kind == "models")
        assert said(fewview(kind, "get", identifier, url))["id"] == identifier
        gone = {"deleted": [identifier], "refused": []}
        assert said(fewview(kind, "delete", identifier, "--json", url)) == gone
        assert identifier not in [i["id"] for i in said(fewview(kind, "list", "--json", url))]


def test_jobs_are_queued_and_cancelled(served: Served) -> None:
    url = f"--url={served.live.url}"
    made = said(fewview("fit", served.dataset.id, "-c", "steps=100000", "--json", url))
    assert made["config"]["steps"] == 100_000
    assert fewview("fits", "cancel", made["id"], url).returncode == 0
    listed = said(fewview("fits", "list", "--most=1", "--json", url))
    assert [fit["id"] for fit in listed] == [made["id"]]
    assert fewview("lifts", "list", "--name=none", url).stdout == "no lifts\n"


def test_a_fit_is_given_what_was_measured(served: Served) -> None:
    measured = ["--known-length", "3,4,0.41", "--known-distance", "2,0,2.5"]
    words = ["-c", "steps=100000", "--json", f"--url={served.live.url}"]
    made = said(fewview("fit", served.dataset.id, *measured, "--mend=auto", *words))
    assert made["config"]["known_length"] == {"keypoints": [3, 4], "length": 0.41}
    assert made["config"]["known_distance"] == {"views": [2, 0], "length": 2.5}
    assert made["config"]["mend"] == "auto"
    served.client.fits.cancel(made["id"])
    known = ("fit", served.dataset.id, *words, "--known-distance")
    assert "there is no view 'cam9'" in refused(fewview(*known, "0,cam9,2"), 2)


def test_a_fit_is_given_a_calibration_file(served: Served, tmp_path: Path) -> None:
    lens = np.array([[1100.5, 0, 640.25], [0, 1099, 512], [0, 0, 1]])
    turn = rotation_matrix([0.1, -0.2, 0.3])
    bent = np.array([0.1, -0.05])
    cameras = [Camera(f"c{v}", lens, bent, turn, np.array([v, 0, 4])) for v in range(3)]
    file = write_cameras(tmp_path / "rig.yml", cameras)
    by_hand = {
        "intrinsics": {"fx": 1100.5, "fy": 1099, "cx": 640.25, "cy": 512}
        | {"distortion": [0.1, -0.05, 0, 0, 0]},
        "rotation": turn.tolist(),
    }
    # Cameras of a file belong to the views of their names, and it may have more of them.
    named = replace(served.capture, view_names=("c2", "c0", "c1"))
    shuffled = served.client.datasets.create(named, name="shuffled")
    four = write_cameras(tmp_path / "four.yml", [*cameras, replace(cameras[0], name="c3")])
    url = f"--url={served.live.url}"
    more = ("-c", "steps=100000", "--json", url, "--calibration")
    ran = fewview("fit", shuffled.id, *more, str(four))
    assert "the views' names" in ran.stderr
    for fit in (
        said(ran),
        served.client.fits.create(shuffled, calibration=four, steps=100_000).raw,
    ):
        kept = fit["config"]["calibration"]
        assert [view["translation"][0] for view in kept] == [2, 0, 1]
        served.client.fits.cancel(fit["id"])

    entries = [by_hand | {"translation": [view, 0, 4]} for view in range(3)]
    made = [
        served.client.fits.create(served.dataset, calibration=given, steps=100_000).raw
        for given in ([e | {"rotation": turn} for e in entries], file, cameras, str(file))
    ]
    words = ("fit", served.dataset.id, *more)
    made.append(said(fewview(*words, str(file))))
    for fit in made:
        assert fit["config"] == made[0]["config"]
        served.client.fits.cancel(fit["id"])
    # Which is what the entries say, and their defaults.
    kept = made[0]["config"]["calibration"]
    assert [view["translation"] for view in kept] == [[0, 0, 4], [1, 0, 4], [2, 0, 4]]
    assert all(view["rotation"] == turn.tolist() for view in kept)
    assert all(by_hand["intrinsics"].items() <= view["intrinsics"].items() for view in kept)

    write_cameras(tmp_path / "two.yml", cameras[:2])
    assert "has 2 cameras" in refused(fewview(*words, str(tmp_path / "two.yml")), 2)
    (tmp_path / "none.toml").write_text("a = 1")
    assert "has no cameras" in refused(fewview(*words, str(tmp_path / "none.toml")), 2)


def test_keypoints_are_corrected_from_a_file_listed_and_undone(
    served: Served, tmp_path: Path
) -> None:
    capture = replace(a_capture(frames=6), view_names=("left", "=right", "top"))
    dataset, url = served.client.datasets.create(capture).id, f"--url={served.live.url}"
    file, again = tmp_path / "corrections.csv", tmp_path / "again.csv"
    file.write_text("frame,view,keypoint,x,y\n3,'=right,l_knee,412.5,230\n4,0,2,,\n")
    correct = ("datasets", "correct", dataset, f"--file={file}", url)
    assert "would have 2 corrections" in fewview(*correct, "--dry-run").stdout
    assert served.client.datasets.get(dataset).corrections.count == 0
    state = said(fewview(*correct, "--json"))
    assert state["count"] == 2
    assert served.client.datasets.get(dataset).corrections.checksum == state["checksum"]
    knee = list(capture.keypoint_names or ()).index("l_knee")
    place = {"frame": 3, "view": 1, "keypoint": knee}
    listed = said(fewview("datasets", "corrections", dataset, "-o", str(again), "--json", url))
    assert listed["items"][0] == place | {"position": [412.5, 230.0]}
    lines = fewview("datasets", "corrections", dataset, url).stdout.splitlines()
    assert lines[1].split() == ["3", "=right", "l_knee", "412.5", "230.0"]
    assert lines[2].split()[-1] == "removed"

    downloaded = served.client.datasets.download(dataset, tmp_path / "corrected.npz")
    detected = served.client.datasets.download(dataset, tmp_path / "raw.npz", corrected=False)
    with np.load(downloaded) as now, np.load(detected) as before:
        assert now["keypoints"][3, 1, knee].tolist() == [412.5, 230.0]
        np.testing.assert_array_equal(before["keypoints"], capture.keypoints)

    undo = ("datasets", "undo", dataset, url)
    assert "--all" in refused(fewview(*undo), 2)
    assert "undid 1 correction;" in fewview(*undo, "--keypoint=l_knee").stdout
    assert "undid 1 correction;" in fewview(*undo, "--all").stdout
    assert served.client.datasets.corrections(dataset).items == ()
    assert said(fewview(*correct[:3], f"--file={again}", "--json", url)) == state

    for row, words in (
        ("3,left,elbow,1,2", "no keypoint of the dataset is 'elbow': expected one of l_"),
        ("3,left,l_knee,1,", "line 2: expected x and y in pixels, or neither"),
        ("x,left,l_knee,1,2", "line 2: expected a frame"),
        ("6,left,l_knee,1,2", "expected a frame from 0 to 5"),
        ("3,left,l_knee,nan,2", "line 2: expected x and y in pixels"),
        ("3,left,l_knee,a,2", "line 2: could not convert"),
    ):
        file.write_text(f"frame,view,keypoint,x,y\n{row}\n")
        assert words in refused(fewview(*correct), 2)
    file.write_text("frame,x,y\n")
    assert "there is no view" in refused(fewview(*correct), 2)


def test_labels_choose_what_is_listed_changed_and_deleted(served: Served, tmp_path: Path) -> None:
    file, url = tmp_path / "labelled.npz", f"--url={served.live.url}"
    np.savez(file, keypoints=served.capture.keypoints[:8])
    pilot = ("--tag=pilot", "--metadata", "subject=M7", "--metadata", "day=2")
    made = [fewview("upload", str(file), *pilot, url).stdout.strip() for _ in range(2)]
    other = fewview("upload", str(file), "--tag=other", url).stdout.strip()

    def listed(*filters: str) -> list[str]:
        return [item["id"] for item in said(fewview("datasets", "list", *filters, "--json", url))]

    assert listed(*pilot) == made[::-1]
    assert listed("--tag=other", "--name=labelled") == [other]
    assert listed("--tag=pilot", "--after=2100-01-01") == []
    assert listed("--tag=pilot", "--before=2100-01-01T00:00:00+02:00") == made[::-1]
    for command in ("list", "delete"):
        for moment in ("2026", "20260131", "1767225600", "2026-02-30"):
            wrong = fewview("datasets", command, "--after", moment, url)
            assert refused(wrong, 2).startswith("fewview: --after: expected a date or a moment")
    assert "pilot" in fewview("datasets", "list", url).stdout
    facts = ("--set=fps=25", '--set={"view_names": ["a", "b", "c"]}')
    change = ("datasets", "change", made[0], "--tag=kept", "--metadata=day=3", *facts, url)
    changed = fewview(*change)
    assert changed.returncode == 0, changed.stderr
    known = served.client.datasets.get(made[0]).raw
    assert (known["fps"], known["view_names"]) == (25, ["a", "b", "c"])
    assert "--set" in refused(fewview(*change, "--set=fps"), 2)
    assert listed("--tag=kept", "--metadata=day=3") == [made[0]]

    fit = said(fewview("fit", made[1], "--tag=pilot", "-c", "steps=100000", "--json", url))
    assert (fit["tags"], fit["metadata"]) == (["pilot"], {})
    kept = fewview("datasets", "delete", "--tag=pilot", "--yes", "--json", url)
    assert kept.returncode == 1
    assert json.loads(kept.stdout)["refused"][0]["id"] == made[1]
    assert f"in use by {fit['id']}" in kept.stderr
    fewview("fits", "cancel", fit["id"], url)
    wait_for(lambda: served.client.fits.get(fit["id"]).status == "cancelled", "the fit to end")
    chosen: dict[str, Any] = {"id": [fit["id"]], "status": ["cancelled"]}
    assert served.client.fits.would_delete(**chosen) == 1
    with pytest.raises(Conflict, match="finds 1"):
        served.client.fits.delete_many(**chosen, expected_count=2)
    assert served.client.fits.delete_many(**chosen, expected_count=1).deleted == (fit["id"],)

    assert "--yes" in refused(fewview("datasets", "delete", "--metadata=day=3", url), 2)
    assert "--tag" in refused(fewview("datasets", "delete", url), 2)
    assert "status" in refused(fewview("datasets", "delete", "--status=failed", "-y", url), 2)
    assert listed("--metadata=day=3") == [made[0]]
    assert fewview("datasets", "delete", *made, other, url).returncode == 0
    assert listed("--name=labelled") == []


def test_what_is_wrong_is_a_line_on_stderr_and_a_status(served: Served, tmp_path: Path) -> None:
    url, nobody = f"--url={served.live.url}", f"--url=http://127.0.0.1:{free_port()}"
    assert "fewview serve" in refused(fewview("datasets", "list", nobody), 1)
    assert "expected a URL" in refused(fewview("datasets", "list", "--url=here"), 2)
    assert "no host" in refused(fewview("datasets", "list", "--url=http://a..b:1"), 2)
    assert "identifier" in refused(fewview("models", "get", "", url), 2)
    assert "mdl_none" in refused(fewview("models", "get", "mdl_none", url), 2)
    assert "steps" in refused(fewview("fit", served.dataset.id, "-c", "steps=-1", url), 2)
    assert "key=value" in refused(fewview("fit", served.dataset.id, "-c", "steps", url), 2)
    assert refused(fewview("upload", str(tmp_path / "none.npz"), url), 2)
    (tmp_path / "text.npz").write_text("no arrays")
    assert refused(fewview("upload", str(tmp_path / "text.npz"), url), 2)
    assert refused(fewview("lift", served.model, "a.npz", "-o", "b.txt", url), 2)
    empty = served.client.datasets.create(np.full((40, 2, 16, 2), np.nan))
    command = ("fit", empty.id, "--follow", "--json", url)
    assert "unusable_capture" in refused(fewview(*command), 1)


def test_configuration_is_json_or_words() -> None:
    texts = ['{"steps": 5, "seed": 1}', "steps=7", "cameras=static", "calibration=[1]"]
    found = fields_in(texts, "--config")
    assert found == {"steps": 7, "seed": 1, "cameras": "static", "calibration": [1]}
    for wrong in ("steps", "[1]", "{", "=3"):
        with pytest.raises(ValueError, match=r"--config.*key=value"):
            fields_in([wrong], "--config")


def test_every_way_to_lift_has_as_much_of_its_uncertainty_as_is_asked_for(served: Served) -> None:
    client, capture, model = served.client, served.capture, served.model
    frames, _, keypoints = capture.keypoints.shape[:3]
    lift = client.lift(model, capture, uncertainty="full")
    assert lift.points3d_sd is not None
    assert np.isfinite(lift.points3d_sd).any()
    assert lift.points3d_modes is not None
    assert lift.points3d_modes.shape == (frames, keypoints, 3, 12)
    assert client.lift(model, capture, uncertainty="off").points3d_sd is None
    again = client.fits.reconstruction(served.fit, uncertainty="full")
    assert again.points3d_covariance is not None
    assert again.points3d_covariance.shape == (frames, keypoints, 6)
    assert client.fits.reconstruction(served.fit, uncertainty="off").points3d_sd is None
    job = client.lifts.wait(client.lifts.create(model, served.dataset, uncertainty="full"))
    assert job.uncertainty == "full"
    assert client.lifts.result(job).points3d_modes is not None
    client.lifts.delete(job)
    assert capture.confidence is not None
    for kind in ("off", "sd", "full"):
        with client.stream(model, uncertainty=kind) as stream:
            assert stream.ready.uncertainty == kind
            answer = stream.lift(capture.keypoints[0], confidence=capture.confidence[0])
        assert (answer.points3d_sd is None) == (kind == "off")
        assert (answer.points3d_modes is None) == (answer.points3d_covariance is None)
        for name in ("points3d_sd", "points3d_covariance", "points3d_modes"):
            if (mine := getattr(answer, name)) is not None:
                np.testing.assert_allclose(mine, getattr(lift, name)[0], rtol=1e-3, atol=1e-6)
        assert (answer.points3d_modes is None) == (kind != "full")
