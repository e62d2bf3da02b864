"""Screens beside the result: what is stored is listed, named, deleted; what goes on is followed."""

from collections.abc import Iterator
from itertools import cycle
from threading import Event, Thread

import pytest
from fewview import Client
from playwright.sync_api import BrowserContext, WebSocketRoute, expect

from tests.page.conftest import Watched, watch
from tests.page.stored import KEYPOINTS, Stored
from tests.service.conftest import BYTES, Live, to_npz
from tests.waiting import wait_for


@pytest.fixture
def spare(live: Live) -> str:
    """Store a dataset that nobody else needs."""
    body = to_npz(keypoints=KEYPOINTS[:12])
    made = live.http.post("/datasets?name=spare", content=body, headers=BYTES)
    return str(made.raise_for_status().json()["id"])


def test_who_has_stored_nothing_is_taught(context: BrowserContext, live: Live) -> None:
    asked = {"name": "new", "project": "empty", "scopes": ["read", "write", "lift"]}
    made = live.http.post("/keys", json=asked | {"quotas": {"stored_bytes": 1_000_000}}).json()
    watched = watch(context.new_page(), live.url, made["token"])
    for screen, heading in (
        ("", "in three steps"),
        ("#/datasets", "what your cameras saw"),
        ("#/models", "A model knows one subject"),
        ("#/live", "A stream needs a model"),
        ("#/storage", "Nothing is stored yet"),
    ):
        page = watched.open(screen)
        expect(page.get_by_role("heading", name=heading)).to_be_visible()
    expect(page.get_by_text("0 B of the 1.0 MB that it may store")).to_be_visible()
    page.get_by_role("link", name="Store a capture").click()
    expect(page.get_by_role("heading", name="New capture")).to_be_visible()
    assert (watched.errors, watched.foreign) == ([], [])


def test_a_dataset_is_renamed_and_deleted(watched: Watched, live: Live, spare: str) -> None:
    page = watched.open("#/datasets")
    page.get_by_role("link", name="spare").first.click()
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("New name").fill("morning")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="morning")).to_be_visible()
    assert live.get(f"/datasets/{spare}")["name"] == "morning"
    page.get_by_role("button", name="Delete this dataset").click()
    page.get_by_role("button", name="Keep it").click()
    page.get_by_role("button", name="Delete this dataset").click()
    page.get_by_role("button", name="Yes, delete it").click()
    expect(page.get_by_role("heading", name="Datasets")).to_be_visible()
    assert live.http.get(f"/datasets/{spare}").status_code == 404


def test_a_model_has_aliases_a_past_and_files(watched: Watched, live: Live, stored: Stored) -> None:
    live.http.put("/models/walk@try", json={"model_id": stored.model}).raise_for_status()
    weights = live.http.get(f"/models/{stored.model}/weights").content
    copy = live.http.post("/models?name=copy", content=weights, headers=BYTES).json()["id"]
    page = watched.open("#/models")
    expect(page.get_by_text("walk@try")).to_be_visible()
    page.get_by_role("link", name="copy").click()
    page.get_by_label("New alias").fill("walk@try")
    page.get_by_role("button", name="Move it here").click()
    expect(page.locator(".aliases")).to_contain_text("walk@try")
    assert live.get("/models/walk@try")["id"] == copy
    page.get_by_label("Delete the alias walk@try").click()
    expect(page.locator(".aliases")).to_have_count(0)
    with page.expect_download() as saved:
        page.get_by_role("button", name="weights").click()
    assert saved.value.path().read_bytes()[8:].startswith(b"{")
    page.get_by_role("button", name="Delete this model").click()
    page.get_by_role("button", name="Yes, delete it").click()
    expect(page.get_by_role("heading", name="Models", exact=True)).to_be_visible()
    assert live.http.get(f"/models/{copy}").status_code == 404

    page = watched.open(f"#/models/{stored.model}")
    expect(page.get_by_role("link", name="its dataset")).to_be_visible()
    expect(page.get_by_role("img", name="Reprojection error by step")).to_be_visible()
    page.get_by_role("link", name="its fit, with the result").click()
    expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible()


def test_storage_names_the_largest(watched: Watched, live: Live, stored: Stored) -> None:
    page = watched.open("#/storage")
    largest = page.get_by_role("region", name="The largest").get_by_role("row")
    sizes = live.get("/storage")["largest"]
    expect(largest).to_have_count(1 + len(sizes))
    expect(largest.nth(1)).to_contain_text(sizes[0]["name"])
    largest.nth(1).get_by_role("link").click()
    expect(page.get_by_role("heading", name=sizes[0]["name"])).to_be_visible()


@pytest.fixture
def long_fit(live: Live, stored: Stored) -> Iterator[str]:
    """Begin a fit that would take an hour."""
    made = live.fit(stored.dataset, steps=100_000, cameras="moving")
    yield made["id"]
    live.http.post(f"/fits/{made['id']}/cancel")


def test_a_fit_is_cancelled_in_the_list_and_one_that_failed_says_what_to_do(
    watched: Watched, stored: Stored, long_fit: str
) -> None:
    page = watched.open()
    row = page.get_by_role("row").filter(has=page.locator(f"a[href*={long_fit}]"))
    expect(page.get_by_text("worker")).to_be_visible()
    row.get_by_role("button", name="Cancel test").click()
    expect(row.get_by_text("cancelled", exact=True)).to_be_visible()
    page = watched.open(f"#/fits/{stored.failed}")
    expect(page.get_by_role("heading", name="This fit failed")).to_be_visible()
    expect(page.get_by_text("Look at the dataset")).to_be_visible()
    page.get_by_role("link", name="To its dataset, to fit it again").click()
    expect(page.get_by_role("button", name="Start the fit")).to_be_visible()


def test_a_stream_is_watched_and_goes_on_after_a_break(watched: Watched, stored: Stored) -> None:
    opened: list[WebSocketRoute] = []

    def connect(route: WebSocketRoute) -> None:
        route.connect_to_server()
        opened.append(route)

    page = watched.page
    page.route_web_socket("**/lift/stream", connect)
    watched.open("#/live")
    page.get_by_label("Model").select_option(stored.model)
    page.get_by_label("Capture").select_option(stored.dataset)
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible()
    expect(page.get_by_text("In the room: y up")).to_be_visible()
    figures = page.get_by_role("region", name="Stream", exact=True)
    expect(figures).to_contain_text("of 50 frames a second")
    expect(figures).to_contain_text("ms in the median")
    expect(page.locator("figure.view").first).to_contain_text("px")
    opened[0].close(code=1012, reason="the service stops")
    expect(page.get_by_text("Trying again.")).to_be_visible()
    expect(page.get_by_text("Trying again.")).to_have_count(0)
    assert len(opened) == 2
    expect(figures).to_contain_text("open")
    page.get_by_role("button", name="Stop").click()
    expect(figures).to_have_count(0)


@pytest.fixture
def streamer(live: Live, stored: Stored) -> Iterator[Event]:
    """Stream frames of the walk as a capture program does, until the event that is given is set."""
    over = Event()

    def play() -> None:
        with Client(live.url).stream(stored.model, frame="room", up="auto") as stream:
            for keypoints in cycle(KEYPOINTS):
                stream.lift(keypoints)
                if over.wait(0.02):
                    return

    playing = Thread(target=play)
    playing.start()
    yield over
    over.set()
    playing.join()


def test_the_stream_of_another_program_is_watched_until_it_ends(
    watched: Watched, streamer: Event, stored: Stored
) -> None:
    page = watched.open("#/live")
    rows = page.get_by_role("region", name="Open streams").get_by_role("link")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("walk")
    rows.click()
    expect(page.get_by_role("region", name="Structure in 3D")).to_be_visible()
    expect(page.get_by_text("In the room: y up")).to_be_visible()
    expect(page.locator("figure.view")).to_have_count(3)
    expect(page.locator("figure.view").first).to_contain_text("px")
    figures = page.get_by_role("region", name="Stream", exact=True)
    expect(figures).to_contain_text("ms in the median")
    expect(figures.get_by_role("img", name="Time until an answer")).to_be_visible()
    canvas = page.locator(".stage canvas")
    before = canvas.screenshot()
    wait_for(lambda: canvas.screenshot() != before, "another frame", 30)
    streamer.set()
    expect(page.get_by_text("The stream has ended.")).to_be_visible()
    expect(page.get_by_text("No program streams just now.")).to_be_visible()
    expect(figures).to_contain_text("closed")
