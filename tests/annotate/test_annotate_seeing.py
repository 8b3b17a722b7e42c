"""The page in Chromium: nothing moves, the alignment is drawn as chosen, priors are chosen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from support.annotating import IDLE, Case, opened_page, place_all, wait

from cadalign.annotate.lines import Wireframe
from cadalign.annotate.model import ClickableModel, detail_bytes
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.geometry.mesh import Mesh

pytestmark = pytest.mark.long

WATCH_SHIFTS = """
window.shifts = 0;
window.moved = [];
new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) {
        window.shifts += entry.value;
        for (const { node } of entry.sources) window.moved.push(node?.outerHTML?.slice(0, 80));
    }
}).observe({ type: "layout-shift", buffered: true });
"""
PLACES = """() => [...document.querySelectorAll(".host canvas, header button, .card > h2")].map(
    (each) => { const { x, y, width, height } = each.getBoundingClientRect();
                return [x, y, width, height]; })"""
SUM = """() => {
    const { canvas, context } = annotator.photo;
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    let sum = 0;
    for (let k = 0; k < data.length; k += 1) sum += data[k] * ((k % 97) + 1);
    return sum;
}"""

DRAWN = """async () => {
    for (let k = 0; k < 3; k += 1) await new Promise((drawn) => requestAnimationFrame(drawn));
}"""


@pytest.fixture
def opened(browser: Browser, case: Case) -> Iterator[tuple[Page, Session]]:
    session = case.open()
    with opened_page(browser, session, scripts=[WATCH_SHIFTS]) as page:
        yield page, session


def act(page: Page, action: dict[str, Any]) -> None:
    page.evaluate("action => annotator.act(action)", action)
    wait(page, IDLE)


def test_views_and_controls_stay_where_they_are(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    page.wait_for_timeout(300)
    before = page.evaluate(PLACES)
    page.evaluate("window.shifts = 0; window.moved = []")
    for count, (keypoint, uv) in enumerate(case.clicks[:6], start=1):
        act(page, {"do": "place_uv", "uv": uv})
        act(page, {"do": "place_keypoint", "keypoint": keypoint})
        act(page, {"do": "pick", "origin": [9, 9, 9], "direction": [1, 1, 1]})  # misses
        assert page.locator("[role=alert]").inner_text() == "That click missed the model."
        assert page.evaluate(PLACES) == before, count
    assert page.evaluate(PLACES) == before
    assert page_state(session, 0)["alignment"]["status"] == "done"
    # What grows inside a card is scrolled there; nothing else has moved.
    assert page.evaluate("window.shifts") == 0, page.evaluate("window.moved")


def test_alignment_is_drawn_as_chosen(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    place_all(session, case, count=6)
    page.evaluate("annotator.api.refresh()")
    wait(page, "annotator.api.idle && annotator.state.alignment.status === 'done'")
    seen = {}
    for mode in ("off", "edges", "shaded", "box", "edges", "off"):
        page.get_by_label("Alignment over the photo").select_option(mode)
        page.evaluate(DRAWN)
        seen[mode] = page.evaluate(SUM)
    assert len(set(seen.values())) == 4
    page.locator("section[aria-label=Photo] canvas").focus()
    page.keyboard.press("o")  # edges again
    page.evaluate(DRAWN)
    assert page.evaluate(SUM) == seen["edges"]
    page.keyboard.down("h")
    page.evaluate(DRAWN)
    assert page.evaluate(SUM) == seen["off"]
    page.keyboard.up("h")
    page.evaluate(DRAWN)
    assert page.evaluate(SUM) == seen["edges"]
    eyes = set()
    for key in "123456":
        page.keyboard.press(key)
        eye = page.evaluate("annotator.model.stage.camera.position.toArray()")
        eyes.add(tuple(np.round(eye, 3)))
    assert len(eyes) == 6


def test_result_is_shown_in_three_dimensions(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    page.keyboard.press("r")
    wait(page, "document.querySelector('[role=alert]').textContent.includes('no stretched model')")
    place_all(session, case, count=6)
    page.evaluate("annotator.api.refresh()")
    wait(page, "annotator.api.idle && annotator.state.alignment.status === 'done'")
    page.keyboard.press("r")
    wait(page, "!!annotator.model.result && !annotator.model.group.visible")
    # A corner of the model stands where the alignment puts it in the camera.
    placed = page.evaluate(
        """() => {
            const [model] = annotator.model.result.children;
            model.updateMatrixWorld(true);
            return model.matrixWorld.toArray();
        }"""
    )
    live, _ = session.live(session.photos[0])
    assert live.result is not None
    xyz = session.model.cad.snap_points.xyz[0]
    display = session.model.cad.to_display(xyz)
    seen = (np.reshape(placed, (4, 4)).T @ [*display, 1.0])[:3] * [1, -1, -1]
    np.testing.assert_allclose(seen, live.result.alignment.apply(xyz[None])[0], atol=1e-6)
    # Nothing is placed by clicks on it, and it follows the pairs.
    box = page.locator("section[aria-label=Model] canvas").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    act(page, {"do": "delete", "pair": 6})
    assert len(session.photos[0].document.pairs) == 5
    wait(page, "!!annotator.model.result")
    page.keyboard.press("r")
    wait(page, "!annotator.model.result && annotator.model.group.visible")


def test_prior_is_changed_and_switched_off(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    place_all(session, case, count=5)
    page.evaluate("annotator.api.refresh()")
    wait(page, "annotator.api.idle && annotator.state.pairs.length === 5")
    width = page.get_by_label("Standard deviation of the stretch about 1, in percent")
    width.fill("10")
    width.press("Enter")
    wait(page, "annotator.api.idle && annotator.state.priors.stretch === 10")
    assert case.open().photos[0].document.priors.stretch == 0.1
    page.get_by_label("stretch 1").first.uncheck()
    wait(page, "annotator.api.idle && annotator.state.priors.stretch === null")
    assert case.open().photos[0].document.priors.stretch is None


def test_of_doubled_faces_each_shows_its_side() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 2, 3], [0, 1, 4]])
    model = ClickableModel(Mesh(corners, faces))
    mesh, _, is_doubled = model.displayed
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 1, 4]]
    assert is_doubled.tolist() == [True, False, True, False]
    wireframe = Wireframe.of_model(model)
    data = detail_bytes(model, wireframe.creases)
    lines = int.from_bytes(data[:4], "little")
    assert len(data) == 4 + 24 * lines + 2 * 4
    assert data[-8:] == bytes([255] * 4 + [1, 0, 1, 0])
    # The diagonal of the square is no crease, though its triangles are written twice.
    assert lines == 6
