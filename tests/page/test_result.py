"""The result of a fit: in its room, compared with others, and when it is long."""

import io
import re

import numpy as np
import pytest
from playwright.sync_api import expect
from scipy.spatial.transform import Rotation

from tests.models.walk import walk
from tests.page.conftest import Watched
from tests.page.stored import KEYPOINTS, LONG, MOMENTS, Stored
from tests.service.conftest import Live
from tests.waiting import wait_for


def test_static_cameras_are_shown_in_their_room_and_looked_through(
    watched: Watched, stored: Stored
) -> None:
    page = watched.open(f"#/fits/{stored.fit}?frame=20")
    expect(page.get_by_text("In the room: y up")).to_be_visible()
    expect(page.get_by_text("unit of the known length").first).to_be_visible()
    expect(page.get_by_role("slider", name="Frame")).to_have_value("20")
    page.keyboard.press("c")
    labels = page.locator(".labels button")
    expect(labels.first).to_be_visible()
    assert labels.count() == 3
    labels.nth(1).click()
    expect(page.get_by_role("button", name="Through view 1")).to_be_visible()
    expect(labels.first).to_be_hidden()
    drawn = page.locator(".stage canvas")
    drawn.click(force=True)
    expect(page.get_by_role("button", name="Through view 1")).to_be_visible()
    drawn.drag_to(drawn, target_position={"x": 80, "y": 90}, force=True)
    expect(page.get_by_role("button", name="Through view 1")).to_have_count(0)
    page.get_by_label("Select a keypoint").fill("l_knee")
    page.keyboard.press("Enter")
    expect(page.get_by_text("l_knee is marked in all views")).to_be_visible()


def test_the_truth_and_another_fit_are_compared_with_the_structure(
    watched: Watched, live: Live, stored: Stored
) -> None:
    page = watched.open(f"#/fits/{stored.fit}")
    stage = page.locator(".stage canvas")
    expect(stage).to_be_visible()
    before = stage.screenshot()
    choice = page.get_by_label("Laid over the structure")
    choice.select_option("the ground truth")
    wait_for(lambda: stage.screenshot() != before, "a drawing of both", 30)
    shown = page.locator(".figures div", has_text="Distance from the truth").locator("dd")
    url = f"/fits/{stored.fit}/reconstruction?frame=room&up=auto&format=npz"
    with np.load(io.BytesIO(live.http.get(url).content)) as arrays:
        found = arrays["points3d"].reshape(-1, 3).astype(np.float64)
    truth = walk(MOMENTS).reshape(-1, 3)
    known = np.isfinite(found).all(1)
    found, truth = (each[known] - each[known].mean(0) for each in (found, truth))
    turn, _ = Rotation.align_vectors(found, truth)
    off = found - turn.apply(truth) * np.linalg.norm(found) / np.linalg.norm(truth)
    mean = float(np.linalg.norm(off, axis=1).mean())
    assert float(shown.inner_text().split()[0]) == pytest.approx(mean, rel=0.01)

    choice.select_option(label=f"walk again ({stored.again[-6:]})")
    page.get_by_role("button", name="Side by side").click()
    other = page.get_by_role("region", name="Structure in 3D: walk again").locator("canvas")
    expect(other).to_be_visible()
    expect(page.locator(".figures div", has_text="of walk again")).to_contain_text("px")
    for turned, follower in ((stage.first, other), (other, stage.first)):
        before = follower.screenshot()
        turned.press("ArrowRight")
        wait_for(lambda: follower.screenshot() != before, "the other's turn", 30)  # noqa: B023
    page.get_by_role("button", name="Side by side").click()
    expect(other).to_have_count(0)


def test_a_long_result_is_fetched_in_parts_those_first_that_are_looked_at(
    watched: Watched, stored: Stored
) -> None:
    frames = LONG * len(KEYPOINTS)
    asked: list[str] = []
    watched.page.on("request", lambda request: asked.append(request.url))
    page = watched.open(f"#/fits/{stored.long}?frame={frames - 10}")
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    slices = [found[1] for url in asked if (found := re.search(r"frames=([0-9:]+)", url))]
    parts = [tuple(map(int, part.split(":"))) for part in slices if not part.startswith(":")]
    assert len(slices) == len(parts) + 1  # an overview of all
    first, end = parts[0]
    assert first < frames - 10 < end == frames
    ordered = sorted(parts)
    assert len(ordered) > 1
    assert [start for start, _ in ordered] == [0, *(stop for _, stop in ordered[:-1])]
    # Each stretch of as many frames as were fitted is the same.
    shown = []
    for frame in (0, frames // 2, frames - len(KEYPOINTS)):
        page.get_by_role("slider", name="Frame").fill(str(frame))
        expect(page.locator(".facts")).to_contain_text(f"{frame / 50:.2f} s")
        shown.append(page.locator("figure.view figcaption .quiet").all_inner_texts())
    assert shown[0] == shown[1] == shown[2] != []
    expect(page.get_by_text("outlier, left out")).to_be_visible()
