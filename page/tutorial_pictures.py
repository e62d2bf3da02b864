"""Take the pictures of the tutorials with the machine's own chromium.

    python page/tutorial_pictures.py

Fits the practice files of each tutorial with a service of its own, and shows the results on the
page. Writes `docs/pictures/`.
"""

import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import fewview
from fewview.commands.open_page import page_address
from fewview.embedded import running_service
from pictures import PICTURES, ROOT, SOFTWARE, save_picture
from playwright.sync_api import ViewportSize, sync_playwright

SIZE = ViewportSize(width=1280, height=800)


class Tutorial(NamedTuple):
    """How its files are read and fitted, and the frame that is shown."""

    files: str
    options: dict[str, Any]
    config: dict[str, Any]
    frame: int


EARS = {"known_length": {"keypoints": ["left_ear", "right_ear"], "length": 0.018}}
TUTORIALS = {
    "deeplabcut": Tutorial("cam*.csv", {"fps": 50, "image_size": (1024, 768)}, EARS, 128),
    "sleap": Tutorial("*.h5", {"fps": 50, "image_size": (1024, 768)}, EARS, 62),
    "openpose": Tutorial("pose", {"fps": 30, "person": 1, "image_size": (1280, 720)}, {}, 60),
}


def main() -> None:
    """Fit, look, write."""
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("tutorial_pictures.py: chromium is not installed")
    with running_service() as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
        for name, tutorial in TUTORIALS.items():
            page = browser.new_page(viewport=SIZE, color_scheme="light")
            page.goto(shown(address, name, tutorial))
            page.get_by_role("heading", name="Figures").wait_for()
            page.wait_for_timeout(1500)  # the heat map comes when there is nothing else to do
            save_picture(page.screenshot(), PICTURES / f"tutorial-{name}.png")
        browser.close()


def shown(address: str, name: str, tutorial: Tutorial) -> str:
    """Fit the practice files of a tutorial; return where the page shows the fit."""
    with TemporaryDirectory() as folder, fewview.Client(address) as client:
        practice = str(ROOT / "examples" / "practice.py")
        subprocess.run([sys.executable, practice, name, folder], check=True)  # noqa: S603
        files = sorted(Path(folder).glob(tutorial.files))
        dataset = client.datasets.create(fewview.read(files, **tutorial.options), name=name)
        fit = client.fits.wait(client.fits.create(dataset, name=name, **tutorial.config))
        return page_address(client, f"/fits/{fit.id}?frame={tutorial.frame}")


if __name__ == "__main__":
    main()
