"""The page behind a proxy and with keys, in the hand and in the dark, and for who cannot see it."""

import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, ViewportSize, expect
from scipy.spatial.transform import Rotation

from tests.models.walk import film, walk
from tests.page.conftest import JOINTS, Watched, watch
from tests.page.project import checked_out
from tests.page.proxy import proxied
from tests.service.conftest import (
    BYTES,
    Live,
    kill_service,
    start_service,
    to_npz,
    wait_for,
)
from tests.sharing import made_once

MOMENTS = np.arange(0, 80, 2, dtype=np.float64)  # of the frames
SCREENS = ("", "#/datasets/new", "#/datasets/{dataset}", "#/fits/{fit}", "#/fits/{failed}")


@pytest.fixture(scope="module")
def stored(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return identifiers and data folder of what is stored: by the first of the test processes."""

    def make() -> bytes:
        folder = tmp_path_factory.mktemp("prepared")
        live = start_service(folder / "data")
        try:
            return json.dumps({"folder": str(folder / "data"), **store(live)}).encode()
        finally:
            kill_service(live)

    made: dict[str, str] = json.loads(made_once(tmp_path_factory, "page-data", make))
    return made


def store(live: Live) -> dict[str, str]:
    """Store a capture, a fit of it that succeeds, and one that fails."""
    names = [*JOINTS, *(f"k{index}" for index in range(len(JOINTS), 16))]
    captures: dict[str, dict[str, Any]] = {
        "dataset": {
            "keypoints": film([10, 130, 250], MOMENTS, noise=1),
            "points3d": walk(MOMENTS),
            "keypoint_names": np.array(names),
            "fps": 50.0,
        },
        "empty": {"keypoints": np.full((3, 2, 5, 2), np.nan)},
    }
    ids = {}
    for name, arrays in captures.items():
        made = live.http.post(f"/datasets?name={name}", content=to_npz(**arrays), headers=BYTES)
        assert made.status_code == 201, made.text
        ids[name] = made.json()["id"]
    length = {"keypoints": [0, 2], "length": 0.5}
    for name, dataset in (("fit", ids["dataset"]), ("failed", ids["empty"])):
        fit = live.fit(dataset, cameras="static", known_length=length)
        ids[name] = live.finished(fit["id"])["id"]
    return ids


@pytest.fixture(scope="module")
def live(stored: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """Serve a copy of what is stored."""
    data = tmp_path_factory.mktemp("page") / "data"
    shutil.copytree(stored["folder"], data, ignore=shutil.ignore_patterns("*.sock"))
    service = start_service(data)
    try:
        yield service
    finally:
        kill_service(service)


def test_behind_a_prefix_the_page_asks_for_a_key_and_keeps_it(
    context: BrowserContext, live: Live, stored: dict[str, str]
) -> None:
    made = live.http.post("/keys", json={"name": "browser", "scopes": ["read"]}).json()
    with proxied(live.url, "/lab/fewview") as base:
        watched = watch(context.new_page(), base)
        page = watched.open(f"#/fits/{stored['fit']}")
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


def test_static_cameras_are_shown_in_their_room_and_looked_through(
    watched: Watched, stored: dict[str, str]
) -> None:
    page = watched.open(f"#/fits/{stored['fit']}?frame=20")
    expect(page.get_by_text("In the room: y up")).to_be_visible()
    expect(page.get_by_text("unit of the known length").first).to_be_visible()
    page.keyboard.press("c")
    labels = page.locator(".labels button")
    expect(labels.first).to_be_visible()
    assert labels.count() == 3
    labels.nth(1).click()
    expect(page.get_by_role("button", name="Through view 1")).to_be_visible()
    expect(labels.first).to_be_hidden()
    page.locator(".stage canvas").drag_to(page.locator(".stage canvas"), force=True)
    expect(page.get_by_role("button", name="Through view 1")).to_have_count(0)
    page.get_by_label("mark").select_option("l_knee")
    expect(page.get_by_text("l_knee is marked in all views")).to_be_visible()


def test_the_truth_is_laid_over_the_structure(
    watched: Watched, live: Live, stored: dict[str, str]
) -> None:
    page = watched.open(f"#/fits/{stored['fit']}")
    stage = page.locator(".stage canvas")
    expect(stage).to_be_visible()
    before = stage.screenshot()
    page.get_by_label("Laid over the structure").select_option("the ground truth")
    wait_for(lambda: stage.screenshot() != before, "a drawing of both", 30)
    shown = page.locator(".figures div", has_text="Distance from the truth").locator("dd")
    url = f"/fits/{stored['fit']}/reconstruction?frame=room&up=auto&format=npz"
    with np.load(io.BytesIO(live.http.get(url).content)) as arrays:
        found = arrays["points3d"].reshape(-1, 3).astype(np.float64)
    truth = walk(MOMENTS).reshape(-1, 3)
    known = np.isfinite(found).all(1)
    found, truth = (each[known] - each[known].mean(0) for each in (found, truth))
    turn, _ = Rotation.align_vectors(found, truth)
    off = found - turn.apply(truth) * np.linalg.norm(found) / np.linalg.norm(truth)
    mean = float(np.linalg.norm(off, axis=1).mean())
    assert float(shown.inner_text().split()[0]) == pytest.approx(mean, rel=0.01)


def test_a_failed_fit_says_what_to_do(watched: Watched, stored: dict[str, str]) -> None:
    page = watched.open(f"#/fits/{stored['failed']}")
    expect(page.get_by_role("heading", name="This fit failed")).to_be_visible()
    expect(page.get_by_text("Look at the dataset")).to_be_visible()
    page.get_by_role("link", name="To its dataset, to fit it again").click()
    expect(page.get_by_role("button", name="Start the fit")).to_be_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_screen_fits_a_telephone(
    browser: Browser, live: Live, stored: dict[str, str], scheme: Any
) -> None:
    size = ViewportSize(width=390, height=844)
    with browser.new_context(viewport=size, color_scheme=scheme, has_touch=True) as context:
        watched = watch(context.new_page(), live.url)
        for screen in SCREENS:
            page = watched.open(screen.format(**stored))
            expect(page.get_by_role("heading", level=1)).to_be_visible()
            if "{fit}" in screen:
                expect(page.get_by_role("heading", name="Figures")).to_be_visible()
            assert page.evaluate("document.documentElement.scrollWidth") <= size["width"], screen
        assert (watched.errors, watched.foreign) == ([], [])


def test_nothing_keeps_the_page_from_who_cannot_see_it(
    browser: Browser,
    live: Live,
    stored: dict[str, str],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Axe, which examines roles, names and contrast, has no serious objection."""
    axe = checked_out(tmp_path_factory) / "node_modules" / "axe-core" / "axe.min.js"
    schemes: dict[Any, tuple[str, ...]] = {"light": SCREENS, "dark": SCREENS[3:4]}
    for scheme, screens in schemes.items():
        with browser.new_context(color_scheme=scheme, bypass_csp=True) as context:
            watched = watch(context.new_page(), live.url)
            for screen in screens:
                page = watched.open(screen.format(**stored))
                expect(page.get_by_role("heading", level=1)).to_be_visible()
                if "{fit}" in screen:
                    expect(page.get_by_role("heading", name="Figures")).to_be_visible()
                page.add_script_tag(path=axe)
                found = page.evaluate("axe.run()")
                serious = [
                    (each["id"], [node["html"] for node in each["nodes"]])
                    for each in found["violations"]
                    if each["impact"] in ("serious", "critical")
                ]
                assert serious == [], f"{screen} {scheme}"
