"""Labels by the client and by ``fewview labels``."""

import json
from pathlib import Path

import numpy as np
import pytest
from fewview import InvalidRequest, read

from tests.client.conftest import Served
from tests.client.test_commands import fewview, refused, said


def test_the_client_lists_and_writes_labels(served: Served, tmp_path: Path) -> None:
    found = served.client.fits.labels(served.fit, limit=3)
    assert found.fit_id == served.fit.id
    assert len(found.images) <= 3 <= found.candidates + 3
    assert len(found.noise_px) == served.capture.views
    for image in found.images:
        assert 0 <= image.frame < served.capture.frames
        assert image.reasons
        assert image.score >= 0.5
    files = served.client.fits.download_labels(
        served.fit, tmp_path, "dlc", images="all", source="keypoints"
    )
    again = read([file for file in files if file.suffix == ".h5"])
    assert again.keypoint_names == served.capture.keypoint_names
    assert again.frames == served.capture.frames
    there = np.isfinite(again.keypoints)
    assert there.mean() > 0.8 * np.isfinite(served.capture.keypoints).mean()
    np.testing.assert_allclose(again.keypoints[there], served.capture.keypoints[there], atol=0.002)
    with pytest.raises(InvalidRequest):
        served.client.fits.download_labels(served.fit, tmp_path, "sleap")


def test_the_command_prints_what_to_label_and_writes_files(served: Served, tmp_path: Path) -> None:
    url = f"--url={served.live.url}"
    listed = said(fewview("labels", served.fit.id, "--json", "--most=2", url))
    assert len(listed["images"]) <= 2
    assert listed["files"] == []
    longest = said(fewview("labels", served.fit.id, "--json", "--most=9999", url))
    assert len(longest["images"]) > 2
    command = ("labels", served.fit.id, "-o", str(tmp_path / "out"), "--all", url)
    words = fewview(*command, "--format=coco")
    assert words.returncode == 0, words.stderr
    file = tmp_path / "out" / "labels.json"
    assert f"wrote      {file}" in words.stdout
    assert len(json.loads(file.read_text())["annotations"]) > 100
    written = said(fewview(*command, "--json", "--format=lightning-pose", "--most=7"))["files"]
    assert len(written) == 3
    assert all(len(Path(name).read_text().splitlines()) == 10 for name in written)
    assert "scorer" in refused(fewview(*command, "--scorer=a b"), 2)
    assert "fit_none" in refused(fewview("labels", "fit_none", url), 2)
