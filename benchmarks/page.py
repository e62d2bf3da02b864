"""How fast the page shows a long fit, and what a frame of it costs.

    python benchmarks/page.py [--frames 5000] [--keypoints 60] [--views 4] [--seconds 30]

Starts a service, fits a synthetic capture with few steps, and opens its result in Debian's
`chromium`: when nobody has asked the service for it yet, in browsers that were just started, and
again. Script time is what the page's own code takes for one animation frame: by the clock, and of
the processor, which does not count waiting for a core. The drawing itself is done by a processor
here, and takes longer than on any graphics card. `--seconds 300` shows whether memory stays what it
is.
"""

import argparse
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from benchmarks.captures import studio
from benchmarks.figures import Bar, Results, Row, command
from benchmarks.service_rig import service

CONFIG = {"steps": 300, "cameras": "static"}
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
OPENED = 4  # browsers, each of which opens the result twice
WARM_UP_MS = 3000  # of playing: without a graphics card that is a dozen frames
PLAYABLE_MS, PAINTED_MS, SCRIPT_MS, GROWN_MB = 1500.0, 1000.0, 4.0, 8.0
# Notes when the result can be played and when all frames are there, and what each of the page's
# animation frames takes.
TIMED = """
window.seen = {};
const note = (name) => { window.seen[name] ??= performance.now(); };
new MutationObserver(() => {
  const result = document.querySelector(".result");
  if (!result?.querySelector("[aria-label=Play]")) return;
  note("playable");
  if (result.ariaBusy === "false") note("whole");
}).observe(document, { subtree: true, childList: true, attributes: true });
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
    with nullcontext(arguments.url) if arguments.url else fitted(arguments) as url:
        opened, played = measure(chromium, url, arguments.seconds)
    cold = opened[0]
    bars = [
        Bar("playable, cold", PLAYABLE_MS, cold["playable ms"], "ms"),
        Bar("first paint, cold", PAINTED_MS, cold["first paint ms"], "ms"),
        Bar("script of a frame, p99", SCRIPT_MS, played["script p99 ms"], "ms"),
        Bar("its processor time, p99", SCRIPT_MS, played["processor p99 ms"], "ms"),
        Bar("memory gained while playing", GROWN_MB, played["memory gained MB"], "MB"),
    ]
    tables = {"Opening a result": opened, "Playing it": [played]}
    Results("page", vars(arguments), tables, bars).publish(arguments.json)


@contextmanager
def fitted(arguments: argparse.Namespace) -> Iterator[str]:
    """Serve the result of a fit; yield its address."""
    capture = studio(arguments.views, arguments.keypoints, frames=arguments.frames)
    with service() as running:
        asked = {"dataset_id": running.upload(capture), "config": CONFIG}
        fit, seconds = running.run("/fits", asked)
        print(f"fitted in {seconds:.0f} s", flush=True)
        yield f"{running.address}/#/fits/{fit['id']}"


def measure(chromium: str, url: str, seconds: float) -> tuple[list[Row], Row]:
    """Open a result in several browsers, twice in each; play it in the last."""
    opened, played = [], {}
    with sync_playwright() as playwright:
        for turn in range(OPENED):
            browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
            page = browser.new_page()
            page.add_init_script(TIMED)
            cold = "just started" if turn else "just started, asks the service first"
            opened += [open_once(page, url) | {"browser": cold}]
            opened += [open_once(page, url) | {"browser": "has shown it before"}]
            if turn == OPENED - 1:
                played = play(page, seconds)
            browser.close()
    return [opened[0], middle(opened[2::2]), middle(opened[1::2])], played


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how fast the page shows a long fit.")
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--keypoints", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=30, help="to play for")
    parser.add_argument("--url", help="of a result that is there, instead of one that is fitted")
    return parser.parse_args()


def open_once(page: Page, url: str) -> Row:
    """Return the milliseconds until a result is painted, can be played, and is there as a whole."""
    page.goto("about:blank")
    page.goto(url)
    page.locator(".result[aria-busy=false]").wait_for()
    painted = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
    return {
        "first paint ms": page.evaluate(painted),
        "playable ms": page.evaluate("seen.playable"),
        "all frames ms": page.evaluate("seen.whole"),
    }


def middle(rows: list[Row]) -> Row:
    """Return the medians of what was measured several times."""
    return {
        name: float(np.median([row[name] for row in rows])) if name.endswith("ms") else value
        for name, value in rows[0].items()
    }


def play(page: Page, seconds: float) -> Row:
    """Play a result that is there, and return what that costs."""
    page.wait_for_timeout(2000)  # until the errors of all keypoints are computed
    page.get_by_role("button", name="Play").click()
    page.wait_for_timeout(WARM_UP_MS)
    before = heap(page)
    page.evaluate("taken.length = 0")
    with traced(page) as processor:
        page.wait_for_timeout(1000 * seconds)
        taken = np.array(page.evaluate("taken"))
    page.get_by_role("button", name="Pause").click()
    return {
        "frames drawn": len(taken),
        "script p50 ms": float(np.percentile(taken, 50)),
        "script p99 ms": float(np.percentile(taken, 99)),
        "processor p50 ms": float(np.percentile(processor, 50)),
        "processor p99 ms": float(np.percentile(processor, 99)),
        "memory gained MB": (heap(page) - before) / 1e6,
    }


@contextmanager
def traced(page: Page) -> Iterator[list[float]]:
    """Give a list that at the end has the milliseconds of the processor of each animation frame."""
    session, taken, ended = page.context.new_cdp_session(page), list[float](), list[bool]()

    def note(part: dict[str, list[dict[str, Any]]]) -> None:
        frames = (event for event in part["value"] if event["name"] == "FireAnimationFrame")
        taken.extend(event["tdur"] / 1000 for event in frames if "tdur" in event)

    def end(_event: object) -> None:
        ended.append(True)

    session.on("Tracing.dataCollected", note)
    session.on("Tracing.tracingComplete", end)
    categories = {"includedCategories": ["devtools.timeline"]}
    session.send("Tracing.start", {"transferMode": "ReportEvents", "traceConfig": categories})
    yield taken
    session.send("Tracing.end")
    while not ended:
        page.wait_for_timeout(50)
    session.detach()


def heap(page: Page) -> float:
    """Return the bytes of what the page's scripts hold, garbage left out."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")["usedSize"]
    session.detach()
    return float(used)


if __name__ == "__main__":
    main()
