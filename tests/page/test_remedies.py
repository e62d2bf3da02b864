"""Remedies are taken on the page, where they are read."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Locator, expect

from tests.page.conftest import Watched
from tests.page.stored import EDGES, KEYPOINTS, NAMES, Stored
from tests.service.conftest import BYTES, Live, to_npz


@pytest.fixture
def unnamed(live: Live, stored: Stored) -> Iterator[str]:
    """Return the dataset of the walk, whose keypoints have no names while the test runs."""
    url = f"/datasets/{stored.dataset}"
    live.http.patch(url, json={"skeleton": None})
    yield url
    skeleton = {"keypoint_names": NAMES, "edges": EDGES}
    live.http.patch(url, json={"skeleton": skeleton, "image_sizes": None, "fps": 50.0})


def skeleton_of(live: Live, url: str) -> Any:
    return live.get(url)["skeleton"]


def accented(stage: Locator) -> int:
    """Count the pixels of a picture in 3D that have the colour of what is offered or chosen."""
    pixels = np.asarray(Image.open(io.BytesIO(stage.screenshot())).convert("RGB")).astype(int)
    red, green, blue = np.moveaxis(pixels, -1, 0)
    return int(((green - red > 30) & (green > blue)).sum())


def test_edges_that_were_found_are_dashed_until_they_are_accepted(
    watched: Watched, live: Live, stored: Stored, unnamed: str
) -> None:
    page = watched.open(f"#/fits/{stored.fit}")
    panel = page.get_by_role("region", name="Skeleton")
    expect(panel.get_by_text("nothing joins them")).to_be_visible()
    expect(panel.locator("line.offered").first).to_be_visible()
    stage = page.get_by_role("img", name="3D structure")
    offered = accented(stage)
    assert offered > 1000  # they are there in 3D, too
    panel.get_by_role("button", name="Draw these edges").click()
    expect(panel.get_by_text("nothing joins them")).to_have_count(0)
    expect(panel.locator("line.offered")).to_have_count(0)
    expect(stage).to_be_visible()
    assert accented(stage) < offered / 2  # of controls
    found = {tuple(sorted(edge)) for edge in skeleton_of(live, unnamed)["edges"]}
    assert len(found) >= 12  # of 16 keypoints
    assert len({end for edge in found for end in edge}) >= 13


def test_a_skeleton_is_drawn_with_the_keyboard_and_undone(
    watched: Watched, live: Live, stored: Stored, unnamed: str
) -> None:
    page = watched.open(f"#/datasets/{stored.dataset}")
    panel = page.get_by_role("region", name="Skeleton")
    panel.get_by_text("Name keypoints, draw edges").click()

    def press(*names: str) -> None:
        for name in names:
            panel.get_by_role("button", name=name, exact=True).press("Enter")

    press("keypoint 3", "keypoint 5", "keypoint 5", "keypoint 7", "keypoint 7", "keypoint 9")
    expect(panel.get_by_text("3 edges")).to_be_visible()
    press("Undo", "Remove the edge from keypoint 3 to keypoint 5")
    expect(panel.get_by_text("1 edge", exact=True)).to_be_visible()
    press("Left and right", "keypoint 0", "keypoint 1")
    panel.get_by_text("Names of 16 keypoints").click()
    panel.get_by_label("Name of keypoint 2", exact=True).fill("left_0")
    panel.get_by_label("Name of keypoint 2", exact=True).blur()
    expect(panel.get_by_text("Two keypoints are called left_0")).to_be_visible()
    press("Undo", "Save the skeleton")
    expect(panel.get_by_text("16 named keypoints, 1 edge")).to_be_visible()
    saved = skeleton_of(live, unnamed)
    assert saved["edges"] == [[5, 7]]
    assert saved["keypoint_names"][:3] == ["left_0", "right_0", "keypoint 2"]


def test_image_sizes_are_given_beside_the_words(
    watched: Watched, live: Live, stored: Stored, unnamed: str
) -> None:
    live.http.patch(unnamed, json={"image_sizes": [[300, 300]] * 3})
    page = watched.open(f"#/datasets/{stored.dataset}")
    page.get_by_text("Give the image sizes").first.click()
    page.get_by_label("Width of view 0").first.fill("2000")
    page.get_by_label("Height of view 0").first.fill("1500")
    page.get_by_role("button", name="Save", exact=True).first.click()
    expect(page.get_by_text("Outside image")).to_have_count(0)
    assert live.get(unnamed)["image_sizes"] == [[2000, 1500]] * 3


def test_up_is_shown_by_two_keypoints_and_is_that_of_what_is_saved(
    watched: Watched, stored: Stored
) -> None:
    """The ankle is put above the shoulder: the walk stands on its head."""
    page = watched.open(f"#/fits/{stored.fit}")
    known = page.get_by_role("region", name="What you know of it")
    known.get_by_text("Give a known length").click()  # which no finding asks for
    expect(known.get_by_label("Length")).to_have_value("0.5")
    known.get_by_text("Show which way is up").click()
    known.get_by_label("Lower").select_option("l_shoulder")
    known.get_by_label("Upper").select_option("l_ankle")
    known.get_by_role("button", name="Show it so").click()
    expect(page.get_by_text("In the room: y up")).to_be_visible()
    with page.expect_download() as saved:
        page.get_by_role("button", name="npz").first.click()
    with np.load(io.BytesIO(Path(saved.value.path()).read_bytes())) as arrays:
        off = arrays["points3d"][:, NAMES.index("l_ankle")] - arrays["points3d"][:, 0]
    mean = np.nanmean(off / np.linalg.norm(off, axis=-1, keepdims=True), axis=0)
    assert mean[1] > 0.99 * np.linalg.norm(mean)


def test_views_in_another_order_get_their_cameras_where_they_are_played(
    watched: Watched, live: Live, stored: Stored
) -> None:
    exchanged = to_npz(keypoints=KEYPOINTS[:, [1, 0, 2]], fps=50.0)
    made = live.http.post("/datasets?name=exchanged", content=exchanged, headers=BYTES).json()
    page = watched.open("#/live")
    page.get_by_label("Model").select_option(stored.model)
    page.get_by_label("Capture").select_option(made["id"])
    page.get_by_role("button", name="Start").click()
    noticed = page.get_by_text("Rig not used")
    expect(noticed).to_be_visible()
    page.get_by_text("Choose which camera each view is of").click()
    page.get_by_label("Camera of view 0").select_option("1")
    page.get_by_label("Camera of view 1").select_option("0")
    page.get_by_role("button", name="Show it so").click()
    expect(noticed).to_have_count(0)
    expect(page.get_by_text(re.compile(r"^[4-9]\d frames, of"))).to_be_visible()  # all, and again
    expect(noticed).to_have_count(0)
    page.get_by_role("button", name="Stop").click()
    live.http.delete(f"/datasets/{made['id']}")
