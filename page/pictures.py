"""Take the pictures of README with the machine's own chromium: `python page/pictures.py`.

Fits the example capture with a service of its own, which takes a minute or two, and shows the
result on the page. Writes `docs/pictures/`.
"""

import io
import json
import shutil
import sys
from pathlib import Path

import httpx2
from fewview.client import Client
from fewview.commands.open_page import page_address
from fewview.embedded import running_service
from PIL import Image
from playwright.sync_api import Page, ViewportSize, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
CAPTURE = ROOT / "examples" / "three_actors.npz"
PICTURES = ROOT / "docs" / "pictures"
SIZE = ViewportSize(width=1280, height=920)
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
CONFIG = {"known_length": {"keypoints": ["lfemur", "ltibia"], "length": 0.42}}
FIRST, FRAMES = 96, 40  # of the animation: a stretch in which somebody walks
ANIMATION_WIDTH, FRAME_MS = 860, 80
COLOURS = 256  # of a picture: flat areas need no more


def main() -> None:
    """Fit, look, write."""
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("pictures.py: chromium is not installed")
    PICTURES.mkdir(exist_ok=True)
    with running_service() as address, sync_playwright() as playwright:
        fit = fitted(address)
        with Client(address) as client:
            shown = page_address(client, f"/fits/{fit}?frame={FIRST + FRAMES}")
        browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
        for scheme in ("light", "dark"):
            page = browser.new_page(viewport=SIZE, color_scheme=scheme)
            page.goto(shown)
            page.get_by_role("heading", name="Figures").wait_for()
            page.wait_for_timeout(1500)  # the heat map comes when there is nothing else to do
            save_picture(page.screenshot(), PICTURES / f"result-{scheme}.png")
            if scheme == "light":
                save_animation(page, PICTURES / "result.webp")
        browser.close()


def fitted(address: str) -> str:
    """Store and fit the capture; return the fit's identifier."""
    with httpx2.Client(base_url=address, timeout=600, trust_env=False) as client:
        octets = {"Content-Type": "application/octet-stream"}
        name = {"name": "three actors"}
        body = CAPTURE.read_bytes()
        dataset = client.post("/datasets", params=name, content=body, headers=octets).json()
        asked = {"dataset_id": dataset["id"], "name": "three actors", "config": CONFIG}
        fit = client.post("/fits", json=asked).json()
        with client.stream("GET", f"/fits/{fit['id']}/events") as events:
            for event in httpx2.EventSource(events):
                if event.event == "end":
                    assert json.loads(event.data)["status"] == "succeeded", event.data  # noqa: S101
        return str(fit["id"])


def save_picture(png: bytes, file: Path) -> None:
    """Write a screenshot with few colours."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.quantize(COLOURS, kmeans=2, dither=Image.Dither.NONE).save(file, optimize=True)


def save_animation(page: Page, file: Path) -> None:
    """Step through some frames, and write what structure and views show of them."""
    slider, screens = page.get_by_role("slider", name="Frame"), page.locator(".screens")
    pictures = []
    for frame in range(FIRST, FIRST + FRAMES):
        slider.fill(str(frame))
        page.wait_for_timeout(120)
        shown = Image.open(io.BytesIO(screens.screenshot())).convert("RGB")
        height = round(shown.height * ANIMATION_WIDTH / shown.width)
        pictures.append(shown.resize((ANIMATION_WIDTH, height), Image.Resampling.LANCZOS))
    first, *others = pictures
    first.save(
        file, save_all=True, append_images=others, duration=FRAME_MS, loop=0, quality=45, method=6
    )


if __name__ == "__main__":
    main()
