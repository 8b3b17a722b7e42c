"""Pairs, their edits, undo and redo, and the names of model points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign.annotate.keypoints import KeypointRegistry, ObjectShape
from cadalign.annotate.marks import History, Marks, Pair
from cadalign.annotate.skeleton import open_skeleton
from cadalign.datasets import ModelKeypoint
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera

CAMERA = Camera.from_size(640, 480)
EMPTY = Marks(CAMERA, open_skeleton(ObjectShape.open(Path("mug"))))


def test_either_half_may_come_first() -> None:
    photo_first, pair = EMPTY.place_uv((1.0, 2.0))
    photo_first, again = photo_first.place_keypoint(5)
    model_first, _ = EMPTY.place_keypoint(5)
    model_first, _ = model_first.place_uv((1.0, 2.0))
    assert pair == again == 1
    assert photo_first.complete_pairs == model_first.complete_pairs
    assert photo_first.complete_pairs == (Pair(1, (1.0, 2.0), 5),)


def test_halves_fill_the_oldest_gap_unless_another_pair_is_preferred() -> None:
    marks = EMPTY
    for u in range(3):
        marks, _ = marks.place_uv((float(u), 0.0))
    first, number = marks.place_keypoint(7)
    assert number == 1
    preferred, number = marks.place_keypoint(7, preferred=3)
    assert number == 3
    assert preferred.pair(3).complete
    # The preferred pair has this half already: the oldest incomplete pair gets it.
    _, number = first.place_keypoint(8, preferred=1)
    assert number == 2


def test_numbers_are_never_given_twice() -> None:
    marks, first = EMPTY.place_uv((0.0, 0.0))
    marks, second = marks.delete(first).place_uv((0.0, 0.0))
    assert second != first


def test_releasing_the_model_half_keeps_the_photo_half() -> None:
    marks, pair = EMPTY.place_uv((1.0, 2.0))
    marks, _ = marks.place_keypoint(5)
    assert marks.release_keypoint(pair).pairs == (Pair(1, (1.0, 2.0)),)
    lone, pair = EMPTY.place_keypoint(5)
    assert lone.release_keypoint(pair).pairs == ()


def test_a_keypoint_has_one_place() -> None:
    marks, _ = EMPTY.place_keypoint(5)
    with pytest.raises(InputError) as error:
        marks.place_keypoint(5)
    assert str(error.value) == (
        "keypoint: this keypoint is already used by pair 1; "
        "move or delete that pair: a keypoint occurs once in a photo"
    )


def test_unknown_pair_is_refused() -> None:
    with pytest.raises(InputError, match=r"^pair: there is no pair 9; reload the page$"):
        EMPTY.move(9, (0.0, 0.0))


# --- undo ------------------------------------------------------------------------------------

EDITS = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 5)), max_size=25)


def edited(marks: Marks, edit: int, which: int) -> Marks:
    """Apply one kind of edit, to one of the pairs if there are any."""
    numbers = [pair.number for pair in marks.pairs]
    if edit == 0 or not numbers:
        return marks.place_uv((float(which), 1.0))[0]
    if edit == 1:
        free = min(set(range(30)) - marks.keypoints)
        return marks.place_keypoint(free)[0]
    number = numbers[which % len(numbers)]
    if edit == 2:
        return marks.move(number, (float(which), 2.0))
    if edit == 3:
        return marks.delete(number)
    return replace(marks, camera=CAMERA.replace_focal(100.0 + which))


@pytest.mark.long
@given(EDITS)
def test_undo_leads_back_through_every_marks_and_redo_forth(
    edits: list[tuple[int, int]],
) -> None:
    history = History(EMPTY)
    markss = [EMPTY]
    for edit, which in edits:
        history.record(edited(history.marks, edit, which))
        markss.append(history.marks)
    for expected in markss[-2::-1]:
        assert history.undo()
        assert history.marks is expected
    assert not history.before
    assert not history.undo()
    for expected in markss[1:]:
        assert history.redo()
        assert history.marks is expected
    assert not history.redo()


@given(EDITS)
def test_no_keypoint_is_used_twice_whatever_is_done(edits: list[tuple[int, int]]) -> None:
    marks = EMPTY
    for edit, which in edits:
        marks = edited(marks, edit, which)
        used = [pair.keypoint for pair in marks.pairs if pair.keypoint is not None]
        assert len(used) == len(set(used))
        numbers = [pair.number for pair in marks.pairs]
        assert len(numbers) == len(set(numbers))


def test_an_edit_after_an_undo_forgets_what_was_undone() -> None:
    history = History(EMPTY)
    history.record(EMPTY.place_uv((1.0, 1.0))[0])
    history.undo()
    history.record(EMPTY.place_uv((2.0, 2.0))[0])
    assert not history.after


# --- the model's keypoints -------------------------------------------------------------------


A_AND_B = ModelKeypoint("a", (0, 0, 0), 0), ModelKeypoint("b", (1, 0, 0), 1)


def registry_of(*points: ModelKeypoint, tolerance: float = 0.0) -> KeypointRegistry:
    """A registry of given points."""
    registry = KeypointRegistry(tolerance=tolerance)
    registry.merge(points)
    return registry


def test_points_without_id_or_name_get_free_ones() -> None:
    registry = registry_of(
        ModelKeypoint("seat", (0, 0, 0)), ModelKeypoint("seat", (1, 0, 0), semantic_id=4)
    )
    added = registry.add(ModelKeypoint("", (2, 0, 0)))
    assert {number: point.name for number, point in registry} == {
        4: "seat",
        5: "seat (2)",
        added: f"point {added}",
    }
    assert registry.file_ids == {4, 5}
    assert added == 6


def test_points_are_found_by_their_place() -> None:
    registry = registry_of(*A_AND_B, tolerance=0.01)
    assert registry.find((0.999, 0, 0)) == 1
    assert registry.find((0.9, 0, 0)) is None
    assert KeypointRegistry(tolerance=1).find((0, 0, 0)) is None


def test_names_are_checked() -> None:
    registry = registry_of(*A_AND_B)
    registry.rename(0, "  front   left ")
    assert registry[0].name == "front left"
    with pytest.raises(InputError, match=r"^name: another keypoint is called 'b'; choose"):
        registry.rename(0, "b")
    for bad in ("", " \n ", 81 * "x"):
        with pytest.raises(InputError, match=r"is empty or too long; give 1 to 80 characters$"):
            registry.rename(0, bad)
    with pytest.raises(InputError, match=r"^keypoint: there is no keypoint 9; reload the page$"):
        registry.rename(9, "c")


def test_points_of_an_earlier_session_are_taken_in() -> None:
    registry = registry_of(*A_AND_B, tolerance=1e-6)
    registry.merge(
        [
            ModelKeypoint("renamed", (1e-9, 0, 0), 0),
            ModelKeypoint("placed", (2, 0, 0), 7),
            ModelKeypoint("elsewhere", (5, 0, 0), 1),
        ]
    )
    names = {number: point.name for number, point in registry}
    assert names == {0: "renamed", 1: "b", 7: "placed", 8: "elsewhere"}
    assert registry.file_ids == {0, 1, 7, 8}
