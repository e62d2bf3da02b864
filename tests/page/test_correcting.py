"""Keypoints are corrected where they are drawn: dragged, removed, undone, and fitted again."""

from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from store.database import Store
from store.settings import StoreSettings
from tests.page.conftest import Watched
from tests.page.stored import EDGES, KEYPOINTS, NAMES, SKELETON, Stored, walking
from tests.page.test_closer import settled_places
from tests.service.conftest import BYTES, Live, to_npz
from tests.service.stored_fits import put_fit
from tests.waiting import wait_for


@pytest.fixture(scope="module")
def wrong(live: Live, stored: Stored) -> tuple[str, str]:
    """Return a dataset of its own, and a fit of it, for others count what is of theirs."""
    arrays = {"keypoint_names": np.array(NAMES), "edges": np.array(EDGES), "fps": 50.0}
    body = to_npz(keypoints=KEYPOINTS, **arrays)
    dataset = live.http.post("/datasets?name=wrong", content=body, headers=BYTES).json()["id"]
    records = Store(StoreSettings(data_dir=live.data_dir))
    try:
        fit = put_fit(records, dataset, walking(), KEYPOINTS, skeleton=SKELETON, name="wrong")
    finally:
        records.close()
    return dataset, fit


def corrections(live: Live, dataset: str) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = live.get(f"/datasets/{dataset}/corrections")["items"]
    return items


def drag(page: Page, canvas: Locator, place: tuple[float, float], by: tuple[float, float]) -> None:
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    assert box is not None
    x, y = box["x"] + place[0], box["y"] + place[1]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + by[0] / 2, y + by[1] / 2)
    page.mouse.move(x + by[0], y + by[1])
    page.mouse.up()


def test_worst_keypoints_are_put_right_and_the_capture_fitted_again(
    watched: Watched, live: Live, wrong: tuple[str, str]
) -> None:
    dataset, fit = wrong
    page = watched.open(f"#/fits/{fit}?frame=10")
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    panel = page.get_by_role("region", name="Correct keypoints")
    panel.get_by_role("button", name="Correct keypoints").click()
    page.keyboard.press("w")
    worst = panel.locator(".worst-list .chip")
    expect(worst.first).to_have_attribute("aria-current", "true")
    frame = int((worst.first.text_content() or "").split()[0])
    expect(panel.locator(".of-keypoint caption")).to_have_text(f"k13 in frame {frame}")

    canvas = page.locator("figure.view canvas").first
    name, place = next(iter(settled_places(page, canvas).items()))
    drag(page, canvas, place, (30, -12))
    again = panel.get_by_role("button", name="Fit again with 1 correction")
    expect(again).to_be_visible()
    [moved] = corrections(live, dataset)
    keypoint = NAMES.index(name)
    assert (moved["frame"], moved["view"], moved["keypoint"]) == (frame, 0, keypoint)
    way = np.array(moved["position"]) - KEYPOINTS[frame, 0, keypoint]
    assert np.linalg.norm(way) > 10
    assert way[1] / way[0] == pytest.approx(-12 / 30, abs=0.25)  # one grips beside the middle
    expect(panel.get_by_role("row").first).to_contain_text("corrected")

    page.keyboard.press("Delete")
    expect(panel.get_by_role("row").first).to_contain_text("removed")
    wait_for(lambda: corrections(live, dataset)[0]["position"] is None, "saved")
    page.keyboard.press("Control+z")
    wait_for(lambda: corrections(live, dataset) == [moved], "saved")
    panel.get_by_role("button", name="Remove it from view 1").click()
    wait_for(lambda: len(corrections(live, dataset)) == 2, "saved")
    panel.get_by_role("button", name="As detected in view 1").click()
    wait_for(lambda: corrections(live, dataset) == [moved], "saved")

    focused = page.locator("figure.view canvas").nth(2)
    focused.focus()
    page.keyboard.press("Shift+ArrowRight")
    wait_for(lambda: len(corrections(live, dataset)) == 2, "saved")
    nudged = corrections(live, dataset)[1]
    shift = np.array(nudged["position"]) - KEYPOINTS[frame, 2, keypoint]
    assert shift.tolist() == pytest.approx([10, 0], abs=0.02)

    page.reload()  # all of it is stored
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    again = panel.get_by_role("button", name="Fit again with 2 corrections")
    with page.expect_response(lambda answer: answer.request.method == "POST") as queued:
        again.click()
    made = queued.value.json()
    live.http.post(f"/fits/{made['id']}/cancel")
    assert made["corrections"] == live.get(f"/datasets/{dataset}")["corrections"]
    assert made["corrections"]["count"] == 2


def test_who_corrects_at_the_same_time_is_heard_of(
    watched: Watched, live: Live, wrong: tuple[str, str]
) -> None:
    dataset, fit = wrong
    page = watched.open(f"#/fits/{fit}?frame=5")
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    panel = page.get_by_role("region", name="Correct keypoints")
    panel.get_by_role("button", name="Correct keypoints").click()
    panel.locator(".worst-list .chip").nth(1).click()
    other = {"frame": 5, "view": 0, "keypoint": 0, "position": None}
    changed = live.http.patch(f"/datasets/{dataset}/corrections", json={"correct": [other]})
    count = changed.json()["count"]
    panel.get_by_role("button", name="Remove it from view 1").click()
    expect(panel.get_by_role("alert")).to_contain_text("Somebody else corrected keypoints")
    expect(panel.get_by_role("status").first).to_contain_text(f"{count} keypoint")
    assert len(corrections(live, dataset)) == count
    panel.get_by_role("button", name="Remove it from view 1").click()
    wait_for(lambda: len(corrections(live, dataset)) == count + 1, "saved")
    expect(panel.get_by_role("alert")).to_have_count(0)
    watched.errors[:] = [each for each in watched.errors if "412" not in each]
