"""How far points may be off, as the result shows it: bands of curves, colours, hulls in 3D."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Locator, Page, expect

from tests.page.conftest import Watched
from tests.page.stored import NAMES, Stored
from tests.page.test_closer import knee_angles, opened
from tests.service.conftest import Live
from tests.waiting import wait_for


def answers(live: Live, stored: Stored, uncertainty: str = "sd") -> dict[str, NDArray[Any]]:
    """Return the arrays of the fit in the frame of reference that the page shows."""
    url = (
        f"/fits/{stored.fit}/reconstruction?frame=room&up=auto&format=npz&uncertainty={uncertainty}"
    )
    with np.load(io.BytesIO(live.http.get(url).content)) as arrays:
        return dict(arrays)


def knee_deviations(arrays: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return how far the left knee's angle may be off in each frame, in degrees.

    By the whole covariance of a frame's points, and derivatives by steps.
    """
    double = {name: array.astype(np.float64) for name, array in arrays.items() if "3d" in name}
    points, modes = double["points3d"], double["points3d_modes"]
    six = double["points3d_covariance"]
    frames, keypoints, _ = points.shape
    own = six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(frames, keypoints, 3, 3)
    shared = modes.reshape(frames, 3 * keypoints, -1)
    whole = shared @ shared.mT
    for p in range(keypoints):
        at = slice(3 * p, 3 * p + 3)
        whole[:, at, at] = own[:, p]
    steps = 1e-5 * np.eye(3 * keypoints).reshape(-1, 1, keypoints, 3)
    slopes = [(knee_angles(points + s) - knee_angles(points - s)) / 2e-5 for s in steps]
    gradient = np.stack(slopes, axis=-1)
    sds: NDArray[np.float64] = np.sqrt(np.einsum("ni,nij,nj->n", gradient, whole, gradient))
    return sds


def select(page: Page, *names: str) -> None:
    for name in names:
        page.get_by_label("Select a keypoint").fill(name)
        page.get_by_label("Select a keypoint").press("Enter")


def table(page: Page) -> tuple[list[str], NDArray[np.float64]]:
    """Save the curve that is shown; return the names of its columns, and what is in them."""
    with page.expect_download() as saved:
        page.get_by_role("button", name="CSV of the curve").click()
    head, *rows = Path(saved.value.path()).read_text().splitlines()
    numbers = [[float(cell or "nan") for cell in row.split(",")] for row in rows]
    return head.split(","), np.array(numbers)


def pixels(canvas: Locator) -> str:
    drawn: str = canvas.evaluate("(canvas) => canvas.toDataURL()")
    return drawn


def settled_pixels(page: Page, canvas: Locator) -> str:
    """Return the picture of a canvas once something is drawn in it that stays as it is."""
    nothing: str = canvas.evaluate(
        """(canvas) => {
          const { width, height } = canvas;
          return Object.assign(document.createElement("canvas"), { width, height }).toDataURL();
        }"""
    )
    before = ""
    for _ in range(100):
        shown = pixels(canvas)
        if shown == before != nothing:
            return shown
        before = shown
        page.wait_for_timeout(300)
    raise AssertionError("the picture does not settle within 30 seconds")


def test_a_position_has_a_band_and_a_speed_has_none(
    watched: Watched, live: Live, stored: Stored
) -> None:
    arrays = answers(live, stored)
    knee = NAMES.index("l_knee")
    page = opened(watched, stored)
    select(page, "l_knee")
    page.get_by_label("Curve over time").select_option("Position of l_knee")
    expect(page.locator(".curves .curve")).to_have_count(3)  # of unlike ranges
    names, rows = table(page)
    unit = "unit of the known length"
    assert names[2:] == [f"l_knee {axis}{sd} ({unit})" for axis in "xyz" for sd in ("", " sd")]
    np.testing.assert_allclose(rows[:, 2::2], arrays["points3d"][:, knee], atol=1e-5)
    off = arrays["points3d_sd"][:, knee]
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3::2], axis=1), off, rtol=1e-4)
    shown = page.locator(".curve-legend output").first
    expect(shown).to_have_text(re.compile(r"^-?[\d.]+\s±\s0\.0*[1-9]\d$"))
    expect(page.locator(".curves .curve").first).to_have_accessible_name(re.compile("usually ± 0"))

    page.get_by_label("Curve over time").select_option("Speed of l_knee")
    expect(page.locator(".curves")).to_contain_text("No band: errors of neighbouring frames")
    names, _ = table(page)
    assert len(names) == 3


def test_angles_and_lengths_have_deviations_by_what_points_share(
    watched: Watched, live: Live, stored: Stored
) -> None:
    expected = knee_deviations(answers(live, stored, "full"))
    page = opened(watched, stored)
    page.get_by_label("Curve over time").select_option("Knee")
    expect(page.locator(".curves")).to_contain_text("The band is one standard deviation")
    names, rows = table(page)
    sd = rows[:, names.index("left knee angle sd (degrees)")]
    np.testing.assert_allclose(sd, expected, rtol=2e-3)

    select(page, "l_hip", "l_knee")
    expect(page.locator(".measured")).to_have_text(
        re.compile(r"^l_hip . l_knee: [\d.]+\s±\s0\.0*[1-9]\d \(unit of the known length\)$")
    )


def test_colours_show_errors_or_how_far_points_may_be_off_as_was_chosen_last(
    watched: Watched, live: Live, stored: Stored
) -> None:
    largest = np.nanquantile(answers(live, stored)["points3d_sd"], 0.99)
    page = opened(watched, stored)
    heat = page.locator(".map canvas")
    expect(page.locator(".key")).to_contain_text(" px")
    errors = pixels(heat)
    page.get_by_label("Colours show").select_option("may be off by")
    expect(page.locator(".key")).to_contain_text("(unit of the known length)")
    limit = re.search(r"0\.\d+", page.locator(".key").inner_text().split("by")[-1])
    assert limit
    assert abs(float(limit[0]) / largest - 1) < 0.05
    wait_for(lambda: pixels(heat) != errors, "other colours", 30)
    heat.hover()
    words = re.compile(r"frame \d+: may be off by 0\.\d+")
    expect(page.locator(".timeline")).to_contain_text(words)
    page.reload()
    expect(heat).to_have_accessible_name(re.compile("Expected distances"))


def test_doubt_is_drawn_in_3d_as_was_chosen_last(watched: Watched, stored: Stored) -> None:
    page = opened(watched, stored)
    canvas = page.locator(".stage canvas")
    doubt = page.get_by_role("button", name="Doubt")
    expect(doubt).to_have_attribute("aria-pressed", "false")
    plain = settled_pixels(page, canvas)
    doubt.press("Enter")
    expect(doubt).to_have_attribute("aria-pressed", "true")
    wait_for(lambda: pixels(canvas) != plain, "hulls", 90)
    page.reload()
    expect(doubt).to_have_attribute("aria-pressed", "true")
    doubt.click()
    wait_for(lambda: pixels(canvas) == plain, "a scene without hulls", 30)
