"""The first answer of a fit is played while the fit goes on, and exchanged at its end."""

from playwright.sync_api import expect

from store.database import Store
from store.settings import StoreSettings
from tests.page.conftest import Watched
from tests.page.stored import KEYPOINTS, SKELETON, Stored, walking
from tests.service.conftest import Live
from tests.service.stored_fits import begin_fit, put_first_answer, put_fit


def test_a_first_answer_is_played_and_exchanged_where_it_stands(
    watched: Watched, live: Live, stored: Stored
) -> None:
    prior = walking()
    config = prior.config.model_dump(mode="json")
    records = Store(StoreSettings(data_dir=live.data_dir))
    try:
        attempt = begin_fit(records, stored.dataset, config, "going on")
        page = watched.open(f"#/fits/{attempt.fit_id}")
        expect(page.get_by_role("button", name="Cancel the fit")).to_be_visible()
        expect(page.locator(".stage canvas")).to_have_count(0)
        put_first_answer(records, attempt, prior, KEYPOINTS)
        note = page.get_by_text("This is the first answer")
        expect(note).to_be_visible()
        frame = page.get_by_role("slider", name="Frame")
        frame.fill("20")
        page.get_by_role("link", name="OpenCV").first.wait_for()
        put_fit(records, stored.dataset, prior, KEYPOINTS, skeleton=SKELETON, attempt=attempt)
    finally:
        records.close()
    expect(page.get_by_role("link", name="its model")).to_be_visible()
    expect(note).to_have_count(0)
    expect(frame).to_have_value("20")
    expect(page.get_by_text("Labels for the detector")).to_be_visible()
