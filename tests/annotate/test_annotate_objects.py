"""Several objects in a photo: files, names, deletion, undo, exports, and what `fit` finds."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tyro
from support.annotating import Case, fitted, flat

from cadalign.annotate.actions import perform
from cadalign.annotate.document import history_path
from cadalign.annotate.evidence import MaskDrawing
from cadalign.annotate.locks import WriterLocks
from cadalign.annotate.opening import find_session_files, open_session
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.page_state import page_state, worklist_state
from cadalign.annotate.session import Session
from cadalign.cli.annotate import Annotate
from cadalign.errors import CadalignError
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long


def put(session: Session, case: Case, count: int, *, slot: int, shift: float = 0.0) -> None:
    """Place pairs of the chair, moved sideways in the photo."""
    for keypoint, (u, v) in case.clicks[:count]:
        perform(session, 0, {"do": "place_uv", "uv": [u + shift, v]}, slot=slot)
        perform(session, 0, {"do": "place_keypoint", "keypoint": keypoint}, slot=slot)


def labels(session: Session, slot: int | None = None) -> list[str]:
    return [each["label"] for each in page_state(session, 0, slot=slot)["objects"]]


@pytest.fixture
def two(case: Case) -> Session:
    """A session with six pairs of the photo's chair, and seven of another one beside it."""
    session = case.open()
    put(session, case, 6, slot=0)
    perform(session, 0, {"do": "add_object", "name": " left  chair "})
    put(session, case, 7, slot=1, shift=8.0)
    return session


def test_each_object_is_a_file_of_which_fit_finds_the_pages_numbers(
    two: Session, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    assert labels(two) == ["object 1", "left chair"]
    for slot, name in enumerate(("photo.json", "photo.object-2.json")):
        page = two.live(two.objects[0][slot])[0].result
        assert page is not None
        command = fitted(case, capsys, name)
        saved = json.loads((case.folder / f"{name[:-5]}_fit" / "fit.json").read_text())
        for found in (command, saved):
            for field in ("alignment", "covariance"):
                expected = page.to_dict()[field]
                np.testing.assert_allclose(flat(found[field]), flat(expected), rtol=1e-9)
        assert len(Observation.load(case.folder / name).points_2d) == 6 + slot
    assert "object" not in json.loads((case.folder / "photo.json").read_text())
    assert Observation.load(case.folder / "photo.object-2.json").object_name == "left chair"


def test_the_boxes_of_all_objects_are_shown(two: Session) -> None:
    state = page_state(two, 0, slot=1)
    first, second = state["objects"]
    assert not first["is_current"]
    assert second["is_current"]
    assert second["box"] == state["alignment"]["box"]
    shift = np.median(np.array(second["box"])[::2]) - np.median(np.array(first["box"])[::2])
    assert 2 < shift < 14


def test_objects_are_found_again_with_their_undo(two: Session, case: Case) -> None:
    perform(two, 0, {"do": "rename_object", "name": "desk"}, slot=0)
    again = case.open()
    assert labels(again) == ["desk", "left chair"]
    assert [len(state.document.pairs) for state in again.objects[0]] == [6, 7]
    before = two.live(two.objects[0][1])[0].result
    after = again.live(again.objects[0][1])[0].result
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before.covariance, after.covariance)
    perform(again, 0, {"do": "undo"}, slot=1)
    assert len(again.objects[0][1].document.complete_pairs) == 6
    perform(again, 0, {"do": "undo"}, slot=0)
    assert labels(again) == ["object 1", "left chair"]


def test_masks_of_objects_are_apart_and_no_photos(two: Session, case: Case) -> None:
    square = [[100, 100], [200, 100], [200, 200], [100, 200]]
    perform(two, 0, {"do": "mask_paint", "points": square}, slot=1)
    assert (case.folder / "photo.object-2.mask.png").exists()
    assert not two.objects[0][0].document.evidence.mask
    session = case.open(image=case.folder)
    assert [each["name"] for each in worklist_state(session)] == ["photo.png"]


def test_a_mask_that_the_options_give_is_of_the_first_object(two: Session, case: Case) -> None:
    mask = case.folder / "given.png"
    cv2.imwrite(str(mask), np.full((480, 640), 255, np.uint8))
    again = case.open(mask=mask, prepared=False)
    assert [each.document.evidence.mask for each in again.objects[0]] == [
        MaskDrawing(str(mask.resolve())),
        None,
    ]


def test_a_deleted_object_is_brought_back(two: Session, case: Case) -> None:
    files = [case.folder / "photo.object-2.json", case.folder / "photo.object-2_fit" / "fit.json"]
    outcome = perform(two, 0, {"do": "delete_object"}, slot=1)
    assert outcome.message == "Deleted: left chair. Ctrl+Z brings it back."
    assert not any(path.exists() for path in files)
    assert not files[1].parent.exists()
    assert labels(two) == ["object 1"]
    state = page_state(two, 0, slot=1)  # of the object that is left
    assert state["image"]["object"] == 0
    assert state["deleted"] == "left chair"
    outcome = perform(two, 0, {"do": "undo"}, slot=0)
    assert outcome.shown is two.objects[0][1]
    assert all(path.exists() for path in files)

    perform(two, 0, {"do": "delete_object"}, slot=1)
    perform(two, 0, {"do": "delete", "pair": 1}, slot=0)
    perform(two, 0, {"do": "undo"}, slot=0)  # of the pair
    assert len(two.objects[0][0].document.pairs) == 6
    assert not files[0].exists()
    perform(two, 0, {"do": "restore_object"}, slot=0)
    assert labels(two) == ["object 1", "left chair"]
    assert page_state(two, 0)["deleted"] is None
    perform(two, 0, {"do": "redo"}, slot=1)
    assert labels(two) == ["object 1"]
    perform(two, 0, {"do": "undo"}, slot=0)
    assert all(path.exists() for path in files)


def test_the_first_object_is_deleted_like_others(two: Session, case: Case) -> None:
    perform(two, 0, {"do": "delete_object"}, slot=0)
    assert labels(two) == ["left chair"]
    assert not case.observation.exists()
    assert labels(case.open()) == ["left chair"]
    perform(two, 0, {"do": "delete_object"}, slot=1)
    assert labels(two) == ["object 1"]  # an empty one, to begin with
    perform(two, 0, {"do": "undo"})
    perform(two, 0, {"do": "undo"})
    assert labels(two) == ["object 1", "left chair"]


def test_a_new_object_does_not_take_a_deleted_ones_place(two: Session) -> None:
    perform(two, 0, {"do": "delete_object"}, slot=1)
    outcome = perform(two, 0, {"do": "add_object"}, slot=0)
    assert outcome.shown is not None
    assert outcome.shown.owner.files.observation.name == "photo.object-3.json"
    assert labels(two) == ["object 1", "object 3"]


def test_objects_have_models_of_their_own(
    two: Session, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    other = case.folder / "other" / case.model.name
    shutil.copytree(case.model.parent, other.parent)
    session = case.open(models=(other,))
    state = page_state(session, 0)
    assert len(state["models"]) == 2
    assert len(set(state["models"])) == 2
    perform(session, 0, {"do": "add_object", "name": "copy", "model": 1})
    shown = page_state(session, 0, slot=2)
    assert shown["image"]["model_number"] == 1
    model = session.objects[0][2].model
    for keypoint, uv in case.clicks[:6]:
        xyz = case.instance.points_3d[case.instance.ids.tolist().index(keypoint)]
        known = model.registry.find(xyz, tolerance=1e-3)
        number = known if known is not None else add_point(model, xyz)
        perform(session, 0, {"do": "place_uv", "uv": uv}, slot=2)
        perform(session, 0, {"do": "place_keypoint", "keypoint": number}, slot=2)
    assert model.keypoints_path != session.models[0].keypoints_path
    assert model.keypoints_path.exists()
    page = session.live(session.objects[0][2])[0].result
    assert page is not None
    command = fitted(case, capsys, "photo.object-3.json")
    np.testing.assert_allclose(
        flat(command["covariance"]), flat(page.to_dict()["covariance"]), rtol=1e-9
    )
    again = case.open()
    assert again.objects[0][2].model.path.samefile(other)
    assert [len(each.document.pairs) for each in again.objects[0]] == [6, 7, 6]


def add_point(model: Any, xyz: np.ndarray) -> int:
    from cadalign.datasets.models.model_keypoints import ModelKeypoint

    x, y, z = xyz.tolist()
    return int(model.registry.add(ModelKeypoint(name="", xyz=(x, y, z))))


def test_the_work_list_counts_all_objects(two: Session) -> None:
    (listed,) = worklist_state(two)
    assert listed["pairs"] == 13
    assert listed["state"] == "begun"
    assert [each["label"] for each in listed["objects"]] == ["object 1", "left chair"]
    assert listed["rms"] == max(each["rms"] for each in listed["objects"])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (
            {"do": "add_object", "name": "left chair"},
            "name: another object of this photo is called",
        ),
        ({"do": "rename_object", "name": "left chair"}, "name: another object of this photo is"),
        ({"do": "add_object", "name": "x" * 61}, "is too long"),
        ({"do": "add_object", "model": 7}, "model: there is no model 7"),
        ({"do": "restore_object"}, "restore: no deleted object is left"),
        ({"do": "add_view", "photo": 0}, r"photo: photo\.png is a photo of this object already"),
        ({"do": "add_view", "photo": 5}, "image: there is no photo 6"),
        ({"do": "remove_view"}, "photo: the object's first photo cannot be taken from it"),
    ],
)
def test_impossible_changes_of_objects_are_refused(
    two: Session, action: dict[str, Any], message: str
) -> None:
    with pytest.raises(CadalignError, match=message):
        perform(two, 0, action, slot=0)
    assert labels(two) == ["object 1", "left chair"]


def test_changes_of_a_deleted_object_are_refused(two: Session) -> None:
    perform(two, 0, {"do": "delete_object"}, slot=1)
    with pytest.raises(CadalignError, match="object: this object was deleted"):
        perform(two, 0, {"do": "delete", "pair": 1}, slot=1)
    with pytest.raises(CadalignError, match="object: there is no object 8 in this photo"):
        perform(two, 0, {"do": "delete", "pair": 1}, slot=7)


def test_an_object_that_another_annotator_has_is_not_written(case: Case) -> None:
    options = SessionOptions(image=case.photo, model=case.model)
    files = find_session_files(options)
    second = case.folder / "photo.object-2.json"
    with (
        WriterLocks(files.written, whole_folder=False, address="first") as first,
        WriterLocks([second], whole_folder=False, address="second"),
    ):
        session = open_session(options, files, before_saving=first.confirm, reserve=first.reserve)
        perform(session, 0, {"do": "add_object"})
        trouble = page_state(session, 0, slot=1)["saved"]["trouble"]
        assert "another annotator has it open: second" in trouble
        perform(session, 0, {"do": "place_uv", "uv": [5, 5]}, slot=0)
        assert case.observation.exists()
    assert not second.exists()


def test_histories_of_earlier_versions_are_read(case: Case) -> None:
    session = case.open()
    put(session, case, 2, slot=0)
    path = history_path(case.observation)
    data = json.loads(path.read_text())
    for rest in data["rests"]:
        for field in ("name", "is_deleted", "further_views"):
            rest.pop(field)
    path.write_text(json.dumps(data))
    again = case.open()
    assert len(again.photos[0].owner.history.before) == 4  # type: ignore[union-attr]


def test_the_command_takes_further_photos_and_models(case: Case) -> None:
    command = tyro.cli(
        Annotate,
        args=["p.png", "m.obj", "--further-photos", "q.png", "r.png", "--models", "a.obj"],
    )
    session = command.session
    assert session.further_photos == (Path("q.png"), Path("r.png"))
    assert session.models == (Path("a.obj"),)


def test_a_photo_called_like_an_object_keeps_its_own_file(two: Session, case: Case) -> None:
    shutil.copy(case.photo, case.folder / "photo.object-2.png")
    session = case.open(image=case.folder)
    names = {state.owner.files.observation.name for state in session.states}
    assert names == {"photo.json", "photo.object-2.json", "photo.object-2.png.json"}
    assert sorted(len(states) for states in session.objects) == [1, 2]
