"""The main job with the keyboard alone: files, a fit, playing, a joint, an export."""

from playwright.sync_api import FilePayload, Locator, Page, expect

from tests.page.conftest import Watched, deeplabcut_files
from tests.page.stored import Stored
from tests.service.conftest import Live

FAR = 150  # steps of the tabulator, at most


def tab_to(page: Page, target: Locator) -> None:
    """Go on with the tabulator until a control has the focus, which must then be seen."""
    for _ in range(FAR):
        page.keyboard.press("Tab")
        if target.evaluate("(control) => control === document.activeElement"):
            break
    expect(target).to_be_focused()
    # A field for files is drawn as its label.
    seen = "(control) => (control.closest('label.button') ?? control).matches(':focus-within')"
    assert target.evaluate(seen)
    outlined = """(control) => {
      const style = getComputedStyle(control.closest('label.button') ?? control);
      return style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) > 0;
    }"""
    assert target.evaluate(outlined), target


def press(page: Page, target: Locator, key: str = "Enter") -> None:
    tab_to(page, target)
    page.keyboard.press(key)


def test_files_are_chosen_stored_and_fitted(watched: Watched, live: Live) -> None:
    page = watched.open()
    press(page, page.get_by_role("link", name="New capture").first)
    expect(page.get_by_role("heading", name="New capture")).to_be_visible()
    files: list[FilePayload] = [
        {"name": name, "mimeType": "text/csv", "buffer": body}
        for name, body in deeplabcut_files(20).items()
    ]
    with page.expect_file_chooser() as chooser:
        press(page, page.get_by_label("Choose files"), "Space")
    chooser.value.set_files(files)
    expect(page.get_by_role("region", name="What was understood")).to_contain_text("3 views")
    press(page, page.get_by_role("button", name="Store this capture"))
    with page.expect_response("**/fits") as answer:
        press(page, page.get_by_role("button", name="Start the fit"))
    made = answer.value.json()
    expect(page.get_by_role("button", name="Cancel")).to_be_visible()
    live.http.post(f"/fits/{made['id']}/cancel")


def test_a_result_is_played_a_joint_selected_and_a_file_saved(
    watched: Watched, live: Live, stored: Stored
) -> None:
    page = watched.open(f"#/fits/{stored.fit}")
    expect(page.locator(".result")).to_have_attribute("aria-busy", "false")
    slider = page.get_by_role("slider", name="Frame")
    page.keyboard.press("Space")
    expect(slider).not_to_have_value("0")
    page.keyboard.press("Space")
    page.keyboard.press("End")
    expect(slider).to_have_value("39")
    tab_to(page, page.get_by_label("Select a keypoint"))
    page.keyboard.type("l_knee")
    page.keyboard.press("Enter")
    expect(page.get_by_text("l_knee").first).to_be_visible()
    tab_to(page, page.get_by_label("Curve over time"))
    page.keyboard.type("Knee")
    page.keyboard.press("Enter")
    with page.expect_download() as saved:
        press(page, page.get_by_role("button", name="json").first)
    assert saved.value.suggested_filename == f"{stored.fit}.json"
