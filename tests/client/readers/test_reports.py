"""Files as people have them: what generators of reported cases write is read as it was meant."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest

from . import files

REPORTS = files.REAL.parent / "reports"
pytestmark = pytest.mark.skipif(not REPORTS.exists(), reason="the reported cases are not there")

SIZES = "1920x1080,cam5=1080x1920"
WIDE = {"image_size": "1920x1080"}
# A generator's folder, what to read of what it writes, options; keypoints, and the frames.
CASES: list[tuple[str, str, dict[str, Any], int, int]] = [
    ("01-mediapipe-in-dlc-layout", "cam*.csv", {"image_size": SIZES}, 26, 120),
    ("02-sports2d-px-trc", "*.trc", {}, 26, 120),
    *(("03-jarvis-data2d", kind, {}, 26, 120) for kind in "ab"),
    ("05-dltdv-xypts", "new/walkxypts.csv", {}, 26, 120),
    ("05-dltdv-xypts", "old/walkxypts.csv", {"y": "up", "image_size": "1920x1081"}, 26, 120),
    ("06-easymocap-annots", "annots", {}, 26, 120),
    *(("07-mediapipe-csv", kind, WIDE, 33, 120) for kind in "abcd"),
    *(
        ("08-excel-europe", kind, {}, 26, 120)
        for kind in (
            *("wide-semicolon", "wide-bom", "wide-utf16-tab", "wide-cp1252", "dlc-semicolon"),
            *("dlc-semicolon-point", "dlc-tab", "dlc-bom-crlf", "dlc-cr", "dlc-cp1252"),
            *("dlc-utf16", "dlc-sep-line", "dlc-trailing", "wide-sep-line", "wide-trailing"),
            "wide-trailing-cell",
        )
    ),
    *(("09-alphapose", kind, {}, 26, 120) for kind in "abc"),
    *(("10-yolo-pose", kind, WIDE, 17, 116) for kind in "ab"),
    ("10-yolo-pose", "c", {}, 17, 120),
    *(("11-mmpose-variants", kind, {}, 17, 120) for kind in "abcdefgh"),
    ("14-openpose-numbering", "pose", {}, 26, 120),
    ("19-rates-differ", "b", {}, 26, 300),
    ("22-y-upward", "cam*.csv", {"y": "up", "image_size": "1920x1080"}, 26, 150),
    ("23-mirrored-video", "b", {"mirror": "cam2", "image_size": "1920x1080"}, 26, 150),
    ("35-gaps-in-numbers", "cam*.csv", {}, 26, 150),
    *(("36-more-headers", kind, {}, 26, 120) for kind in "abcdefg"),
    *(("37-more-json", kind, {}, 17, 120) for kind in "abcd"),
    ("37-more-json", "f/all.json", {}, 17, 120),
    ("38-same-file-names", "cam*/predictions.csv", {}, 26, 60),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the folders that generators have written into."""
    folders = {}
    env = {**os.environ, "PYTHONPATH": str(REPORTS / "common")}
    for name in dict.fromkeys(case[0] for case in CASES):
        folder = tmp_path_factory.mktemp(name)
        script = str(REPORTS / name / "make.py")
        done = subprocess.run(
            [sys.executable, script], cwd=folder, env=env, capture_output=True, check=False
        )
        if done.returncode == 0:  # one needs pandas
            folders[name] = folder
    return folders


@pytest.mark.parametrize(("name", "what", "options", "points", "frames"), CASES)
def test_a_reported_case_is_read(
    made: dict[str, Path],
    name: str,
    what: str,
    options: dict[str, Any],
    points: int,
    frames: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if name not in made:
        pytest.skip("the generator needs a package that is not installed")
    given = sorted(made[name].glob(what))
    capture = fewview.read(given, **options)
    cameras = {"01": 5, "02": 2, "38": 12}.get(name[:2], 3)
    assert capture.keypoints.shape == (frames, cameras, points, 2)
    if name[:2] in ("02", "03", "05", "06", "08", "09", "10", "11", "14", "37"):
        monkeypatch.syspath_prepend(REPORTS / "common")
        _, _, expected, _ = import_module("base").capture(n=cameras)
        if what in ("a", "b") and name.startswith("10"):  # nobody is in a frame, nor its file
            expected = np.delete(expected, range(4, 120, 30), axis=0)
        off = np.abs(capture.keypoints - expected[:, :, :points])
        assert np.isfinite(off).mean() > 0.85
        assert np.nanmax(off) < 0.01
    assert capture.observed().mean() > (0.6 if name.startswith("19") else 0.9)
    if name.startswith("38"):
        assert set(capture.view_names or ()) == {f"cam{n}" for n in range(1, 13)}
