"""The page in Chromium: a box cuts an object out, a candidate is chosen, the photo is fitted to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from support.annotating import (
    IDLE,
    Case,
    masks_searched_once,
    opened_page,
    place_of_pixel,
    wait,
)

from cadalign.annotate.session import Session
from cadalign.geometry.alignment import Alignment
from cadalign.metrics import rotation_error
from cadalign.render import cast_geometry

pytestmark = pytest.mark.long


@pytest.fixture(scope="module", autouse=True)
def _searched_once() -> Iterator[None]:
    with masks_searched_once():
        yield


def draw_box(page: Page, case: Case) -> None:
    """Drag a box about the object."""
    instance = case.instance
    assert instance.scene is not None
    mask = cast_geometry(instance.scene, instance.camera, instance.cam_from_model).mask
    rows, columns = np.nonzero(mask)
    page.keyboard.press("x")
    first = float(columns.min() - 8), float(rows.min() - 8)
    last = float(columns.max() + 8), float(rows.max() + 8)
    page.mouse.move(*place_of_pixel(page, first))
    page.mouse.down()
    page.mouse.move(*place_of_pixel(page, last), steps=4)
    page.mouse.up()
    page.wait_for_timeout(50)
    wait(page, IDLE)


def shown(session: Session) -> Alignment:
    live, _ = session.live(session.photos[0])
    assert live.result is not None, live.message
    return live.alignment


def test_a_box_and_one_key_align_to_the_photo(browser: Browser, case: Case) -> None:
    session, truth = case.open(), case.instance.cam_from_model
    with opened_page(browser, session) as page:
        draw_box(page, case)
        assert page.evaluate("annotator.state.alignment.status") == "done"
        assert rotation_error(est=shown(session), gt=truth) < 1.0
        page.keyboard.press("i")
        wait(page, f"{IDLE} && annotator.state.evidence.photo")
        expect(page.get_by_label("Fit to the photo itself")).to_be_checked()
        expect(page.get_by_text("The photo takes the place of the mask")).to_be_visible()
        assert page.evaluate("annotator.state.alignment.also_used") == "photo"
        assert rotation_error(est=shown(session), gt=truth) < 1.0
        page.keyboard.press("Control+z")
        wait(page, f"{IDLE} && !annotator.state.evidence.photo")
        assert page.evaluate("annotator.state.alignment.also_used") == "mask"
