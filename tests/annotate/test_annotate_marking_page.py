"""The page in Chromium: masks are drawn by mouse or keys."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from support.annotating import IDLE, Case, opened_page, place_all, place_of_pixel, wait

from cadalign.annotate.session import Session

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


def test_box_gives_a_mask(opened: tuple[Page, Session], case: Case) -> None:
    page, session = opened
    page.keyboard.press("x")
    points = case.instance.points_2d
    low = np.maximum(points.min(axis=0) - 25, 4)
    high = np.minimum(points.max(axis=0) + 25, (634, 474))
    drag(page, (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
    assert used(page) == "mask", page.locator("[role=alert]").inner_text()
    cut = session.annotation(0).mask
    assert 0.05 < cut[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])].mean() < 0.98
    page.get_by_role("button", name="Clear the mask").click()
    wait(page, "annotator.api.idle && annotator.state.evidence.mask === null")
    assert used(page) == ""
    page.keyboard.press("Escape")
    assert page.get_by_label("What a click in the photo marks").input_value() == "points"


def test_box_is_drawn_by_keys_alone(opened: tuple[Page, Session]) -> None:
    page, session = opened
    page.locator("section[aria-label=Photo] canvas").focus()
    page.keyboard.press("x")
    for key in ("ArrowUp",) * 3 + ("ArrowLeft",) * 4:
        page.keyboard.press(key)
    page.keyboard.press("Enter")
    for key in ("ArrowDown",) * 7 + ("ArrowRight",) * 8:
        page.keyboard.press(key)
    page.keyboard.press("Enter")  # marked at the middle of the view, which the arrows pan
    wait(page, "annotator.api.idle && annotator.state.evidence.mask !== null")
    assert used(page) == "mask"
    assert session.annotation(0).mask.any()
