"""Work lists: natural order, states, thumbnails, filter and keys; detections."""

from __future__ import annotations

import json
import shutil
from typing import Any

import pytest
from playwright.sync_api import Browser
from support.annotating import IDLE, Case, opened_page, place, place_of_pixel, wait

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state, worklist_state
from cadalign.annotate.photos import FILE, WorkList
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError

pytestmark = pytest.mark.long


def folder_of(case: Case, *names: str) -> None:
    for name in names:
        shutil.copy(case.photo, case.folder / name)


def test_photos_come_in_natural_order_with_states(case: Case) -> None:
    folder_of(case, "photo 10.png", "photo 9.png", "photo 2.png")
    session = case.open(image=case.folder)
    listed = worklist_state(session)
    assert [each["name"] for each in listed] == [
        "photo 2.png",
        "photo 9.png",
        "photo 10.png",
        "photo.png",
    ]
    assert {each["state"] for each in listed} == {"to do"}
    assert not (case.folder / FILE).exists()
    for keypoint, uv in case.clicks[:6]:
        place(session, keypoint, uv, image=3)
    perform(session, 0, {"do": "mark", "mark": "done"})
    perform(session, 1, {"do": "mark", "mark": "skipped"})
    perform(session, 1, {"do": "mark"})
    perform(session, 2, {"do": "mark", "mark": "skipped"})
    again = worklist_state(case.open(image=case.folder))
    assert [each["state"] for each in again] == ["done", "to do", "skipped", "begun"]
    assert again[3]["pairs"] == 6
    assert 0 < again[3]["rms"] < 5
    assert again[0]["rms"] is None


def test_files_that_are_no_work_list_are_refused(case: Case) -> None:
    (case.folder / FILE).write_text(json.dumps({"format": "other", "photos": {}}))
    with pytest.raises(CadalignError, match="not a cadalign work list"):
        case.open()


def test_list_is_filtered_and_gone_through_by_keys(browser: Browser, case: Case) -> None:
    folder_of(case, "1.png", "2.png", "3.png")
    session = case.open(image=case.folder)
    with opened_page(browser, session, width=1280, height=800) as page:
        page.keyboard.press("d")
        wait(page, f"{IDLE} && annotator.state.image.number === 1")
        page.keyboard.press("k")
        wait(page, f"{IDLE} && annotator.state.image.number === 2")
        page.keyboard.press("w")
        dialog = page.get_by_role("dialog", name="Photos")
        dialog.wait_for()
        assert dialog.get_by_role("listitem").count() == 4
        page.evaluate("document.querySelector('.thumbs img').decode()")
        dialog.get_by_label("Photos to show").select_option("to do")
        assert dialog.get_by_role("listitem").count() == 2
        assert "done (1)" in dialog.inner_text()
        dialog.get_by_role("button", name="photo.png").press("Enter")
        wait(page, f"{IDLE} && annotator.state.image.number === 3")
        page.keyboard.press("PageUp")
        wait(page, f"{IDLE} && annotator.state.image.number === 2")
        page.keyboard.press("PageUp")  # the others are done and skipped
        wait(page, "document.querySelector('[role=alert]').textContent.includes('No other photo')")


def detections(case: Case, session: Session, names: list[str], shift: float) -> dict[str, Any]:
    """COCO annotations of the visible keypoints in photos of these names."""
    keypoints = [session.model.registry[keypoint].name for keypoint, _ in case.clicks]
    values = [value for _, (u, v) in case.clicks for value in (u + shift, v, 0.9)]
    images = [{"id": row, "file_name": name} for row, name in enumerate(names)]
    return {
        "images": images,
        "categories": [{"id": 1, "keypoints": keypoints}],
        "annotations": [
            {"image_id": image["id"], "category_id": 1, "keypoints": values} for image in images
        ],
    }


def test_keypoints_of_a_detector_are_shown_and_taken(case: Case) -> None:
    folder_of(case, "other.png")
    file = case.folder / "found.json"
    file.write_text(json.dumps(detections(case, case.open(), ["photo.png"], 1.0)))
    session = case.open(image=case.folder, detections=file)
    other, photo = session.photos
    assert other.detected == ()
    count = len(case.clicks)
    assert len(page_state(session, 1)["detected"]) == count
    keypoint, (u, v) = case.clicks[2]
    perform(session, 1, {"do": "accept", "keypoints": [keypoint]})
    (pair,) = photo.document.pairs
    assert (pair.keypoint, pair.uv) == (keypoint, (u + 1, v))
    assert len(page_state(session, 1)["detected"]) == count - 1
    perform(session, 1, {"do": "accept"})
    state = page_state(session, 1)
    assert state["detected"] == []
    assert state["alignment"]["status"] == "done"
    perform(session, 1, {"do": "undo"})  # all at once
    assert len(photo.document.pairs) == 1
    assert "No keypoint of a detector is left" in perform(session, 0, {"do": "accept"}).message
    file.write_text(json.dumps(detections(case, case.open(), ["elsewhere.png"], 1.0)))
    with pytest.raises(CadalignError, match="no keypoint of the model"):
        case.open(image=case.folder, detections=file)


def test_objects_of_one_photo_are_entries_of_the_list(case: Case) -> None:
    folder_of(case, "other.png", "photo-2.png")
    session = case.open(image=case.folder, prepared=False)
    place(session, *case.clicks[0])
    new = perform(session, 0, {"do": "another"}).shown
    assert new is session.photos[3]
    assert new.files.observation.name == "other-2.json"
    place(session, *case.clicks[1], image=3)
    number = next(k for k, each in enumerate(session.photos) if each.name == "photo.png")
    taken = perform(session, number, {"do": "another"}).shown
    assert taken.files.observation.name == "photo-3.json"
    perform(session, 3, {"do": "mark", "mark": "done"})
    again = worklist_state(case.open(image=case.folder, prepared=False))
    assert {each["name"]: (each["state"], each["pairs"]) for each in again} == {
        "other.png": ("begun", 1),
        "other.png (other-2.json)": ("done", 1),
        "photo.png": ("to do", 0),
        "photo-2.png": ("to do", 0),
    }
    assert [each["name"] for each in again][:2] == ["other.png", "other.png (other-2.json)"]


def test_keypoints_of_a_detector_are_taken_in_the_page(browser: Browser, case: Case) -> None:
    file = case.folder / "found.json"
    file.write_text(json.dumps(detections(case, case.open(), ["photo.png"], 0.0)))
    session = case.open(detections=file)
    with opened_page(browser, session, width=1280, height=800) as page:
        keypoint, uv = case.clicks[3]
        x, y = place_of_pixel(page, uv)
        page.mouse.click(x + 3, y)
        wait(page, f"{IDLE} && annotator.state.pairs.length === 1")
        assert session.photos[0].document.pairs[0].keypoint == keypoint
        page.keyboard.press("a")
        wait(page, f"{IDLE} && annotator.state.pairs.length === {len(case.clicks)}")


def test_why_a_photo_cannot_be_shown_is_said(browser: Browser, case: Case) -> None:
    with opened_page(browser, case.open()) as page:
        case.photo.write_bytes(case.photo.read_bytes()[:5000])
        page.reload()
        wait(page, "annotator.layout?.message.textContent.includes('photo.png: not an image')")


def test_marks_of_others_in_the_work_list_are_kept(case: Case) -> None:
    session = case.open(image=case.folder, prepared=False)
    marks = WorkList.open(case.folder).marked(case.folder / "other.png", "done")
    perform(session, 0, {"do": "mark", "mark": "skipped"})
    assert WorkList.open(case.folder).marks == {**marks.marks, "photo.png": "skipped"}
