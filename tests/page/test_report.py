"""The report on a fit, opened from its result in a tab of its own: it loads and runs nothing."""

from playwright.sync_api import expect

from tests.page.conftest import Watched
from tests.page.stored import NAMES, Stored
from tests.service.conftest import Live


def test_the_verdict_leads_to_the_report(watched: Watched, live: Live, stored: Stored) -> None:
    words = live.get(f"/fits/{stored.fit}")["verdict"]["expected"]
    assert words
    page = watched.open(f"#/fits/{stored.fit}")
    verdict = page.locator(".verdict").first
    expect(verdict).to_contain_text(words)
    with page.expect_popup() as opening:
        verdict.get_by_role("link", name="Report").click()
    report = opening.value
    refused = list[str]()
    report.on("console", lambda message: refused.append(message.text))
    expect(report.get_by_role("heading", level=1)).to_be_visible()
    expect(report.get_by_text(words)).to_be_visible()
    expect(report.get_by_role("rowheader", name=NAMES[0]).first).to_be_visible()
    # Its style holds, under the policy of the page that opened it, and under its own.
    border = report.locator(".verdict").evaluate("it => getComputedStyle(it).borderLeftWidth")
    assert border != "0px"
    for width in (390, 1400):
        report.set_viewport_size({"width": width, "height": 800})
        assert report.evaluate("document.documentElement.scrollWidth") <= width
    assert not refused
    assert not watched.errors
    assert not watched.foreign
    report.close()
