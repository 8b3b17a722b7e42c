"""The page in Chromium: masks and vertical edges are drawn, lengths typed, by mouse or keys."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from support.annotating import IDLE, Case, opened_page, place_all, place_of_pixel, wait

from cadalign.annotate.session import Session
from cadalign.io.images import write_image

pytestmark = pytest.mark.long


@pytest.fixture
def opened(browser: Browser, case: Case) -> Iterator[tuple[Page, Session]]:
    session = case.open()
    place_all(session, case, count=5)
    with opened_page(browser, session) as page:
        yield page, session


def drag(page: Page, *places: tuple[float, float]) -> None:
    page.mouse.move(*place_of_pixel(page, places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place_of_pixel(page, place), steps=4)
    page.mouse.up()
    page.wait_for_timeout(50)
    wait(page, IDLE)


def used(page: Page) -> str:
    wait(page, IDLE)
    return str(page.evaluate("annotator.state.alignment.also_used"))


def test_box_and_file_give_masks(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    page.keyboard.press("x")
    points = case.instance.points_2d
    low = np.maximum(points.min(axis=0) - 25, 4)
    high = np.minimum(points.max(axis=0) + 25, (634, 474))
    drag(page, (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
    assert used(page) == "mask", page.locator("[role=alert]").inner_text()
    cut = session.annotation(0).mask
    assert 0.05 < cut[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])].mean() < 0.98
    given = np.zeros_like(cut)
    given[100:400, 150:450] = True
    file = case.folder.parent / "given.png"
    write_image(file, np.where(given, 255, 0).astype(np.uint8))
    page.get_by_label("Mask file").set_input_files(file)
    for _ in range(200):
        if (session.annotation(0).mask == given).all():
            break
        page.wait_for_timeout(30)
    np.testing.assert_array_equal(session.annotation(0).mask, given)
    write_image(file, np.zeros((10, 12), dtype=np.uint8))
    page.get_by_label("Mask file").set_input_files(file)
    wait(page, "document.querySelector('[role=alert]').textContent.includes('12 x 10 pixels')")
    page.get_by_role("button", name="Mask, gravity, known size (1 used)").click()
    page.get_by_role("button", name="Clear the mask").click()
    wait(page, "annotator.api.idle && annotator.state.evidence.mask === null")
    assert used(page) == ""
    page.keyboard.press("Escape")
    assert page.get_by_label("What a click in the photo marks").input_value() == "points"


def test_edges_and_lengths_by_keys_alone(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    page.locator("section[aria-label=Photo] canvas").focus()
    page.keyboard.press("u")
    for number in range(2):
        page.keyboard.press("Enter")
        for _ in range(3):
            page.keyboard.press("ArrowUp")
        page.keyboard.press("Enter")
        wait(
            page,
            f"annotator.api.idle && annotator.state.evidence.verticals.length === {number + 1}",
        )
        for key in ("ArrowDown",) * 3 + ("ArrowRight",) * 4:
            page.keyboard.press(key)
    # Marked by the middle of the view, which the arrows pan.
    (first, second) = session.photos[0].document.evidence.verticals
    assert abs(first[0][0] - first[1][0]) < 1e-6
    assert abs(first[0][0] - second[0][0]) > 20
    assert "gravity" in used(page)

    page.get_by_role("button", name="Mask, gravity, known size").press("Enter")
    height = page.get_by_label("Known height (along y)")
    height.fill("0.9")
    height.press("Enter")
    wait(page, "annotator.api.idle && annotator.state.evidence.lengths.height === 0.9")
    assert "known height" in used(page)
