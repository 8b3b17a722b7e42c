"""Masks and the photo itself: used as by `cadalign fit`, saved, reopened, and undone."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
from support.annotating import (
    Case,
    agree_with_fit,
    draw_mask,
    masks_searched_once,
    place,
    place_all,
)

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.errors import CadalignError
from cadalign.io.images import read_grey, write_image
from cadalign.metrics import rotation_error
from cadalign.render import cast_geometry

pytestmark = pytest.mark.long


@pytest.fixture(scope="module", autouse=True)
def _searched_once() -> Iterator[None]:
    with masks_searched_once():
        yield


def true_mask(case: Case) -> np.ndarray:
    instance = case.instance
    assert instance.scene is not None
    return cast_geometry(instance.scene, instance.camera, instance.cam_from_model).mask


def box(u: int, v: int) -> np.ndarray:
    """A mask of some pixels."""
    mask = np.zeros((480, 640), dtype=bool)
    mask[v - 8 : v + 9, u - 8 : u + 9] = True
    return mask


def test_mask_is_used_saved_and_undone(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    place_all(session, case, count=6)
    without = session.live(session.photos[0]).result
    draw_mask(session, true_mask(case))
    shown = agree_with_fit(session, case, capsys)
    assert shown["also_used"] == "mask"
    within = session.live(session.photos[0]).result
    assert within.alignment != without.alignment
    np.testing.assert_array_equal(read_grey(case.folder / "photo.mask.png") != 0, true_mask(case))
    # Another one takes its place and is undone.
    draw_mask(session, box(100, 100))
    np.testing.assert_array_equal(read_grey(case.folder / "photo.mask.png") != 0, box(100, 100))
    perform(session, 0, {"do": "undo"})
    np.testing.assert_array_equal(read_grey(case.folder / "photo.mask.png") != 0, true_mask(case))
    again = case.open(keypoints=None)
    assert again.live(again.photos[0]).result.alignment == within.alignment
    perform(session, 0, {"do": "undo"})
    assert page_state(session, 0)["alignment"]["also_used"] == ""
    assert "mask" not in json.loads(case.observation.read_text())


def test_mask_of_a_file_is_not_changed(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=5)
    draw_mask(session, true_mask(case))
    first = case.folder / "photo.mask.png"
    before = first.read_bytes()
    again = case.open(keypoints=None)
    draw_mask(again, box(10, 10))
    assert first.read_bytes() == before
    assert json.loads(case.observation.read_text())["mask"] == "photo.mask-2.png"
    assert (read_grey(case.folder / "photo.mask-2.png") != 0)[10, 10]
    perform(again, 0, {"do": "undo"})
    assert json.loads(case.observation.read_text())["mask"] == "photo.mask.png"
    # Masks do not count as photos of the folder.
    names = [state.photo.path.name for state in case.open(image=case.folder).photos]
    assert names == ["photo.png"]


def test_box_is_cut_out(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    place_all(session, case, count=6)
    truth = true_mask(case)
    rows, columns = np.nonzero(truth)
    corners = [
        [float(columns.min() - 8), float(rows.min() - 8)],
        [float(columns.max() + 8), float(rows.max() + 8)],
    ]
    perform(session, 0, {"do": "mask_cut", "corners": corners})
    found = read_grey(case.folder / "photo.mask.png") != 0
    whole = np.zeros_like(truth)
    whole[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
    overlap, plain = ((mask & truth).sum() / (mask | truth).sum() for mask in (found, whole))
    assert overlap > max(0.75, plain + 0.1)
    agree_with_fit(session, case, capsys)
    with pytest.raises(CadalignError, match="too small"):
        perform(session, 0, {"do": "mask_cut", "corners": [[1, 1], [2, 2]]})
    draw_mask(session, box(20, 20))
    perform(session, 0, {"do": "mask_cut", "corners": corners})  # beside what is there
    np.testing.assert_array_equal(session.annotation(0).mask, found | box(20, 20))


def test_a_mask_of_another_size_is_said_and_kept_out(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=6)
    draw_mask(session, true_mask(case))
    write_image(case.folder / "photo.mask.png", np.full((24, 32), 255, dtype=np.uint8))
    again = case.open()
    message = page_state(again, 0)["alignment"]["message"]
    assert "32 x 24" in message
    with pytest.raises(CadalignError, match="the mask has 32 x 24 pixels, the photo 640 x 480"):
        _ = again.photos[0].mask


def test_a_mask_of_others_is_not_written_over(case: Case) -> None:
    theirs = case.folder / "photo.mask.png"
    write_image(theirs, np.full((480, 640), 7, dtype=np.uint8))
    kept = theirs.read_bytes()

    def named() -> str:
        return str(json.loads(case.observation.read_text())["mask"])

    for names in (False, True):
        if names:  # the observation's own mask
            data = json.loads(case.observation.read_text())
            data["mask"] = theirs.name
            case.observation.write_text(json.dumps(data))
        session = case.open(prepared=False)
        perform(session, 0, {"do": "mask_clear"})
        draw_mask(session, box(200, 200))
        assert named() == "photo.mask-2.png"
        (case.folder / "photo.mask-2.png").unlink()
        assert theirs.read_bytes() == kept


# --- a mask alone, and the photo itself --------------------------------------------------------


def test_a_mask_alone_is_aligned(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    draw_mask(session, true_mask(case))
    page, truth = page_state(session, 0), case.instance.cam_from_model
    assert page["alignment"]["status"] == "done", page["alignment"]
    live = session.live(session.photos[0])
    assert rotation_error(est=live.result.alignment, gt=truth) < 0.5
    agree_with_fit(session, case, capsys, rtol=1e-6)


def test_few_pairs_beside_a_mask_wait(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    draw_mask(session, true_mask(case))
    state = place_all(session, case, count=2)
    assert (
        "2 pairs do not count: the mask alone aligns until there are 3."
        in (state["alignment"]["notes"])
    )
    agree_with_fit(session, case, capsys, rtol=1e-6)
    assert [pair["residual"] for pair in state["pairs"]] == [None, None]
    place(session, *case.clicks[2])
    third = page_state(session, 0)["alignment"]
    assert third["notes"] == [] or "do not count" not in third["notes"][0]
    assert session.live(session.photos[0]).counts.all()


def test_the_photo_counts_when_it_is_chosen(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    place_all(session, case, count=5)
    before = session.live(session.photos[0])
    perform(session, 0, {"do": "use_photo", "on": True})
    page = page_state(session, 0)
    assert page["evidence"]["photo"]
    assert page["alignment"]["also_used"] == "photo"
    live = session.live(session.photos[0])
    assert [each.kind for each in live.result.evidence] == ["keypoints", "photo"]
    truth = case.instance.cam_from_model
    assert rotation_error(est=live.result.alignment, gt=truth) < rotation_error(
        est=before.result.alignment, gt=truth
    )
    assert json.loads(case.observation.read_text())["fit"]["image"] is True
    agree_with_fit(session, case, capsys, rtol=1e-6)
    assert page_state(case.open(), 0)["evidence"]["photo"]
    perform(session, 0, {"do": "undo"})
    assert not page_state(session, 0)["evidence"]["photo"]
    assert "image" not in json.loads(case.observation.read_text())["fit"]
