"""How fast the page shows a long fit, and what a frame of it costs.

    python benchmarks/page.py [--frames 5000] [--keypoints 60] [--views 4] [--seconds 30]

Starts a service, fits a synthetic capture with few steps, and opens its result in Debian's
`chromium` several times. Script time is what the page's own code takes for one animation frame; the
drawing itself is done by a processor here, and takes longer than on any graphics card.
"""

import argparse
import shutil
import sys

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.captures import studio
from benchmarks.figures import Bar, Results, Row, command
from benchmarks.service_rig import service

CONFIG = {"steps": 300, "cameras": "static"}
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
OPENED = 4  # times; the first is left out, for the browser compiles the page then
WARM_UP_MS = 3000  # of playing: without a graphics card that is a dozen frames
LOADED_MS, PAINTED_MS, SCRIPT_MS, GROWN_MB = 1500.0, 1000.0, 4.0, 8.0
# Notes what each of the page's animation frames takes.
TIMED = """
window.taken = [];
const ask = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (draw) => ask((now) => {
  const began = performance.now();
  draw(now);
  window.taken.push(performance.now() - began);
});
"""


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("page.py: chromium is not installed")
    capture = studio(arguments.views, arguments.keypoints, frames=arguments.frames)
    with service() as running, sync_playwright() as playwright:
        asked = {"dataset_id": running.upload(capture), "config": CONFIG}
        fit, seconds = running.run("/fits", asked)
        print(f"fitted in {seconds:.0f} s", flush=True)
        browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
        row = measure(browser, f"{running.address}/#/fits/{fit['id']}", arguments.seconds)
        browser.close()
    bars = [
        Bar("loaded", LOADED_MS, row["loaded ms"], "ms"),
        Bar("first paint", PAINTED_MS, row["first paint ms"], "ms"),
        Bar("script of a frame, p99", SCRIPT_MS, row["script p99 ms"], "ms"),
        Bar("memory gained while playing", GROWN_MB, row["memory gained MB"], "MB"),
    ]
    Results("page", vars(arguments), {"A result": [row]}, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how fast the page shows a long fit.")
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--keypoints", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=30, help="to play for")
    return parser.parse_args()


def measure(browser: Browser, url: str, seconds: float) -> Row:
    """Open a result several times, then play it."""
    page = browser.new_page()
    page.add_init_script(TIMED)
    opened = [open_once(page, url) for _ in range(OPENED)][1:]
    page.wait_for_timeout(2000)  # until the errors of all keypoints are computed
    page.get_by_role("button", name="Play").click()
    page.wait_for_timeout(WARM_UP_MS)
    before = heap(page)
    page.evaluate("taken.length = 0")
    page.wait_for_timeout(1000 * seconds)
    page.get_by_role("button", name="Pause").click()
    taken = np.array(page.evaluate("taken"))
    loaded, painted = np.median(opened, axis=0)
    return {
        "loaded ms": float(loaded),
        "first paint ms": float(painted),
        "frames drawn": len(taken),
        "script p50 ms": float(np.percentile(taken, 50)),
        "script p99 ms": float(np.percentile(taken, 99)),
        "memory gained MB": (heap(page) - before) / 1e6,
    }


def open_once(page: Page, url: str) -> tuple[float, float]:
    """Return the milliseconds until the result can be played, and until anything was painted."""
    page.goto("about:blank")
    page.goto(url)
    page.get_by_role("button", name="Play").wait_for()
    painted = "performance.getEntriesByName('first-paint')[0].startTime"
    return page.evaluate("performance.now()"), page.evaluate(painted)


def heap(page: Page) -> float:
    """Return the bytes of what the page's scripts hold, garbage left out."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")["usedSize"]
    session.detach()
    return float(used)


if __name__ == "__main__":
    main()
