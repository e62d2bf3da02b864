"""The page behind a proxy and with keys, in the hand and in the dark, and for who cannot see it."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, ViewportSize, expect

from tests.page.conftest import HAND, watch
from tests.page.project import checked_out
from tests.page.proxy import proxied
from tests.page.stored import Stored
from tests.service.conftest import Live
from tests.service.resources.test_folders import VIEWS, frame_files

SCREENS = (
    "",
    "#/datasets",
    "#/datasets/new",
    "#/datasets/{dataset}",
    "#/models",
    "#/models/{model}",
    "#/storage",
    "#/live",
    "#/fits/{fit}",
    "#/fits/{failed}",
    "#/fits/comparison?id={fit}&id={again}",
)
COLOURED = ("", "#/models/{model}", "#/storage", "#/fits/{fit}")  # whose colours are all there are
LISTS = ("", "#/datasets", "#/models")
FOLDER = ".drop input[webkitdirectory]"
DESK = ViewportSize(width=1280, height=800)


def test_behind_a_prefix_the_page_asks_for_a_key_and_keeps_it(
    context: BrowserContext, live: Live, stored: Stored
) -> None:
    made = live.http.post("/keys", json={"name": "browser", "scopes": ["read", "lift"]}).json()
    with proxied(live.url, "/lab/fewview") as base:
        watched = watch(context.new_page(), base)
        page = watched.open(f"#/fits/{stored.fit}")
        expect(page.get_by_role("heading", name="This service needs a key")).to_be_visible()
        page.get_by_label("Key").fill("fewview_" + "x" * 43)
        page.get_by_role("button", name="Go on").click()
        expect(page.get_by_text("That key was refused")).to_be_visible()
        page.get_by_label("Key").fill(made["token"])
        page.get_by_role("button", name="Go on").click()
        expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible()
        with page.expect_download() as saved:
            page.get_by_role("button", name="npz").first.click()
        with np.load(io.BytesIO(Path(saved.value.path()).read_bytes())) as arrays:
            assert arrays["points3d"].shape == (40, 16, 3)
        page.reload()
        expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible()
        assert watched.foreign == []
        assert all("401" in error for error in watched.errors), watched.errors


def test_the_bare_address_lets_nobody_in_and_the_printed_one_does(
    context: BrowserContext, live: Live
) -> None:
    page = context.new_page()
    page.goto(live.url)
    needed = page.get_by_role("heading", name="This service needs a key")
    expect(needed).to_be_visible()
    expect(page.get_by_text("fewview open")).to_be_visible()
    printed = f"{live.url}/#key={live.page_key}/models"
    page.goto(printed)  # in the tab that asks for it, which loads nothing anew
    expect(page.get_by_role("heading", name="Models", level=1)).to_be_visible()
    assert page.url == f"{live.url}/#/models"
    page.evaluate("sessionStorage.setItem('fewview-key', 'of an earlier start')")
    page.reload()
    page.get_by_label("Key").fill(printed)  # the whole of what was printed
    page.get_by_role("button", name="Go on").click()
    expect(page.get_by_role("heading", name="Models", level=1)).to_be_visible()
    page.goto(f"{live.url}/docs")  # whose requests have the key, too
    expect(page.get_by_role("button", name="Authorize")).to_have_class(re.compile("locked"))


def test_anothers_page_at_localhost_is_not_the_owners(context: BrowserContext, live: Live) -> None:
    """As if another user listened on ::1: the browser takes its page for one of the same origin."""
    there = live.url.replace("127.0.0.1", "localhost")
    page = context.new_page()
    page.route(f"{there}/", lambda route: route.fulfill(body="mine", content_type="text/html"))
    page.goto(f"{there}/")
    for method, path in (("GET", "/datasets"), ("GET", "/page-key"), ("POST", "/keys")):
        asked = f"fetch('{path}', {{method: '{method}'}}).then(answer => answer.status)"
        assert page.evaluate(asked) == 401, path


def opened(page: Page, screen: str, files: Path) -> None:
    """Wait until a screen shows all that it will, and open what is folded on it."""
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    if screen == "#/fits/{fit}":
        expect(page.get_by_role("heading", name="Figures")).to_be_visible()
    if "{failed}" in screen:
        expect(page.get_by_role("heading", name="This fit failed")).to_be_visible()
    if screen == "#/datasets/new":
        page.set_input_files(FOLDER, files)
        expect(page.get_by_role("region", name="What was understood")).to_contain_text("3 views")
    if screen in LISTS:
        page.locator("tbody input[type=checkbox]").first.check()
        expect(page.get_by_role("button", name="Delete").first).to_be_visible()
    if screen == "#/fits/{fit}":
        page.get_by_label("Curve over time").select_option("Knee")
        expect(page.locator(".u-wrap").first).to_be_visible()
    for _ in range(3):  # some are within others, and made as these open
        page.evaluate("document.querySelectorAll('details').forEach((fold) => fold.open = true)")
        page.wait_for_timeout(100)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_screen_fits_hand_and_desk_and_who_cannot_see_it(
    browser: Browser,
    live: Live,
    stored: Stored,
    scheme: Any,
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
) -> None:
    """Axe, which examines roles, names and contrast, has no serious objection."""
    axe = checked_out(tmp_path_factory) / "node_modules" / "axe-core" / "axe.min.js"
    # What does not depend on colours is examined once.
    light = scheme == "light"
    for v, values in enumerate(VIEWS):
        frame_files(tmp_path / f"cam{v}", values)
    screens, rules = (SCREENS, "{}") if light else (COLOURED, "{runOnly: ['color-contrast']}")
    with browser.new_context(
        viewport=HAND, color_scheme=scheme, has_touch=True, bypass_csp=True
    ) as context:
        watched = watch(context.new_page(), live.url)
        for screen in screens:
            page = watched.open(stored.at(screen))
            opened(page, screen, tmp_path)
            wide = "document.documentElement.scrollWidth"
            assert page.evaluate(wide) <= HAND["width"], screen
            page.add_script_tag(path=axe)
            found = page.evaluate(f"axe.run(document, {rules})")
            serious = [
                (each["id"], [node["html"] for node in each["nodes"]])
                for each in found["violations"]
                if each["impact"] in ("serious", "critical")
            ]
            assert serious == [], f"{screen} {scheme}"
            page.set_viewport_size(DESK)
            assert page.evaluate(wide) <= DESK["width"], screen
            page.set_viewport_size(HAND)
        assert (watched.errors, watched.foreign) == ([], [])
