"""What a mask allows of a model that is only similar: told apart by clicks, on the page too."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from support.annotating import (
    IDLE,
    Case,
    make_case,
    masks_searched_once,
    opened_page,
    place_of_pixel,
    wait,
)

from cadalign.annotate.actions import perform
from cadalign.annotate.candidates import best_click, clicks_needed, updated
from cadalign.annotate.evidence import encode_runs
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.datasets import KeypointNet, ModelKeypoints, write_sample_dataset
from cadalign.metrics import rotation_error
from cadalign.render import cast_geometry

SIGMAS = np.full((3, 2), 10.0)
SEEN = np.ones((3, 2), dtype=bool)
# The first keypoint tells the first candidate from the rest, the second all three.
PLACES = np.array([[[0, 0], [0, 0]], [[90, 0], [90, 0]], [[90, 0], [0, 90]]], dtype=float)
EQUAL = np.full(3, 1 / 3)


def test_the_keypoint_that_leaves_least_confusion_is_clicked_first() -> None:
    assert best_click(EQUAL, PLACES, SIGMAS, SEEN) == 1
    assert clicks_needed(EQUAL, PLACES, SIGMAS, SEEN) == 1
    hidden = SEEN & np.array([True, False])
    assert best_click(EQUAL, PLACES, SIGMAS, hidden) == 0
    assert clicks_needed(EQUAL, PLACES, SIGMAS, hidden) is None  # two predict the same
    assert best_click(np.array([0.0, 0.5, 0.5]), PLACES, SIGMAS, hidden) is None
    assert clicks_needed(np.array([1.0, 0.0, 0.0]), PLACES, SIGMAS, SEEN) == 0


def test_a_click_rules_out_what_predicts_it_elsewhere() -> None:
    first = PLACES[:, :1], SIGMAS[:, :1]
    np.testing.assert_allclose(updated(EQUAL, *first, np.array([[85.0, 3.0]])), [0, 0.5, 0.5])
    assert not updated(EQUAL, *first, np.array([[300.0, 300.0]])).any()
    between = updated(np.array([0.5, 0.5, 0.0]), *first, np.array([[45.0, 0.0]]))
    np.testing.assert_allclose(between, [0.5, 0.5, 0.0])
    assert (updated(EQUAL, *first, np.array([[35.0, 0.0]]))[0] > 1 / 3).all()


@pytest.fixture(scope="module", autouse=True)
def _searched_once() -> Iterator[None]:
    with masks_searched_once():
        yield


@dataclass(frozen=True)
class Similar:
    """A photo of a chair, and another chair's model with the keypoints that both have."""

    case: Case
    model: Path
    keypoints: Path

    def open(self) -> Session:
        return self.case.open(model=self.model, keypoints=self.keypoints, shape_sigma=0.06)

    def uv(self, keypoint: int) -> list[float]:
        """Where a keypoint is in the photo."""
        return dict(self.case.clicks)[keypoint]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Similar:
    folder = tmp_path_factory.mktemp("pair") / "sample"
    root = write_sample_dataset(folder, per_category=3, categories=["chair"])
    case = make_case(root, tmp_path_factory.mktemp("annotate"))
    other = KeypointNet(root)["chair", "sample_chair_002"]
    assert other.mesh_path is not None
    every = ModelKeypoints.of_model(other)
    visible = dict(case.clicks)
    shared = tuple(each for each in every.keypoints if each.semantic_id in visible)
    path = case.folder / "other.keypoints.json"
    replace(every, keypoints=shared).save(path)
    return Similar(case, other.mesh_path, path)


@pytest.fixture
def similar(original: Similar, tmp_path: Path) -> Similar:
    case = original.case.copied_to(tmp_path / "photos")
    return replace(original, case=case, keypoints=case.folder / original.keypoints.name)


def masked(similar: Similar) -> Session:
    """A session with the true mask, of which the search is made once for all tests."""
    instance = similar.case.instance
    assert instance.scene is not None
    mask = cast_geometry(instance.scene, instance.camera, instance.cam_from_model).mask
    session = similar.open()
    perform(session, 0, {"do": "mask_load", "runs": list(encode_runs(mask))})
    return session


def is_nearest(session: Session, similar: Similar) -> bool:
    """True if the one that is left is the nearest to the truth of all that the mask allows."""
    live, _ = session.live(session.photos[0])
    truth = similar.case.instance.cam_from_model
    assert live.candidates is not None
    errors = [rotation_error(est=each.alignment, gt=truth) for each in live.candidates.every]
    assert rotation_error(est=live.alignment, gt=truth) < 40
    return np.flatnonzero(live.chances).tolist() == [int(np.argmin(errors))]


@pytest.mark.long
def test_clicks_leave_one_of_what_a_mask_allows(similar: Similar) -> None:
    session = masked(similar)
    page = page_state(session, 0)
    assert page["alignment"]["status"] == "done", page["alignment"]
    first = page["by_mask"]
    assert len(first["candidates"]) > 1
    assert first["text"].startswith("The mask allows several alignments: choose one, or click: ")
    assert first["text"].endswith(("one click settles it.", "clicks settle it."))
    promised = ("no", "one", "two", "three").index(first["text"].split()[-4])
    assert len(page["suggestion"]["others"]) == len(first["candidates"]) - 1
    assert not (similar.case.folder / "photo_fit" / "fit.json").exists()

    before = {each["number"] for each in first["candidates"]}
    for _ in range(promised):
        keypoint = page["suggestion"]["keypoint"]
        perform(session, 0, {"do": "suggested", "uv": similar.uv(keypoint)})
        page = page_state(session, 0)
        assert page["pairs"][-1]["keypoint"] == keypoint
        left = {each["number"] for each in page["by_mask"]["candidates"]}
        assert left < before
        before = left
        if not left:
            break
    assert page["by_mask"]["candidates"] == []
    assert is_nearest(session, similar)
    assert any("saved from the third pair" in note for note in page["alignment"]["notes"])
    perform(session, 0, {"do": "undo"})
    again = page_state(session, 0)["by_mask"]["candidates"]
    assert again
    reopened = page_state(similar.open(), 0)["by_mask"]["candidates"]
    assert [each["number"] for each in reopened] == [each["number"] for each in again]


@pytest.mark.long
def test_a_choice_among_those_that_are_left(similar: Similar) -> None:
    session = masked(similar)
    last = page_state(session, 0)["by_mask"]["candidates"][-1]["number"]
    live, _ = session.live(session.photos[0])
    assert live.candidates is not None
    wanted = live.candidates.every[last].alignment
    perform(session, 0, {"do": "begin_at", "candidate": last})
    page = page_state(session, 0)
    assert page["by_mask"] == {"chosen": True, "candidates": [], "text": ""}
    live, _ = session.live(session.photos[0])
    assert rotation_error(est=live.alignment, gt=wanted) < 10
    # Which `cadalign fit` would not find: it knows no keypoint of the model.
    assert page["alignment"]["notes"][0] == "A proposal: it is saved from the first pair on."
    assert not (similar.case.folder / "photo_fit" / "fit.json").exists()


@pytest.mark.long
def test_pairs_that_no_candidate_predicts_ask_for_more(similar: Similar) -> None:
    session = masked(similar)
    perform(session, 0, {"do": "suggested", "uv": [2.0, 2.0]})
    page = page_state(session, 0)["alignment"]
    assert page["status"] == "none"
    assert page["message"].endswith("2 more pairs to the first alignment.")


@pytest.mark.long
@pytest.mark.parametrize("by_keys", [False, True])
def test_the_page_asks_for_clicks_until_one_is_left(
    browser: Browser, similar: Similar, *, by_keys: bool
) -> None:
    session = masked(similar)
    with opened_page(browser, session) as page:
        expect(page.get_by_text("The mask allows several alignments")).to_be_visible()
        expect(page.get_by_text("Click in the photo: ")).to_be_visible()
        count = page.evaluate("annotator.state.by_mask.candidates.length")
        assert page.locator(".candidates svg").count() == count
        for clicks in range(1, 4):
            keypoint = page.evaluate("annotator.state.suggestion.keypoint")
            at = place_of_pixel(page, similar.uv(keypoint))
            if by_keys:
                page.keyboard.press("n")  # the model's half; the photo's follows
                wait(page, f"{IDLE} && annotator.state.pairs.length === {clicks}")
            page.mouse.click(*at)
            wait(page, f"{IDLE} && annotator.state.pairs.filter((p) => p.uv).length === {clicks}")
            assert page.evaluate("annotator.state.pairs.at(-1).keypoint") == keypoint
            left = page.evaluate("annotator.state.by_mask.candidates.length")
            assert left < count
            count = left
            if not left:
                break
        expect(page.get_by_text("The mask allows several alignments")).to_be_hidden()
        assert clicks <= 2
        assert is_nearest(session, similar)
