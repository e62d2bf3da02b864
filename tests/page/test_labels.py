"""Labels for the detector on the page: what to look at, and files to train on."""

import io
import zipfile

import numpy as np
import pytest
from playwright.sync_api import expect

from store.database import Store
from store.settings import StoreSettings
from tests.page.conftest import Watched
from tests.page.stored import EDGES, KEYPOINTS, NAMES, SKELETON, walking
from tests.service.conftest import BYTES, Live, to_npz
from tests.service.stored_fits import put_fit


@pytest.fixture(scope="module")
def planted(live: Live) -> str:
    """Store a fit of a film in which the second view shows one keypoint wrongly at times."""
    keypoints = KEYPOINTS.copy()
    keypoints[20:24, 1, 6] += 80.0
    body = to_npz(keypoints=keypoints, keypoint_names=np.array(NAMES), edges=np.array(EDGES))
    dataset = live.http.post("/datasets?name=planted", content=body, headers=BYTES).json()["id"]
    records = Store(StoreSettings(data_dir=live.data_dir))
    try:
        return put_fit(records, dataset, walking(), KEYPOINTS, name="planted", skeleton=SKELETON)
    finally:
        records.close()


def test_images_worth_labelling_lead_to_their_frames_and_files(
    watched: Watched, live: Live, planted: str
) -> None:
    first = live.get(f"/fits/{planted}/labels")["images"][0]
    assert (first["view"], first["reasons"][0]["keypoints"]) == (1, [6])
    page = watched.open(f"#/fits/{planted}")
    page.get_by_text("Labels for the detector").click()
    row = page.get_by_role("table", name="Worth labelling").locator("tbody tr").first
    expect(row).to_contain_text(f"Disagreement: {NAMES[6]}")
    row.get_by_role("button").click()
    expect(page.get_by_role("slider", name="Frame")).to_have_value(str(first["moment"]))
    assert first["frame"] in range(20, 24)
    of_all = page.locator(".exports", has_text="All keypoints that the fit accepts")
    with page.expect_download() as saving:
        of_all.get_by_role("button", name="COCO").click()
    content = saving.value.path().read_bytes()
    assert zipfile.ZipFile(io.BytesIO(content)).namelist() == ["labels.json"]
    assert not watched.errors
