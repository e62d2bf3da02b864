"""Folders are given on the page: one for each camera, with a calibration, with several people."""

import json
from pathlib import Path

import numpy as np
from fewview.calibration import write_cameras
from playwright.sync_api import Page, expect

from tests.page.conftest import Watched
from tests.service.conftest import Live
from tests.service.resources.test_folders import VIEWS, cameras, frame_files

FOLDER = ".drop input[webkitdirectory]"
# Folders as a browser hands them over, of which a script can make none.
DROP = """(target, tops) => {
  const entryOf = (path, content) => typeof content === "string"
    ? { isFile: true, fullPath: path,
        file: (done) => done(new File([content], path.split("/").at(-1))) }
    : { isFile: false, fullPath: path, createReader: () => {
        const all = Object.entries(content).map(([n, inside]) => entryOf(`${path}/${n}`, inside));
        return { readEntries: (done) => done(all.splice(0, 100)) };
      } };
  const items = Object.entries(tops).map(([name, inside]) => (
    { webkitGetAsEntry: () => entryOf(`/${name}`, inside) }
  ));
  const event = new Event("drop", { bubbles: true, cancelable: true });
  Object.defineProperty(event, "dataTransfer", { value: { items, files: [] } });
  target.dispatchEvent(event);
}"""


def dropped(folder: Path) -> dict[str, object]:
    return {
        path.name: dropped(path) if path.is_dir() else path.read_text() for path in folder.iterdir()
    }


def understood(page: Page) -> None:
    expect(page.get_by_role("region", name="What was understood")).to_contain_text("3 views")


def test_folders_dropped_together_are_views_and_bring_their_calibration(
    watched: Watched, live: Live, tmp_path: Path
) -> None:
    for v, values in enumerate(VIEWS):
        frame_files(tmp_path / f"cam{v}", values)
    write_cameras(tmp_path / "calib.json", cameras("cam0", "cam1", "cam2"), "opencv")
    page = watched.open("#/datasets/new")
    page.locator(".drop").evaluate(DROP, dropped(tmp_path))
    listed = page.get_by_role("list", name="Files to send")
    expect(listed).to_contain_text("cam0/10 files")
    expect(listed).to_contain_text("31 files in 3 folders")
    understood(page)
    expect(page.get_by_text("calib.json is a calibration")).to_be_visible()
    page.get_by_text("Rename, order or leave out views").click()
    page.get_by_label("Name of view cam1").fill("left")
    page.get_by_role("button", name="Put cam2 before").click()
    expect(page.locator(".previews figcaption").nth(1)).to_contain_text("cam2")
    page.get_by_role("button", name="Store this capture").click()
    own = page.get_by_label("Use the calibration that came with the files")
    expect(own).to_be_checked()
    id = page.url.rpartition("/")[2]
    stored = live.get(f"/datasets/{id}")
    assert stored["view_names"] == ["cam0", "cam2", "left"]
    assert stored["calibration"]["names"] == ["cam0", "cam2", "cam1"]
    with page.expect_response("**/fits") as answer:
        page.get_by_role("button", name="Start the fit").click()
    made = answer.value.json()
    assert made["config"]["calibration"] == stored["calibration"]["cameras"]
    live.http.post(f"/fits/{made['id']}/cancel")


def test_a_folder_is_chosen_and_another_calibration_with_it(
    watched: Watched, live: Live, tmp_path: Path
) -> None:
    for v, values in enumerate(VIEWS):
        frame_files(tmp_path / "session" / f"cam{v}", values)
    page = watched.open("#/datasets/new")
    page.set_input_files(FOLDER, tmp_path / "session")
    expect(page.get_by_role("list", name="Files to send")).to_contain_text("session/cam2/10 files")
    understood(page)
    expect(page.get_by_label("Name", exact=True)).to_have_value("session")
    page.get_by_role("button", name="Store this capture").click()
    file = write_cameras(tmp_path / "rig.toml", cameras("one", "two", "three"))
    page.get_by_label("Calibration file").set_input_files(file)
    expect(page.get_by_text("one for cam0, two for cam1, three for cam2")).to_be_visible()
    with page.expect_response("**/fits") as answer:
        page.get_by_role("button", name="Start the fit").click()
    made = answer.value.json()
    assert [camera["translation"][0] for camera in made["config"]["calibration"]] == [0, 0.3, 0.6]
    live.http.post(f"/fits/{made['id']}/cancel")


def test_the_person_of_each_view_is_chosen_by_a_click(
    watched: Watched, live: Live, tmp_path: Path
) -> None:
    for v, values in enumerate(VIEWS[:2]):
        folder = tmp_path / f"cam{v}"
        folder.mkdir()
        for n, frame in enumerate(values):
            both = [frame, frame * (1, 1, 0.9) + (500, 0, 0)]
            people = [{"pose_keypoints_2d": each.ravel().tolist()} for each in both]
            (folder / f"{n:012}_keypoints.json").write_text(json.dumps({"people": people}))
    page = watched.open("#/datasets/new")
    page.locator(".drop").evaluate(DROP, dropped(tmp_path))
    shown = page.get_by_role("region", name="Who is it?")
    other = shown.get_by_role("group", name="cam1").locator("button[aria-pressed=false]")
    called = other.get_attribute("aria-label") or ""
    other.click()
    one = shown.get_by_role("button", name=called)
    expect(one).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Store this capture").click()
    expect(page.get_by_role("button", name="Start the fit")).to_be_visible()
    id = page.url.rpartition("/")[2]
    (tmp_path / "capture.npz").write_bytes(live.http.get(f"/datasets/{id}/capture").content)

    with np.load(tmp_path / "capture.npz") as arrays:
        mean = arrays["keypoints"][:, 1, :, 0].mean()
    right = 500 if called == "person 2, cam1" else 0  # who is seen less surely
    assert abs(mean - VIEWS[1][..., 0].mean() - right) < 1
