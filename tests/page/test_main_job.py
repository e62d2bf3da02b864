"""The main job by clicking: files are dropped, fitted, looked at, taken away."""

import io
import re
from pathlib import Path

import numpy as np
from playwright.sync_api import FilePayload, Locator, Page, expect

from tests.page.conftest import Watched, deeplabcut_files
from tests.service.conftest import Live
from tests.waiting import wait_for

# Drops files on an element, as a mouse that carries them does.
DROP = """(zone, files) => {
  const carried = new DataTransfer();
  for (const [name, text] of files) carried.items.add(new File([text], name));
  const options = { dataTransfer: carried, bubbles: true, cancelable: true };
  for (const kind of ["dragover", "drop"]) zone.dispatchEvent(new DragEvent(kind, options));
}"""


def upload(page: Page, files: dict[str, bytes]) -> None:
    """Drop files, look at what was understood, and store that."""
    page.locator(".drop").evaluate(DROP, [[name, body.decode()] for name, body in files.items()])
    understood = page.get_by_role("region", name="What was understood")
    expect(understood).to_contain_text("60 frames, 3 views, 16 keypoints. Nothing is stored yet.")
    expect(understood.locator("canvas")).to_have_count(3)
    page.get_by_role("button", name="Store this capture").click()


FILM = (b"\x1aE\xdf\xa3", b"ftyp")  # what films in WebM begin with and, after four bytes, in MP4


def fit_quickly(page: Page) -> None:
    """Start a fit of few steps, which are among the advanced fields."""
    page.get_by_text("Advanced").click()
    page.get_by_label("Steps", exact=True).fill("30")
    page.get_by_label("Cameras", exact=True).select_option("moving")
    page.get_by_role("button", name="Start the fit").click()


def shows_frame(page: Page, frame: int) -> None:
    expect(page.get_by_role("slider", name="Frame")).to_have_value(str(frame))


def changed(drawing: Locator, before: bytes) -> bool:
    """Wait until a drawing is another."""
    return bool(wait_for(lambda: drawing.screenshot() != before, "another drawing", 30))


def test_files_become_a_result_that_is_looked_at_and_taken_away(
    watched: Watched, live: Live
) -> None:
    page = watched.open("#/datasets")
    page.get_by_role("link", name="New capture").click()
    upload(page, deeplabcut_files())

    expect(page.get_by_role("heading", name="walk")).to_be_visible()
    expect(page.get_by_text("60 frames, 3 views, 16 keypoints")).to_be_visible()
    expect(page.locator(".notes")).to_contain_text("DeepLabCut")
    expect(page.locator(".previews canvas")).to_have_count(3)
    page.get_by_label("From keypoint").select_option("l_hip")
    page.get_by_label("To keypoint").select_option("l_knee")
    page.get_by_label("Length, in metres").fill("0.42")
    fit_quickly(page)
    expect(page.get_by_role("progressbar")).to_be_visible()

    expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible(timeout=120_000)
    fit = live.get("/fits")["items"][0]
    assert (fit["name"], fit["config"]["steps"]) == ("walk", 30)
    assert fit["config"]["known_length"] == {"keypoints": [2, 4], "length": 0.42}
    look_at(page)
    take_away(page)


def look_at(page: Page) -> None:
    """Step, play, jump, turn, look through a camera: each shows another frame or angle."""
    shows_frame(page, 0)
    for key, frame in (("End", 59), ("ArrowLeft", 58), ("Shift+ArrowLeft", 48), ("Home", 0)):
        page.keyboard.press(key)
        shows_frame(page, frame)
    marks = page.locator(".marks button")
    worst = [re.findall(r"\d+", str(marks.nth(n).get_attribute("aria-label"))) for n in (0, 1)]
    assert [rank for _, rank, *_ in worst] == ["1", "2"]
    marks.first.click()
    shows_frame(page, int(worst[0][0]))
    page.get_by_role("button", name="Next of the worst frames").click()
    shows_frame(page, int(worst[1][0]))
    page.keyboard.press("Home")
    page.get_by_role("button", name="Play").click()
    expect(page.get_by_role("slider", name="Frame")).not_to_have_value("0")
    page.get_by_role("button", name="Pause").click()

    page.locator(".map canvas").click(position={"x": 5, "y": 2})
    shows_frame(page, 0)
    expect(page.get_by_text(re.compile("l_shoulder, frame 0: [0-9.]+ px"))).to_be_visible()
    page.mouse.move(0, 0)
    expect(page.get_by_text("l_shoulder is marked in all views")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_text("is marked in all views")).to_have_count(0)
    stage = page.locator(".stage canvas")
    before = stage.screenshot()
    stage.press("ArrowRight")
    assert changed(stage, before)
    before = stage.screenshot()
    page.keyboard.press("2")
    expect(page.get_by_role("button", name="Through cam2")).to_be_visible()
    assert changed(stage, before)
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="Through cam2")).to_have_count(0)

    panel = page.locator("figure.view").first
    before = panel.screenshot()
    photo = FilePayload(name="photo.png", mimeType="image/png", buffer=page.screenshot())
    panel.locator("input").set_input_files(photo)
    assert changed(panel, before)


def take_away(page: Page) -> None:
    """Save arrays, a picture and a link, each of which holds what its button names."""
    exports = page.locator("section", has=page.get_by_role("heading", name="Take it away"))
    with page.expect_download() as saved:
        exports.get_by_role("button", name="npz").first.click()
    with np.load(io.BytesIO(Path(saved.value.path()).read_bytes())) as arrays:
        assert arrays["points3d"].shape == (60, 16, 3)
    with page.expect_download() as saved:
        exports.get_by_role("button", name="TRC").click()
    assert Path(saved.value.path()).read_text().splitlines()[2].split("\t")[4] == "m"
    with page.expect_download() as saved:
        exports.get_by_role("button", name="PNG").click()
    assert Path(saved.value.path()).read_bytes().startswith(b"\x89PNG")
    page.get_by_label("Speed").select_option("4")
    with page.expect_download() as saved:
        exports.get_by_role("button", name="all frames").click()
    film = Path(saved.value.path()).read_bytes()
    assert film.startswith(FILM[0]) or film[4:].startswith(FILM[1])
    shows_frame(page, 59)

    page.keyboard.press("End")
    page.locator(".stage canvas").press("ArrowRight")
    exports.get_by_role("button", name="Copy link").click()
    page.wait_for_url(re.compile(r"frame=59&angle="))
    link = page.url
    page.goto("about:blank")
    page.goto(link)
    expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible()
    shows_frame(page, 59)
    page.get_by_role("button", name="Copy link").click()
    assert page.url == link
