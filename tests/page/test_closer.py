"""Looking closer at a result: keypoints under the pointer, what is measured of them."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from tests.page.conftest import Watched
from tests.page.stored import NAMES, Stored
from tests.service.conftest import Live
from tests.waiting import wait_for

GREEN = (90, 140, 90)


def opened(watched: Watched, stored: Stored) -> Page:
    page = watched.open(f"#/fits/{stored.fit}?frame=10")
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    return page


def settled_places(page: Page, canvas: Locator) -> dict[str, tuple[float, float]]:
    """Return the places of names once the canvas is drawn, and they stay where they are."""
    before: dict[str, tuple[float, float]] = {}
    places = named_places(canvas)
    while not places or places != before:
        page.wait_for_timeout(200)
        before, places = places, named_places(canvas)
    return places


def named_places(canvas: Locator) -> dict[str, tuple[float, float]]:
    """Return the places of a canvas where the pointer meets a keypoint's name, by that name.

    The pointer is at every third pixel, faster than a hand moves it; the middle of those where a
    name is shown is as far from other names as can be.
    """
    found: dict[str, list[tuple[float, float]]] = canvas.evaluate(
        """(canvas) => {
          const box = canvas.getBoundingClientRect();
          const tip = canvas.parentElement.querySelector(".name-tip");
          const found = {};
          for (let y = 3; y < box.height; y += 3) {
            for (let x = 3; x < box.width; x += 3) {
              const at = { clientX: box.x + x, clientY: box.y + y, bubbles: true };
              canvas.dispatchEvent(new PointerEvent("pointermove", at));
              if (!tip.hidden) (found[tip.textContent] ??= []).push([x, y]);
            }
          }
          return found;
        }"""
    )
    middles = {name: np.mean(places, 0).tolist() for name, places in found.items()}
    return {name: (x, y) for name, (x, y) in middles.items()}


def click(canvas: Locator, place: tuple[float, float], *, more: bool = False) -> None:
    canvas.click(
        position={"x": place[0], "y": place[1]}, modifiers=["Shift"] if more else [], force=True
    )


def test_keypoints_are_named_and_selected_where_they_are_drawn(
    watched: Watched, stored: Stored
) -> None:
    page = opened(watched, stored)
    chips = page.locator(".keypoint-choice .chip")
    caption = page.locator(".timeline")
    for canvas in (page.locator(".stage canvas"), page.locator("figure.view canvas").first):
        places = settled_places(page, canvas)
        assert len(places) > len(NAMES) / 2
        assert set(places) <= set(NAMES)
        first, second, third, fourth = list(places)[:4]
        click(canvas, places[first])
        expect(caption).to_contain_text(f"{first} is marked in all views")
        expect(page.locator(".map .row")).to_have_count(1)
        click(canvas, places[first])
        expect(chips).to_have_count(0)
        click(canvas, places[first])
        click(canvas, places[second])  # in the place of the first
        expect(chips).to_have_count(1)
        for name in (first, third, fourth):  # the last takes the place of the oldest
            click(canvas, places[name], more=True)
        expect(caption).to_contain_text(f"{first}, {third}, {fourth} are marked")
        expect(page.locator(".map .row")).to_have_count(3)
        page.keyboard.press("Escape")
        expect(chips).to_have_count(0)


def test_keypoints_are_selected_by_typing_and_given_up_by_key(
    watched: Watched, stored: Stored
) -> None:
    page = opened(watched, stored)
    field = page.get_by_label("Select a keypoint")
    chips = page.locator(".keypoint-choice .chip")
    field.press_sequentially("l_kn")
    field.press("Enter")
    expect(chips).to_have_text(["l_knee : no longer select it"])
    field.press_sequentially("knee")
    field.press("Enter")
    expect(page.get_by_text("of no keypoint, or of several")).to_be_visible()
    field.fill("r_knee")
    field.press("Enter")
    expect(chips).to_have_count(2)
    chips.first.press("Space")
    expect(chips).to_have_text(["r_knee : no longer select it"])
    expect(page.get_by_role("button", name="Play")).to_be_visible()


def knee_angles(points: NDArray[Any]) -> NDArray[np.float64]:
    """Return the angle at the left knee, by the law of cosines, in degrees."""
    hip, knee, ankle = (points[:, NAMES.index(f"l_{part}")] for part in ("hip", "knee", "ankle"))
    a, b, c = (np.linalg.norm(x - y, axis=1) for x, y in ((hip, knee), (ankle, knee), (hip, ankle)))
    angles: NDArray[np.float64] = np.degrees(np.arccos((a**2 + b**2 - c**2) / (2 * a * b)))
    return angles


def shows_angle(place: Locator, degrees: float) -> bool:
    """Return whether a place has an angle, to the digits of its standard deviation."""
    shown = re.search(r"([\d.]+)°\s±\s[\d.]+°", place.inner_text())
    return shown is not None and abs(float(shown[1]) - degrees) < 0.06


def test_the_angle_of_a_knee_is_a_curve_that_is_sought_on_and_saved(
    watched: Watched, live: Live, stored: Stored
) -> None:
    page = opened(watched, stored)
    page.get_by_label("Curve over time").select_option("Knee")
    with page.expect_download() as saved:
        page.get_by_role("button", name="CSV of the curve").click()
    table = Path(saved.value.path()).read_text().splitlines()
    assert table[0].split(",") == [
        *("frame", "seconds"),
        *(f"{side} knee angle{sd} (degrees)" for side in ("left", "right") for sd in ("", " sd")),
    ]
    rows = np.array([[float(cell or "nan") for cell in line.split(",")] for line in table[1:]])
    url = f"/fits/{stored.fit}/reconstruction?frame=room&up=auto&format=npz"
    with np.load(io.BytesIO(live.http.get(url).content)) as arrays:
        angles = knee_angles(arrays["points3d"].astype(np.float64))
    np.testing.assert_allclose(rows[:, 1], rows[:, 0] / 50, atol=1e-6)
    np.testing.assert_allclose(rows[:, 2], angles, atol=1e-3)

    plot = page.locator(".curves .u-over")
    box = plot.bounding_box()
    assert box is not None
    plot.click(position={"x": box["width"] * 0.5, "y": 20})
    expect(page.get_by_role("slider", name="Frame")).to_have_value(re.compile("19|20"))
    frame = int(page.get_by_role("slider", name="Frame").input_value())
    shown = page.locator(".curve-legend output").first
    wait_for(lambda: shows_angle(shown, angles[frame]), "the angle", 30)

    for name in ("l_hip", "l_knee", "l_ankle"):
        page.get_by_label("Select a keypoint").fill(name)
        page.get_by_label("Select a keypoint").press("Enter")
    measured = page.locator(".measured")
    expect(measured).to_contain_text("Angle at l_knee, between l_hip and l_ankle: ")
    wait_for(lambda: shows_angle(measured, angles[frame]), "the angle", 30)
    page.get_by_label("Curve over time").select_option("Speed of l_hip, l_knee, l_ankle")
    expect(page.locator(".curve-legend output")).to_have_count(3)
    expect(page.locator(".curves .curve")).to_have_accessible_name(re.compile("per second"))
    page.keyboard.press("Escape")
    expect(page.locator(".curves")).to_have_count(0)


def test_a_range_of_frames_is_saved_and_a_picture_under_a_view_moved_and_removed(
    watched: Watched, stored: Stored, tmp_path: Path
) -> None:
    page = opened(watched, stored)
    page.get_by_label("First frame of the file").fill("5")
    page.get_by_label("Last frame of the file").fill("9")
    with page.expect_download() as saved:
        page.get_by_role("button", name="npz").first.click()
    with np.load(saved.value.path()) as arrays:
        assert arrays["points3d"].shape == (5, len(NAMES), 3)
    picture = tmp_path / "picture.png"
    Image.new("RGB", (640, 480), GREEN).save(picture)
    view = page.locator("figure.view").first

    def shown() -> bool:
        pixels = np.array(Image.open(io.BytesIO(view.screenshot())).convert("RGB"))
        return bool((pixels == GREEN).all(-1).any())

    view.locator("input[type=file]").set_input_files(picture)
    wait_for(shown, "the picture", 30)
    page.get_by_label("Offset in frames").fill("-11")  # frame 10 is before the first picture
    wait_for(lambda: not shown(), "a view without it", 30)
    page.get_by_label("Offset in frames").fill("-10")
    wait_for(shown, "the picture", 30)
    page.get_by_role("button", name="Remove the video or images").click()
    wait_for(lambda: not shown(), "a view without it", 30)
    expect(page.get_by_label("Offset in frames")).to_have_count(0)


def test_five_settings_are_before_the_others_and_help_comes_when_asked_for(
    watched: Watched, stored: Stored
) -> None:
    page = watched.open(f"#/datasets/{stored.dataset}")
    page.get_by_text("Advanced").click()
    labels = page.locator(".fields.advanced label:visible")
    expect(labels).to_have_count(5)
    about = page.locator("#about-cameras_alike")
    expect(about).to_be_hidden()
    page.get_by_role("button", name="What Cameras alike means").press("Enter")
    expect(about).to_be_visible()
    assert "`" not in page.locator(".config").inner_text()
    page.get_by_text("All other settings").click()
    assert labels.count() > 10
