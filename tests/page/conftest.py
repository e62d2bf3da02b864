"""The machine's own chromium on the page of a running service, and what it must never do."""

import io
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field

import httpx2
import numpy as np
import pytest

from models.capture.synthetic import synthetic_capture
from service.page.serving import BUILT
from tests.page.stored import NAMES, Stored, store
from tests.service.conftest import Live, kill_service, start_service

pytest.importorskip("playwright", reason="playwright is not installed")

from playwright.sync_api import (
    Browser,
    BrowserContext,
    Page,
    Request,
    ViewportSize,
    expect,
    sync_playwright,
)

expect.set_options(timeout=30_000)  # other tests may keep the machine busy
HAND = ViewportSize(width=390, height=844)
CHROMIUM = shutil.which("chromium")
# Draws in three dimensions without a graphics card.
SOFTWARE = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",
    "--no-sandbox",
)


@dataclass
class Watched:
    """A page, and what it did that no page of ours may do."""

    page: Page
    base: str
    key: str | None  # that the address has
    foreign: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def open(self, where: str = "") -> Page:
        """Load the page at one of its screens."""
        self.page.goto("about:blank")  # else another part behind `#` would load nothing
        with_key = where if self.key is None else f"#key={self.key}{where.removeprefix('#')}"
        self.page.goto(f"{self.base}/{with_key}")
        return self.page


# One for all tests of the page that this process runs in a row. While there is a browser, no other
# test could run an event loop.
@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("chromium is not installed: apt-get install chromium")
    if not (BUILT / "index.html").exists():
        pytest.skip("the page was not built: `make page`, which needs npm's registry")
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE) as started,
    ):
        yield started


@pytest.fixture(scope="package")
def live(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    service = start_service(tmp_path_factory.mktemp("page"))
    try:
        yield service
    finally:
        kill_service(service)


@pytest.fixture(scope="package")
def stored(live: Live) -> Stored:
    return store(live)


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    # The larger it is, the longer a processor draws.
    with browser.new_context(viewport={"width": 1000, "height": 700}) as made:
        made.set_default_timeout(30_000)
        yield made


@pytest.fixture
def watched(context: BrowserContext, live: Live) -> Iterator[Watched]:
    """Open a page that asks nobody but its service, and of which the console has no complaint."""
    watched = watch(context.new_page(), live.url)
    yield watched
    assert watched.foreign == []
    assert watched.errors == []


def watch(page: Page, base: str, key: str | None = None) -> Watched:
    """Watch a page, which has a key; without one that of its owner, if the service knows us."""
    answer = httpx2.get(f"{base}/page-key", trust_env=False)
    owners = str(answer.json()["token"]) if answer.is_success else None
    watched = Watched(page, base, key or owners)

    def note(request: Request) -> None:
        if not request.url.startswith((f"{base}/", "blob:", "about:")):
            watched.foreign.append(request.url)

    page.on("request", note)
    page.on("pageerror", lambda error: watched.errors.append(str(error)))
    page.on(
        "console",
        lambda message: (
            watched.errors.append(message.text) if message.type in ("error", "warning") else None
        ),
    )
    return watched


def deeplabcut_files(frames: int = 60) -> dict[str, bytes]:
    """Return what DeepLabCut would write of three cameras that see a figure move."""
    seen = synthetic_capture(frames=frames, views=3, noise=1.0, hidden_keypoints=0.05, seed=5)
    files = {}
    for view in range(3):
        rows = np.concatenate(
            (seen.keypoints[:, view], seen.confidence[:, view, :, None]), -1
        ).reshape(frames, -1)
        text = io.StringIO()
        text.write(f"scorer,{','.join(['net'] * rows.shape[1])}\n")
        text.write(f"bodyparts,{','.join(name for name in NAMES for _ in range(3))}\n")
        text.write(f"coords,{','.join(['x', 'y', 'likelihood'] * len(NAMES))}\n")
        for number, row in enumerate(rows):
            text.write(f"{number},{','.join('' if np.isnan(x) else f'{x:.3f}' for x in row)}\n")
        files[f"walk_cam{view + 1}.csv"] = text.getvalue().encode()
    return files
