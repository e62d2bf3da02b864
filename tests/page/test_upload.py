"""A long capture is sent in parts, and what was sent of it need not be sent again."""

from pathlib import Path

import numpy as np
from playwright.sync_api import BrowserContext, Route, expect

from tests.page.conftest import watch
from tests.page.stored import EDGES, KEYPOINTS, NAMES
from tests.service.conftest import Live, to_npz

FRAMES = 24_000  # 9 MB


def test_an_upload_that_broke_is_finished_another_day(
    context: BrowserContext, live: Live, tmp_path: Path
) -> None:
    times = -(-FRAMES // len(KEYPOINTS))
    keypoints = np.concatenate([KEYPOINTS.astype(np.float32)] * times)[:FRAMES]
    keypoints += np.arange(FRAMES, dtype=np.float32)[:, None, None, None] % 97
    skeleton = {"keypoint_names": np.array(NAMES), "edges": np.array(EDGES), "fps": 50.0}
    file = tmp_path / "march.npz"
    file.write_bytes(to_npz(keypoints=keypoints, **skeleton))
    watched = watch(context.new_page(), live.url)
    page = watched.open("#/datasets/new")
    page.route("**/datasets", lambda route: route.abort("connectionreset"), times=1)
    page.route("**/frames", lambda route: route.abort("connectionreset"))
    page.set_input_files(".drop input", file)
    understood = page.get_by_role("region", name="What was understood")
    expect(understood).to_contain_text("24,000 frames at 50 frames/s, 3 views")
    with page.expect_request("**/frames"):  # once the first part is stored, at the second try
        page.get_by_role("button", name="Store this capture").click()
    expect(page.get_by_text("The connection broke. Trying again.")).to_be_visible()
    page.get_by_role("button", name="Stop").click()
    page.unroute("**/frames")
    (begun,) = live.get("/datasets?name=march")["items"]
    assert 0 < begun["frames"] < FRAMES

    sent: list[str] = []

    def note(route: Route) -> None:
        sent.append(route.request.headers["idempotency-key"])
        if len(sent) == 1:
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/frames", note)
    page = watched.open("#/datasets/new")
    page.set_input_files(".drop input", file)
    page.get_by_role("button", name="Store what is missing of it").click()
    expect(page.get_by_role("heading", name="march")).to_be_visible()
    assert sent[0] == sent[1] == f"{begun['id']}-{begun['frames']}"
    stored = live.get(f"/datasets/{begun['id']}")
    assert (stored["frames"], stored["skeleton"]["edges"]) == (FRAMES, EDGES)
    capture = tmp_path / "capture.npz"
    capture.write_bytes(live.http.get(f"/datasets/{begun['id']}/capture").content)
    with np.load(capture) as arrays:
        np.testing.assert_array_equal(arrays["keypoints"], keypoints)
        assert arrays["keypoint_names"].tolist() == NAMES
    live.http.delete(f"/datasets/{begun['id']}")
    assert all("ERR_CONNECTION_RESET" in error for error in watched.errors), watched.errors
