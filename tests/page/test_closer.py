"""Looking closer at a result: keypoints under the pointer, what is measured of them."""

import numpy as np
from playwright.sync_api import Locator, Page, expect

from tests.page.conftest import Watched
from tests.page.stored import NAMES, Stored


def opened(watched: Watched, stored: Stored) -> Page:
    page = watched.open(f"#/fits/{stored.fit}?frame=10")
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    return page


def named_places(page: Page, canvas: Locator) -> dict[str, tuple[float, float]]:
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
        places = named_places(page, canvas)
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
