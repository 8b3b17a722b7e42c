"""The annotator's page in a real browser: clicks, drags, keys, reloads."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from support.annotating import (
    IDLE,
    Case,
    aligned_once,
    fitted,
    masks_searched_once,
    opened_page,
    place,
    place_all,
    place_of_pixel,
    served,
    wait,
)

import cadalign.web
from cadalign import Alignment, ShapeModel
from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.datasets import ModelKeypoints
from cadalign.metrics import rotation_error
from cadalign.render import cast_geometry
from cadalign.shapes.examples import Example

pytestmark = pytest.mark.long

POLLS = 6000  # 10 ms apart; what fails after them does not come at all, however slow the machine

# Without the thousands of numbers of the lines.
STATE = """() => annotator.idle && annotator.state && {
    ...annotator.state,
    alignment: { ...annotator.state.alignment, lines: null, box: null },
}"""
COUNT_COLOR = """color => {
    const { canvas, context } = annotator.photo;
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let k = 0; k < data.length; k += 4) {
        if ([0, 1, 2].every((c) => Math.abs(data[k + c] - color[c]) < 25)) count += 1;
    }
    return count;
}"""


class Driver:
    """Driver of the page that clicks on pixels of the photo and points of the model."""

    def __init__(self, page: Page, session: Session) -> None:
        self.page = page
        self.session = session

    def wait(self, condition: str) -> None:
        wait(self.page, condition)

    def wait_for_state(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        for _ in range(POLLS):
            state = self.page.evaluate(STATE)
            if state and condition(state):
                return dict(state)
            self.page.wait_for_timeout(10)
        pytest.fail("the state never came")

    def pixel(self, uv: list[float]) -> tuple[float, float]:
        """Position on the page of a pixel of the photo."""
        return place_of_pixel(self.page, uv)

    def surface(self, xyz: np.ndarray) -> tuple[float, float]:
        """Position on the page of a model point."""
        place = self.page.evaluate("xyz => annotator.model.toPage(xyz)", xyz.tolist())
        return place["x"], place["y"]

    def eye(self) -> np.ndarray:
        """Position of the viewer in model coordinates."""
        eye = self.page.evaluate("annotator.model.stage.camera.position.toArray()")
        return self.session.model.cad.from_display(eye)

    def look(self, eye: np.ndarray) -> None:
        """Look at the model from another place, as orbiting would."""
        self.page.evaluate(
            """eye => {
                annotator.model.stage.camera.position.set(...eye);
                annotator.model.stage.controls.update();
                annotator.model.stage.invalidate();
            }""",
            self.session.model.cad.to_display(eye).tolist(),
        )
        self.page.wait_for_timeout(50)


@pytest.fixture
def opened(browser: Browser, case: Case) -> Iterator[Driver]:
    session = case.open()
    with opened_page(browser, session, width=1000, height=760) as page:
        yield Driver(page, session)


def test_six_pairs_are_clicked_moved_undone_reloaded_and_saved(
    opened: Driver, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    driver, page = opened, opened.page
    # The chair as the photo shows it, so that the keypoints that are seen there are seen here.
    pose = case.instance.cam_from_model
    towards = pose.inverse(np.zeros((1, 3)))[0] - driver.session.model.cad.center
    driver.look(
        driver.session.model.cad.center
        + 2.2 * driver.session.model.cad.diagonal * towards / np.linalg.norm(towards)
    )
    for number, (keypoint, uv) in enumerate(case.clicks[:6], start=1):
        page.mouse.click(*driver.pixel(uv))
        driver.wait_for_state(lambda state, n=number: len(state["pairs"]) == n)
        page.mouse.click(
            *driver.surface(
                driver.session.model.cad.to_display(driver.session.model.registry[keypoint].xyz)
            )
        )
        state = driver.wait_for_state(lambda state, k=keypoint: state["pairs"][-1]["keypoint"] == k)
        assert state["alignment"]["status"] == ("done" if number >= 4 else "none")
        error = np.array(state["pairs"][-1]["uv"]) - uv
        assert np.abs(error).max() < 0.75 / page.evaluate("annotator.photo.scale")
    for text in ("Stretch y", "Residuals"):
        expect(page.locator("main")).to_contain_text(text, use_inner_text=True)

    # The alignment is drawn: red box, blue edges.
    for color in ([255, 90, 99], [53, 208, 255]):
        driver.wait(f"({COUNT_COLOR})({color}) > 150")

    # Drag a point, see the alignment follow, and undo that in one step.
    before = driver.wait_for_state(lambda _: True)
    x, y = driver.pixel(before["pairs"][2]["uv"])
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(x + 4 * step, y + step)
    page.mouse.up()
    scale = page.evaluate("annotator.photo.scale")
    target = [before["pairs"][2]["uv"][0] + 32 / scale, before["pairs"][2]["uv"][1] + 8 / scale]
    moved = driver.wait_for_state(
        lambda state: np.allclose(state["pairs"][2]["uv"], target, atol=0.01)
    )
    assert moved["alignment"]["facts"] != before["alignment"]["facts"]
    page.keyboard.press("Control+z")
    undone = driver.wait_for_state(lambda state: state["can_redo"])
    assert undone["pairs"][2]["uv"] == before["pairs"][2]["uv"]
    assert undone["alignment"] == before["alignment"]
    page.keyboard.press("Control+y")
    driver.wait_for_state(lambda state: not state["can_redo"])
    page.keyboard.press("Control+Shift+z")
    page.keyboard.press("Control+z")
    driver.wait_for_state(lambda state: state["can_redo"])

    # Nothing is lost by a reload, nor by a crash: a new server finds it all on disk.
    page.reload()
    driver.wait(IDLE)
    assert "token" not in page.url
    reloaded = driver.wait_for_state(lambda _: True)
    assert reloaded["pairs"] == undone["pairs"]
    assert reloaded["alignment"] == undone["alignment"]
    restarted = page_state(case.open(keypoints=None), 0)
    assert json.loads(json.dumps(restarted["pairs"])) == undone["pairs"]

    # It is saved, and the file gives the alignment that the page shows.
    expect(page.get_by_text("Every change is saved in photo.json")).to_be_visible()
    live = driver.session.live(driver.session.photos[0])
    assert live.result is not None
    assert fitted(case, capsys)["alignment"] == live.result.alignment.to_dict()


def test_clicks_on_the_model_give_the_surface_point(opened: Driver) -> None:
    driver = opened
    model = driver.session.model.cad
    rng = np.random.default_rng(3)
    gaps = []
    for view in range(3):
        towards = rng.normal(size=3)
        driver.look(model.center + 1.6 * model.diagonal * towards / np.linalg.norm(towards))
        eye = driver.eye()
        triangles = model.scene.triangles[rng.permutation(len(model.scene.triangles))[:60]]
        for target in triangles.mean(axis=1):
            point = model.pick(eye, target - eye)
            if point is None or np.linalg.norm(point.xyz - target) > 1e-4 * model.diagonal:
                continue  # hidden
            x, y = driver.surface(model.to_display(target))
            if driver.page.evaluate(
                """({ x, y }) => annotator.model.markerAt({ x, y }) !== undefined
                    || document.elementFromPoint(x, y) !== annotator.model.stage.canvas""",
                {"x": x, "y": y},
            ):
                continue
            count = len(driver.session.photos[0].marks.pairs)
            driver.page.evaluate("annotator.state.message = ''")
            driver.page.mouse.click(x, y)
            driver.wait_for_state(
                lambda state, n=count: len(state["pairs"]) == n + 1 or state["message"] != ""
            )
            pairs = driver.session.photos[0].marks.pairs
            if len(pairs) == count:
                continue  # half a pixel beside the outline
            placed = driver.session.model.registry[pairs[-1].keypoint]
            gaps.append(np.linalg.norm(np.array(placed.xyz) - target) / model.diagonal)
            if len(gaps) >= 8 * (view + 1):
                break
    assert len(gaps) >= 15
    # At grazing angles half a pixel is more than that on the surface.
    assert np.mean(np.array(gaps) < 2e-3) >= 0.9
    assert np.median(gaps) < 1e-3


def test_keys_nudge_select_and_delete(opened: Driver, case: Case) -> None:
    driver = opened
    page = driver.page
    place_all(driver.session, case, count=6)
    page.evaluate("annotator.api.refresh()")
    driver.wait_for_state(lambda state: len(state["pairs"]) == 6)
    page.keyboard.press("]")
    driver.wait("annotator.selected === 1")
    page.keyboard.press("[")
    driver.wait("annotator.selected === 6")
    u, v = case.clicks[5][1]
    for key in ("ArrowRight", "ArrowRight", "ArrowDown", "Shift+ArrowLeft"):
        page.keyboard.press(key)
    driver.wait_for_state(
        lambda state: np.allclose(state["pairs"][5]["uv"], [u + 0.5 - 2.5, v + 0.25])
    )
    page.keyboard.press("Control+z")  # nudges in a row are one step
    driver.wait_for_state(lambda state: np.allclose(state["pairs"][5]["uv"], [u, v]))
    page.keyboard.press("Delete")
    driver.wait_for_state(lambda state: len(state["pairs"]) == 5)
    page.keyboard.press("?")
    expect(page.locator("dialog")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("dialog")).not_to_be_visible()


def test_wheel_and_drag_zoom_and_pan_without_placing(opened: Driver) -> None:
    driver = opened
    page = driver.page
    anchor = [200.0, 300.0]
    x, y = map(round, driver.pixel(anchor))  # browsers tell whole pixels of a wheel
    anchor = page.evaluate(
        """([x, y]) => {
            const { left, top } = annotator.photo.canvas.getBoundingClientRect();
            return annotator.photo.toPixel({ x: x - left, y: y - top });
        }""",
        [x, y],
    )
    scale = page.evaluate("annotator.photo.scale")
    page.mouse.move(x, y)
    page.mouse.wheel(0, -500)
    driver.wait(f"annotator.photo.scale > {1.5 * scale}")
    assert driver.pixel(anchor) == pytest.approx((x, y), abs=0.6)  # about the pointer
    page.mouse.down()
    page.mouse.move(x + 30, y - 20, steps=4)
    page.mouse.up()
    assert driver.pixel(anchor) == pytest.approx((x + 30, y - 20), abs=1.1)
    assert driver.wait_for_state(lambda _: True)["pairs"] == []


def test_a_finger_places_a_point(browser: Browser, case: Case) -> None:
    session = case.open()
    with opened_page(browser, session, width=390, height=844, has_touch=True) as page:
        page.touchscreen.tap(*place_of_pixel(page, [200.0, 300.0]))
        state = Driver(page, session).wait_for_state(lambda state: len(state["pairs"]) == 1)
        assert state["pairs"][0]["uv"] == pytest.approx([200, 300], abs=1.5)


def test_page_says_when_the_server_is_gone(browser: Browser, case: Case) -> None:
    context = browser.new_context()
    page = context.new_page()
    with served(case.open()) as access:
        page.goto(access.url)
        wait(page, IDLE)
    page.evaluate("annotator.act({ do: 'undo' })")
    said = "document.querySelector('[role=status]').textContent"
    wait(page, f"{said}.startsWith('The server does not')")
    context.close()


def test_photos_of_a_folder_come_in_turn(browser: Browser, case: Case) -> None:
    shutil.copy(case.photo, case.folder / "second.png")
    session = case.open(image=case.folder)
    with opened_page(browser, session, width=1280, height=900) as page:
        driver = Driver(page, session)
        expect(page.locator("h1")).to_have_text("photo.png")
        expect(page.get_by_role("button", name="Previous photo")).to_be_disabled()
        listed = page.get_by_role("combobox", name="Photo").locator("option")
        expect(listed).to_have_text(["1. photo.png: 0 pairs", "2. second.png: 0 pairs"])
        page.get_by_role("combobox", name="Photo").select_option("1")
        driver.wait_for_state(lambda state: state["image"]["name"] == "second.png")
        driver.wait(IDLE)
        page.mouse.click(*driver.pixel([100.0, 100.0]))
        driver.wait_for_state(lambda state: len(state["pairs"]) == 1)
        page.reload()
        driver.wait(IDLE)
        expect(page.locator("h1")).to_have_text("second.png")
        page.keyboard.press("PageUp")
        state = driver.wait_for_state(lambda state: state["image"]["name"] == "photo.png")
        assert state["pairs"] == []
    assert "unfinished" in (case.folder / "second.json").read_text()


def learned_shape(case: Case, ids: list[int], xyz: np.ndarray) -> Path:
    """The file of a shape of these keypoints."""
    rng = np.random.default_rng(0)
    examples = [Example(f"chair {row}", ids, xyz * rng.normal(1, 0.1, 3)) for row in range(40)]
    ShapeModel.learn(examples, category="chair").save(case.folder / "chair.shape")
    return case.folder / "chair.shape"


def test_shape_is_drawn_and_an_unknown_point_identified(browser: Browser, case: Case) -> None:
    """Rings and regions of unmarked keypoints, and the identification of a point."""
    points = ModelKeypoints.load(case.keypoints)
    ids = [int(number or 0) for number in points.ids[1:]]
    file = learned_shape(case, ids, points.xyz[1:])
    few = replace(points, keypoints=points.keypoints[:-1])  # the model lacks one of the shape
    few.save(case.keypoints)
    session = case.open(shape=file)
    with opened_page(browser, session, width=1000, height=760) as page:
        driver = Driver(page, session)
        expect(page.get_by_text("3 more pairs to the first alignment")).to_be_visible()
        # The examples have no meshes: an outline would say nothing.
        expect(page.get_by_role("button", name="Mask by a box")).to_be_hidden()
        expect(page.get_by_label("Fit to the photo itself")).to_be_hidden()
        known = [click for click in case.clicks if click[0] in ids[:-1]][:4]
        for keypoint, uv in known:
            perform(session, 0, {"do": "place_uv", "uv": uv})
            perform(session, 0, {"do": "place_keypoint", "keypoint": keypoint})
        page.reload()
        driver.wait(IDLE)
        state = driver.wait_for_state(lambda state: state["alignment"]["status"] == "done")
        assert state["alignment"]["regions"]
        expect(page.locator(".facts dt").first).to_have_text("Length x")
        page.wait_for_timeout(200)
        assert page.evaluate(COUNT_COLOR, [255, 150, 225]) > 10
        perform(session, 0, {"do": "pick", "origin": [0, 0.05, -3], "direction": [0, 0, 1]})
        page.reload()
        driver.wait(IDLE)
        choice = page.get_by_label("Keypoint of chair that pair 5 is")
        choice.select_option(f"keypoint {ids[-1]}")
        driver.wait_for_state(lambda state: state["pairs"][4]["counts"])
        expect(choice).to_have_count(0)


# --- what stands beside the photo ------------------------------------------------------------

SIZES = [(1280, 800), (1440, 900)]
FOLDED = """all => all.filter((each) => {
    const { right, bottom, height } = each.getBoundingClientRect();
    const card = each.closest(".card")?.getBoundingClientRect();
    const low = Math.min(innerHeight, card?.bottom ?? Infinity);
    return height && (bottom > low || right > innerWidth);
}).map((each) => each.textContent)"""


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("own", [False, True])
def test_nothing_that_matters_is_below_a_fold(
    browser: Browser, case: Case, width: int, height: int, *, own: bool
) -> None:
    points = ModelKeypoints.load(case.keypoints)
    ids = [int(number or 0) for number in points.ids]
    session = case.open(shape=learned_shape(case, ids, points.xyz) if own else None)
    with aligned_once(session):
        for number, (keypoint, (u, v)) in enumerate(case.clicks[:10]):
            wrong = 120.0 if number == 7 else 0.0
            place(session, keypoint, [u + wrong, v - wrong / 2])
    with opened_page(browser, session, width=width, height=height) as page:
        off = page_state(session, 0)["pairs"][7]["off"]
        status = page.get_by_role("status")
        expect(status).to_contain_text(f"Pair 8 contradicts: {off:.0f} px.")
        photo = page.locator("section[aria-label=Photo]").bounding_box()
        line = status.bounding_box()
        assert photo is not None
        assert line is not None
        assert 0 <= line["y"] - photo["y"] - photo["height"] < 20
        assert page.locator(".facts dt").count() >= 6
        matters = ".facts > div, .pairs li, fieldset label, .card > label, .status, button"
        assert page.locator(matters).evaluate_all(FOLDED) == []
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")


def test_first_of_the_notes_stands_beside_the_photo(browser: Browser, case: Case) -> None:
    session = case.open(camera=None)
    place_all(session, case, count=4)
    (note, *others) = page_state(session, 0)["alignment"]["notes"]
    with opened_page(browser, session) as page:
        expect(page.get_by_role("status")).to_have_text(note + " ")
        assert page.locator(".notes li").all_inner_texts() == others


# --- masks and the photo itself ----------------------------------------------------------------


def test_a_box_and_one_key_align_to_the_photo(browser: Browser, case: Case) -> None:
    session, truth = case.open(), case.instance.cam_from_model
    assert case.instance.scene is not None
    mask = cast_geometry(case.instance.scene, case.instance.camera, truth).mask
    rows, columns = np.nonzero(mask)
    with masks_searched_once(), opened_page(browser, session) as page:
        page.keyboard.press("x")
        expect(page.get_by_role("button", name="Mask by a box")).to_have_attribute(
            "aria-pressed", "true"
        )
        page.mouse.move(*place_of_pixel(page, (columns.min() - 8.0, rows.min() - 8.0)))
        page.mouse.down()
        page.mouse.move(*place_of_pixel(page, (columns.max() + 8.0, rows.max() + 8.0)), steps=4)
        page.mouse.up()
        wait(page, f"{IDLE} && annotator.state.alignment.also_used === 'mask'")
        assert not page.evaluate("annotator.photo.isBoxing")
        wait(page, "annotator.photo.mask !== null")
        assert rotation_error(est=placed(session), gt=truth) < 1.0
        page.keyboard.press("i")
        wait(page, f"{IDLE} && annotator.state.evidence.photo")
        expect(page.get_by_label("Fit to the photo itself")).to_be_checked()
        expect(page.get_by_text("The photo replaces the mask")).to_be_visible()
        assert page.evaluate("annotator.state.alignment.also_used") == "photo"
        assert rotation_error(est=placed(session), gt=truth) < 1.0
        page.keyboard.press("Control+z")
        wait(page, f"{IDLE} && annotator.state.alignment.also_used === 'mask'")
        page.get_by_role("button", name="Clear the mask").click()
        wait(page, f"{IDLE} && annotator.state.evidence.mask === null")
        assert page.evaluate("annotator.photo.mask") is None


def placed(session: Session) -> Alignment:
    live = session.live(session.photos[0])
    assert live.result is not None, live.message
    return live.result.alignment


# --- keys and messages -------------------------------------------------------------------------


def test_every_key_is_listed(opened: Driver) -> None:
    driver = opened
    script = (Path(cadalign.web.__file__).parent / "annotate" / "keys.js").read_text()
    keys = re.findall(r"\b(\w): \(app\b", script)
    driver.page.keyboard.press("?")
    listed = " ".join(driver.page.locator("dialog[open] dt").all_inner_texts())
    assert len(set(keys)) >= 5
    assert {key.upper() for key in keys} <= set(re.findall(r"\b\w\b", listed))


def test_why_a_photo_cannot_be_shown_is_said(browser: Browser, case: Case) -> None:
    with opened_page(browser, case.open()) as page:
        case.photo.write_bytes(case.photo.read_bytes()[:5000])
        page.reload()
        wait(page, "annotator.layout?.status.textContent.includes('photo.png: not an image')")
