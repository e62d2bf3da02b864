"""Lists after a month: searched, sorted, tagged, compared, deleted from, and come back to."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect

from store.database import Store
from store.settings import StoreSettings
from store.version import VERSION
from tests.page.conftest import HAND, Watched, watch
from tests.page.stored import EDGES, KEYPOINTS, NAMES, SKELETON, Stored, walking
from tests.service.conftest import BYTES, Live, kill_service, start_service, to_npz
from tests.service.stored_fits import put_fit
from tests.waiting import wait_for

DATASETS, FITS = 200, 60
LONG_NAME = "a" * 100 + " " + "b" * 99


@pytest.fixture(scope="module")
def month(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """Serve what a month leaves: the oldest dataset has two fits with results."""
    live = start_service(tmp_path_factory.mktemp("month"))
    capture = {"keypoint_names": np.array(NAMES), "edges": np.array(EDGES), "fps": 50.0}
    first = to_npz(keypoints=KEYPOINTS, **capture)
    small = to_npz(keypoints=KEYPOINTS[:2], **capture)
    try:
        ids = []
        for number in range(DATASETS):
            name = LONG_NAME if number == DATASETS - 1 else f"session {number}"
            body = small if number else first
            made = live.http.post("/datasets", params={"name": name}, content=body, headers=BYTES)
            ids.append(made.raise_for_status().json()["id"])
        with closing(Store(StoreSettings(data_dir=live.data_dir))) as records:
            for number in range(2):
                name = f"walk {number}"
                put_fit(records, ids[0], walking(), KEYPOINTS, name=name, skeleton=SKELETON)
        for number in range(FITS - 2):
            seeded = {"config": {"seed": number}} if number % 2 else {}
            asked = {"dataset_id": ids[number + 1], "name": f"try {number}", **seeded}
            made = live.http.post("/fits", json=asked)
            live.http.post(f"{made.headers['Location']}/cancel").raise_for_status()
        yield live
    finally:
        kill_service(live)


@pytest.fixture
def page(context: BrowserContext, month: Live) -> Iterator[Page]:
    watched = watch(context.new_page(), month.url)
    yield watched.open()
    assert (watched.errors, watched.foreign) == ([], [])


def test_all_datasets_are_searched_sorted_tagged_and_deleted(page: Page, month: Live) -> None:
    page.get_by_role("link", name="Datasets").click()
    rows = page.get_by_role("table", name="Datasets").locator("tbody tr")
    expect(rows).to_have_count(50)
    page.get_by_role("button", name="Older datasets").click()
    expect(rows).to_have_count(100)
    page.get_by_label("Search datasets").fill("session 19")
    expect(rows).to_have_count(11)  # 19, 119, 190 to 198
    page.get_by_label("Choose session 19", exact=True).check()
    page.get_by_label("Choose session 190").check()
    page.get_by_label("Tag for those chosen").fill("pilot")
    page.keyboard.press("Enter")
    expect(rows.filter(has=page.get_by_role("button", name="pilot"))).to_have_count(2)
    page.get_by_role("button", name="Choose none").click()
    page.get_by_label("Search datasets").fill("")
    rows.get_by_role("button", name="pilot").first.click()
    expect(rows).to_have_count(2)
    page.get_by_label("Choose all that are shown").check()
    page.get_by_role("button", name="Delete").click()
    expect(page.get_by_text("Delete these 2 datasets for good?")).to_be_visible()
    page.get_by_role("button", name="Yes, delete them").click()
    expect(page.get_by_text("None of your datasets is like that.")).to_be_visible()
    assert month.http.get("/datasets?tag=pilot").json()["items"] == []
    page.get_by_label("No longer only those tagged pilot").click()
    page.get_by_role("button", name="Frames", exact=True).click()
    expect(rows).to_have_count(DATASETS - 2)
    expect(rows.first).to_contain_text("session 0")
    page.reload()
    expect(rows.first).to_contain_text("session 0")


def test_fits_name_old_datasets_and_are_compared(page: Page) -> None:
    rows = page.get_by_role("table", name="Fits").locator("tbody tr")
    expect(rows).to_have_count(50)
    page.get_by_role("button", name="Older fits").click()
    expect(rows).to_have_count(FITS)
    expect(rows.filter(has_text="walk 1")).to_contain_text("session 0")
    page.get_by_label("Status").select_option("succeeded")
    expect(rows).to_have_count(2)
    expect(rows.first.locator("[data-title=Version]")).to_have_text(VERSION)
    page.get_by_label("Status").select_option("")
    page.get_by_label("Search fits").fill("try 1")
    page.get_by_label("Choose try 1", exact=True).check()
    page.get_by_label("Choose try 11").check()
    page.get_by_role("link", name="Compare").click()
    expect(page.get_by_role("heading", name="2 fits compared")).to_be_visible()
    seeds = page.get_by_role("row", name="seed")
    expect(seeds).to_contain_text("1")
    expect(seeds).to_contain_text("11")
    expect(page.get_by_role("row", name="Version of Fewview")).to_contain_text(VERSION)


def test_an_old_capture_is_offered_live(page: Page) -> None:
    page.get_by_role("link", name="Live").click()
    expect(page.get_by_label("Capture")).to_contain_text("session 0")


def test_who_comes_back_is_where_he_was(page: Page) -> None:
    page.get_by_role("link", name="Datasets").click()
    row = page.get_by_role("link", name="session 160")
    row.scroll_into_view_if_needed()
    before = page.evaluate("scrollY")
    assert before > 300
    row.click()
    expect(page.get_by_role("heading", name="session 160")).to_be_visible()
    assert page.evaluate("scrollY") == 0
    page.go_back()
    expect(row).to_be_visible()
    wait_for(lambda: abs(page.evaluate("scrollY") - before) < 2, "the place where the list was")


def test_names_of_200_letters_fit_in_the_hand(browser: Browser, month: Live) -> None:
    with browser.new_context(viewport=HAND) as context:
        watched = watch(context.new_page(), month.url)
        page = watched.open("#/datasets")
        page.get_by_role("link", name=LONG_NAME).click()
        for back in (True, False):
            expect(page.get_by_role("heading", level=1)).to_be_visible()
            assert page.evaluate("document.documentElement.scrollWidth") <= HAND["width"]
            if back:
                page.go_back()


def test_what_a_deletion_leaves_unplayable_is_said_before_and_after(
    context: BrowserContext, month: Live
) -> None:
    watched = watch(context.new_page(), month.url)
    walk = month.http.get("/fits?search=walk 0").json()["items"][0]
    page = watched.open(f"#/datasets/{walk['dataset_id']}")
    page.get_by_role("button", name="Delete this dataset").click()
    expect(page.get_by_role("alert")).to_contain_text(
        "The results of 2 fits can no longer be played"
    )
    page.get_by_role("button", name="Yes, delete it").click()
    expect(page.get_by_role("heading", name="Datasets")).to_be_visible()
    watched.open(f"#/fits/{walk['id']}")
    left = page.get_by_role("region", name="What is left")
    expect(left).to_contain_text("Its dataset was deleted")
    with page.expect_download() as saved:
        left.get_by_role("button", name="npz").click()
    with np.load(saved.value.path()) as arrays:
        assert arrays["points3d"].shape == (40, 16, 3)
    watched.open("#/fits?status=succeeded")
    expect(page.get_by_role("table", name="Fits")).to_contain_text("deleted: it cannot be played")
    assert watched.foreign == []
    assert all("404" in error for error in watched.errors), watched.errors


def test_keys_are_those_of_a_control_first_and_letters_can_be_switched_off(
    watched: Watched, stored: Stored
) -> None:
    page = watched.open(f"#/fits/{stored.fit}")
    frame = page.get_by_role("slider", name="Frame")
    expect(frame).to_have_value("0")
    page.get_by_text("Keys", exact=True).focus()
    page.keyboard.press("Space")  # opens what is under it, and plays nothing
    letters = page.get_by_label("Letters and digits act by themselves")
    expect(letters).to_be_checked()
    page.keyboard.press("w")
    expect(frame).not_to_have_value("0")
    worst = frame.input_value()
    page.keyboard.press("Home")
    letters.focus()
    page.keyboard.press("Space")
    expect(letters).not_to_be_checked()
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    page.keyboard.press("w")
    expect(frame).to_have_value("0")
    letters.check()
    page.keyboard.press("w")
    expect(frame).to_have_value(worst)
