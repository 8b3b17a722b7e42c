"""The list of photos: natural order, thumbnails and keys."""

from __future__ import annotations

import shutil

import pytest
from playwright.sync_api import Browser
from support.annotating import IDLE, Case, opened_page, place, wait

from cadalign.annotate.page_state import worklist_state

pytestmark = pytest.mark.long


def folder_of(case: Case, *names: str) -> None:
    for name in names:
        shutil.copy(case.photo, case.folder / name)


def test_photos_come_in_natural_order_with_pairs(case: Case) -> None:
    folder_of(case, "photo 10.png", "photo 9.png", "photo 2.png")
    session = case.open(image=case.folder)
    listed = worklist_state(session)
    assert [each["name"] for each in listed] == [
        "photo 2.png",
        "photo 9.png",
        "photo 10.png",
        "photo.png",
    ]
    for keypoint, uv in case.clicks[:6]:
        place(session, keypoint, uv, image=3)
    again = worklist_state(case.open(image=case.folder))
    assert again[3]["pairs"] == 6
    assert 0 < again[3]["rms"] < 5
    assert again[0]["rms"] is None


def test_list_is_gone_through_by_keys(browser: Browser, case: Case) -> None:
    folder_of(case, "1.png", "2.png", "3.png")
    session = case.open(image=case.folder)
    with opened_page(browser, session, width=1280, height=800) as page:
        page.keyboard.press("PageDown")
        wait(page, f"{IDLE} && annotator.state.image.number === 1")
        page.keyboard.press("w")
        dialog = page.get_by_role("dialog", name="Photos")
        dialog.wait_for()
        assert dialog.get_by_role("listitem").count() == 4
        page.evaluate("document.querySelector('.thumbs img').decode()")
        dialog.get_by_role("button", name="photo.png").press("Enter")
        wait(page, f"{IDLE} && annotator.state.image.number === 3")
        page.keyboard.press("PageUp")
        wait(page, f"{IDLE} && annotator.state.image.number === 2")


def test_why_a_photo_cannot_be_shown_is_said(browser: Browser, case: Case) -> None:
    with opened_page(browser, case.open()) as page:
        case.photo.write_bytes(case.photo.read_bytes()[:5000])
        page.reload()
        wait(page, "annotator.layout?.message.textContent.includes('photo.png: not an image')")
