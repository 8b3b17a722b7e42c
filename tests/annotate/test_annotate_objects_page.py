"""Objects of a photo and photos of an object in a real browser, by mouse and by keyboard alone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect
from support.annotating import IDLE, Case, opened_page, place, place_of_pixel, wait

from cadalign.annotate.actions import perform
from cadalign.annotate.session import Session
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long

SHIFTS = """() => {
    window.moved = 0;
    new PerformanceObserver((list) => {
        for (const entry of list.getEntries()) window.moved += entry.value;
    }).observe({ type: "layout-shift", buffered: true });
}"""


def click(page: Page, uv: list[float]) -> None:
    """Click on a pixel of the photo."""
    before = page.evaluate("annotator.state.revision")
    x, y = place_of_pixel(page, uv)
    page.mouse.click(x, y)
    wait(page, f"annotator.api.idle && annotator.state.revision > {before}")


def press(page: Page, key: str) -> None:
    page.keyboard.press(key)
    wait(page, IDLE)


def shown(page: Page) -> tuple[int, int]:
    image = page.evaluate("annotator.state.image")
    return image["number"], image["object"]


@pytest.fixture
def session(case: Case) -> Session:
    right = case.folder / "right.png"
    shutil.copy(case.photo, right)
    other = case.folder / "other" / case.model.name
    shutil.copytree(case.model.parent, other.parent)
    session = case.open(further_photos=(right,), models=(other,))
    for keypoint, uv in case.clicks[:6]:
        place(session, keypoint, uv)
    return session


@pytest.fixture
def page(browser: Browser, session: Session) -> Iterator[Page]:
    with opened_page(browser, session, width=1280, height=800) as page:
        page.evaluate(SHIFTS)
        yield page


def test_objects_are_added_switched_renamed_and_deleted_by_mouse(
    page: Page, session: Session, case: Case
) -> None:
    expect(page.get_by_role("group", name="Objects of this photo")).to_be_hidden()
    page.get_by_role("button", name="Objects…").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Name of the new object").fill("left chair")
    dialog.get_by_role("button", name="Add object").click()
    expect(dialog).to_be_hidden()
    wait(page, IDLE)
    assert shown(page) == (0, 1)
    expect(page.get_by_role("alert")).to_have_text("Mark the new object's points.")
    for keypoint, (u, v) in case.clicks[:5]:
        click(page, [u + 6, v])
        perform(session, 0, {"do": "place_keypoint", "keypoint": keypoint}, slot=1)
    page.reload()
    wait(page, IDLE)
    assert shown(page) == (0, 1)  # as the address has it
    chips = page.get_by_role("group", name="Objects of this photo").get_by_role("button")
    expect(chips).to_have_text(["object 1 · 6", "left chair · 5"])
    expect(chips.nth(1)).to_have_attribute("aria-pressed", "true")
    boxes = page.evaluate("annotator.state.objects.map((each) => each.box.length)")
    assert min(boxes) > 0
    page.evaluate("annotator.photo.zoom(1.5)")
    kept = page.evaluate("annotator.photo.scale")
    chips.nth(0).click()
    wait(page, IDLE + " && annotator.state.image.object === 0")
    assert page.evaluate("annotator.photo.scale") == kept  # another object keeps the zoom
    assert page.evaluate("annotator.state.pairs.length") == 6

    page.get_by_role("button", name="Objects…").click()
    dialog.get_by_label("Name of object 1").fill("desk")
    dialog.get_by_label("Name of object 1").press("Enter")
    expect(chips.nth(0)).to_have_text("desk · 6")
    assert json.loads(case.observation.read_text())["object"] == "desk"
    dialog.get_by_role("button", name="Delete left chair").click()
    expect(dialog.get_by_role("button", name="Bring back: left chair")).to_be_visible()
    assert not (case.folder / "photo.object-2.json").exists()
    dialog.get_by_role("button", name="Bring back: left chair").click()
    expect(chips).to_have_text(["desk · 6", "left chair · 5"])
    assert (case.folder / "photo.object-2.json").exists()
    page.keyboard.press("Escape")
    assert page.evaluate("window.moved ?? 0") == 0


def test_objects_and_photos_by_keyboard_alone(page: Page, session: Session, case: Case) -> None:
    page.keyboard.press("t")
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Name of the new object").focus()
    page.keyboard.type("lamp")
    press(page, "Enter")
    expect(dialog).to_be_hidden()  # it is closed two frames later, and takes all keys until then
    assert shown(page) == (0, 1)
    press(page, "e")
    wait(page, IDLE + " && annotator.state.image.object === 0")
    press(page, "e")
    wait(page, IDLE + " && annotator.state.image.object === 1")
    press(page, "y")
    expect(page.get_by_role("alert")).to_have_text("This object has no other photo: T adds one.")
    press(page, "e")
    wait(page, IDLE + " && annotator.state.image.object === 0")
    page.keyboard.press("t")
    dialog.get_by_label("Photo to add").focus()
    press(page, "Tab")
    press(page, "Enter")
    expect(dialog).to_be_hidden()
    wait(page, IDLE + " && annotator.state.image.number === 1")
    assert page.url.endswith("#2.2")
    for keypoint, uv in case.clicks[:5]:
        perform(session, 1, {"do": "place_uv", "uv": uv}, slot=1)
        perform(session, 1, {"do": "place_keypoint", "keypoint": keypoint}, slot=1)
    page.reload()
    wait(page, IDLE)
    chips = page.get_by_role("group", name="Photos of this object").get_by_role("button")
    expect(chips).to_have_text(["photo.png · 6", "right.png · 5"])
    assert page.evaluate("annotator.state.alignment.status") == "done"
    press(page, "y")
    wait(page, IDLE + " && annotator.state.image.number === 0")
    assert len(Observation.load(case.observation).views) == 2
    press(page, "Control+z")
    wait(page, "annotator.api.idle && annotator.state.views[1].pairs === 4")
    press(page, "Control+y")
    wait(page, "annotator.api.idle && annotator.state.views[1].pairs === 5")


def test_a_photo_is_taken_from_the_object(page: Page, session: Session) -> None:
    perform(session, 0, {"do": "add_view", "photo": 1})
    page.evaluate("annotator.goTo(1, 1)")
    wait(page, IDLE + " && annotator.state.image.number === 1")
    page.get_by_role("button", name="Objects…").click()
    page.get_by_role("button", name="Take right.png from the object").click()
    wait(page, IDLE + " && annotator.state.image.number === 0")
    expect(page.get_by_role("alert")).to_have_text("right.png is no longer used.")
    assert len(session.objects[0][0].owner.shown) == 1


def test_another_model_is_shown_for_its_object(page: Page) -> None:
    page.get_by_role("button", name="Objects…").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Model of the new object").select_option(index=1)
    dialog.get_by_role("button", name="Add object").click()
    wait(page, IDLE + " && annotator.model.number === 1 && annotator.state.image.object === 1")
    canvas = page.get_by_role("application", name="The model")
    canvas.focus()
    page.keyboard.press("Enter")
    wait(page, "annotator.api.idle && annotator.state.pairs.length === 1")
    assert page.evaluate("annotator.model.stage.scene.children.includes(annotator.model.group)")


def test_an_object_of_another_tab_that_was_deleted_is_refused(page: Page, session: Session) -> None:
    perform(session, 0, {"do": "add_object", "name": "lamp"})
    page.evaluate("annotator.goTo(0, 1)")
    wait(page, IDLE + " && annotator.state.image.object === 1")
    perform(session, 0, {"do": "delete_object"}, slot=1)
    page.evaluate("annotator.act({ do: 'place_uv', uv: [10, 10], pair: null })")
    wait(page, "annotator.api.idle")
    expect(page.get_by_role("alert")).to_contain_text("this object was deleted")
    assert not session.objects[0][0].document.pairs[6:]
