"""Several photos of one object: the joint estimate, its file, undo, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, fitted, flat

from cadalign.annotate.actions import perform
from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.locks import Claims
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.cli import main
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long

ADD = {"do": "add_view", "photo": 1}


def turned(case: Case) -> Alignment:
    """The pose in a second photo, from 25 degrees aside."""
    first = case.instance.cam_from_model
    angle = np.radians(25)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    return Alignment(first.rotation @ turn, first.translation, first.scale)


def put(
    session: Session,
    case: Case,
    count: int,
    *,
    photo: int = 0,
    slot: int | None = 0,
    off: float | None = None,
) -> None:
    """Place pairs where the object, turned in the second photo, shows them, ``off`` by so many px.

    By default the first photo's are the clicks of the case, the second's are off by 1 px.
    """
    rng = np.random.default_rng([3, photo])
    pose = turned(case) if photo else case.instance.cam_from_model
    for keypoint, uv in case.clicks[:count]:
        place: Any = uv
        if photo or off is not None:
            (seen,) = case.instance.camera.project(
                pose.apply([session.models[0].registry[keypoint].xyz])
            )
            place = (seen + rng.normal(scale=off or 1.0, size=2)).tolist()
        perform(session, photo, {"do": "place_uv", "uv": place}, slot=slot)
        perform(session, photo, {"do": "place_keypoint", "keypoint": keypoint}, slot=slot)


def opened(case: Case, **options: Any) -> Session:
    """A session of both photos."""
    right = case.folder / "right.png"
    if not right.exists():
        shutil.copy(case.photo, right)
    return case.open(**({"further_photos": (right,)} | options))


@pytest.fixture
def both(case: Case) -> Session:
    """A session with seven pairs in the first photo and six in the second."""
    session = opened(case)
    put(session, case, 7)
    perform(session, 0, ADD)
    put(session, case, 6, photo=1, slot=1)
    return session


def live(session: Session, photo: int, slot: int) -> LiveAlignment:
    found, _ = session.live(session.objects[photo][slot])
    assert isinstance(found, LiveAlignment)
    assert found.result is not None
    return found


def test_page_file_and_fit_agree_in_both_photos(
    both: Session, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = live(both, 0, 0), live(both, 1, 1)
    assert first.result is second.result
    assert (first.place, second.place) == (0, 1)
    page = first.result
    assert page is not None
    saved = json.loads((case.folder / "photo_fit" / "fit.json").read_text())
    for found in (fitted(case, capsys), saved):
        for field in ("alignment", "covariance", "std", "stretch"):
            expected = page.to_dict()[field]
            np.testing.assert_allclose(flat(found[field]), flat(expected), rtol=1e-9, atol=1e-12)
        poses = [view["alignment"] for view in found["views"]]
        assert flat(poses) == pytest.approx(flat([pose.to_dict() for pose in page.poses]), rel=1e-9)
        assert found["warnings"] == list(page.warnings)
    observation = Observation.load(case.observation)
    assert [view.image and view.image.name for view in observation.views] == [
        "photo.png",
        "right.png",
    ]
    assert [len(view.points_2d) for view in observation.views] == [7, 6]
    assert not (case.folder / "right.json").exists()
    truth = case.instance.cam_from_model.scale
    assert np.abs(np.log(page.alignment.scale / truth)).max() < 0.03
    assert np.abs(second.residuals).max() < 4
    box = page_state(both, 1, slot=1)["objects"][0]["box"]
    assert box == page_state(both, 1, slot=1)["alignment"]["box"] != []
    assert box != page_state(both, 0)["alignment"]["box"]


def test_objects_photos_are_found_again(both: Session, case: Case) -> None:
    expected = live(both, 1, 1)
    for again in (opened(case), case.open(image=case.folder), case.open()):
        assert [state.photo.path.name for state in again.photos] == ["photo.png", "right.png"]
        found = live(again, 1, 1)
        assert found.result is not None
        assert expected.result is not None
        np.testing.assert_array_equal(found.result.covariance, expected.result.covariance)
        np.testing.assert_array_equal(found.residuals, expected.residuals)
    before = again.objects[1][1].document.pairs
    perform(again, 1, {"do": "undo"}, slot=1)
    assert len(again.objects[1][1].document.complete_pairs) == len(before) - 1


def test_a_photo_with_few_pairs_does_not_count_yet(case: Case) -> None:
    session = opened(case)
    put(session, case, 7)
    alone, _ = session.live(session.photos[0])
    outcome = perform(session, 0, ADD)
    assert outcome.shown is session.objects[1][1]
    state = page_state(session, 1, outcome)
    assert state["alignment"]["message"] == "3 more pairs to the first alignment of this photo"
    assert isinstance(session.live(session.photos[0])[0], LiveAlignment)
    assert [len(view.points_2d) for view in Observation.load(case.observation).views] == [7]
    # Neither photo nor half a pair is lost.
    perform(session, 1, {"do": "place_uv", "uv": [50, 60]}, slot=1)
    session = opened(case)
    (pair,) = session.objects[1][1].document.pairs
    assert pair.uv == (50, 60)
    assert session.objects[1][1].is_shown
    perform(session, 1, {"do": "delete", "pair": pair.number}, slot=1)
    put(session, case, 2, photo=1, slot=1)
    state = page_state(session, 0)
    notes = state["alignment"]["notes"]
    assert any(note.startswith("right.png is left out: its 2 keypoints") for note in notes)
    message = page_state(session, 1, slot=1)["alignment"]["message"]
    assert message == "1 more pair to the first alignment of this photo"
    assert alone.result is not None


def test_what_is_the_objects_is_shared(both: Session, case: Case) -> None:
    perform(both, 1, {"do": "lengths", "height": 0.8, "sigma": 0.01}, slot=1)
    perform(both, 1, {"do": "prior", "stretch": 0.1}, slot=1)
    perform(both, 1, {"do": "rename_object", "name": "chair"}, slot=1)
    for photo, slot in ((0, 0), (1, 1)):
        state = page_state(both, photo, slot=slot)
        assert state["evidence"]["lengths"]["height"] == 0.8
        assert state["priors"]["stretch"] == 10
        assert state["objects"][0]["label"] == "chair"
        assert "1 other view" in state["alignment"]["also_used"]
    data = json.loads(case.observation.read_text())
    assert data["object"] == "chair"
    assert data["size"]["height"] == 0.8
    assert data["fit"]["stretch_sigma"] == 0.1
    outcome = perform(both, 0, {"do": "undo"})  # in whichever photo it was done
    assert not outcome.message
    assert page_state(both, 1, slot=1)["objects"][0]["label"] == "object 1 of photo.png"


def test_a_mask_of_a_further_photo_is_its_own(
    both: Session, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    corners = np.array([uv for _, uv in case.clicks])
    (u0, v0), (u1, v1) = corners.min(axis=0), corners.max(axis=0)
    square = [[u0, v0], [u1, v0], [u1, v1], [u0, v1]]
    perform(both, 1, {"do": "mask_paint", "points": square}, slot=1)
    assert (case.folder / "photo.right.mask.png").exists()
    views = Observation.load(case.observation).views
    assert [view.evidence.mask is not None for view in views] == [False, True]
    page = live(both, 0, 0).result
    assert page is not None
    command = fitted(case, capsys)
    np.testing.assert_allclose(
        flat(command["covariance"]), flat(page.to_dict()["covariance"]), rtol=1e-9
    )
    again = opened(case)
    assert again.objects[1][1].document.evidence.mask is not None


def test_a_photo_is_taken_from_the_object_and_brought_back(both: Session, case: Case) -> None:
    outcome = perform(both, 1, {"do": "remove_view"}, slot=1)
    assert outcome.shown is both.objects[0][0]
    assert len(Observation.load(case.observation).views) == 1
    state = page_state(both, 1, slot=1)
    assert state["image"]["object"] == 0  # the photo's own, empty object
    assert [each["name"] for each in state["further_photos"]] == ["photo.png"]
    perform(both, 0, {"do": "undo"})
    assert len(Observation.load(case.observation).views) == 2
    assert both.objects[1][1].is_shown
    perform(both, 0, {"do": "redo"})
    perform(both, 0, ADD)
    assert len(both.objects[1]) == 2
    assert not both.objects[1][1].document.pairs


def test_undoing_the_addition_leads_to_another_object(case: Case) -> None:
    session = opened(case)
    perform(session, 0, ADD)
    outcome = perform(session, 1, {"do": "undo"}, slot=1)
    assert outcome.message == "This photo is no longer one of the object's."
    assert page_state(session, 1, outcome, slot=1)["image"]["object"] == 0


def test_undoing_a_change_of_another_photo_says_so(both: Session) -> None:
    message = "That was a change in another photo of this object."
    assert perform(both, 0, {"do": "undo"}).message == message
    assert perform(both, 0, {"do": "redo"}).message == message
    assert not perform(both, 1, {"do": "undo"}, slot=1).message


def test_deleting_the_object_takes_it_from_all_photos(both: Session, case: Case) -> None:
    perform(both, 1, {"do": "delete_object"}, slot=1)
    assert not case.observation.exists()
    assert page_state(both, 1)["image"]["object"] == 0
    outcome = perform(both, 1, {"do": "undo"})
    assert outcome.shown is both.objects[0][0]
    assert len(Observation.load(case.observation).views) == 2


def test_a_photo_of_an_object_can_have_objects_of_its_own(both: Session, case: Case) -> None:
    perform(both, 1, {"do": "add_object", "name": "lamp"}, slot=1)
    put(both, case, 5, photo=1, slot=2)
    assert (case.folder / "right.object-2.json").exists()
    again = opened(case)
    labels = {each["label"] for each in page_state(again, 1, slot=1)["objects"]}
    assert labels == {"lamp", "object 1 of photo.png"}


def test_photos_of_one_camera_share_an_estimated_focal_length(case: Case, tmp_path: Path) -> None:
    session = opened(case, camera=None)
    put(session, case, 7)
    perform(session, 0, ADD)
    put(session, case, 6, photo=1, slot=1)
    first, second = (
        page_state(session, number, slot=slot)["alignment"] for number, slot in ((0, 0), (1, 1))
    )
    assert first["focal"] == second["focal"]
    labels = {fact["label"]: fact for fact in second["facts"]}
    assert labels["Focal length"]["note"] == "estimated"
    saved = Result.from_dict(json.loads((case.folder / "photo_fit" / "fit.json").read_text()))
    assert saved.cameras[0].fx == saved.cameras[1].fx == first["focal"]
    assert main(["fit", str(case.observation), "--out", str(tmp_path / "x")]) == 0
    fitted = Result.from_dict(json.loads((tmp_path / "x" / "fit.json").read_text()))
    assert fitted.camera.fx == pytest.approx(first["focal"], rel=1e-6)


def test_an_assumed_focal_length_of_one_photo_keeps_the_alignment_from_being_saved(
    case: Case,
) -> None:
    session = opened(case, camera=None)
    focal = {"do": "focal", "known": True, "pixels": case.instance.camera.fx}
    perform(session, 0, focal)
    put(session, case, 7)
    perform(session, 0, ADD)
    perform(session, 1, {"do": "focal", "known": False}, slot=1)
    put(session, case, 6, photo=1, slot=1)
    notes = page_state(session, 0)["alignment"]["notes"]
    assert notes[0].startswith("The focal length of right.png is assumed. Choose 'known' in that")
    assert not (case.folder / "photo_fit" / "fit.json").exists()
    perform(session, 1, focal, slot=1)
    assert (case.folder / "photo_fit" / "fit.json").exists()


def test_photos_beside_a_rig_are_refused(case: Case) -> None:
    instance = case.instance
    from cadalign.io.evidence import ImageEvidence

    first = Observation(
        instance.points_3d,
        instance.points_2d,
        instance.camera,
        image=case.photo,
        evidence=ImageEvidence(cam_from_rig=np.eye(4)),
    )
    first.save(case.observation)
    session = opened(case)
    with pytest.raises(CadalignError, match="the cameras of this object's photos are known"):
        perform(session, 0, ADD)


def test_a_missing_further_photo_is_named(case: Case) -> None:
    with pytest.raises(CadalignError, match=r"gone\.png"):
        case.open(further_photos=(Path("gone.png"),))


def test_one_writer_has_all_photos_of_an_object() -> None:
    claims = Claims(clock=lambda: 0.0)
    claims.take({1}, "one", "ann")
    with pytest.raises(InputError, match="someone else is annotating this photo"):
        claims.take({0, 1}, "two", "bob")
    claims.take({0}, "three", "cleo")  # it was not taken with the other


def test_pairs_of_a_similar_model_are_taken_for_as_far_off_as_they_are(case: Case) -> None:
    session = opened(case)
    perform(session, 0, ADD)
    off = 8.0
    for photo in (0, 1):
        put(session, case, 7, photo=photo, slot=photo, off=off)
    found = live(session, 0, 0)
    assert off / 2 < found.sigma < 2 * off
    assert found.result is not None
    errors = np.log(found.result.alignment.scale / case.instance.cam_from_model.scale)[1:]
    assert np.abs(errors).max() < 3 * max(found.result.std.scale[1:])
    # What the file says of pairs that are gone does not hold for others.
    again = opened(case)
    for pair in again.objects[1][1].document.pairs[:4]:
        perform(again, 1, {"do": "delete", "pair": pair.number}, slot=1)
    assert live(again, 0, 0).sigma != found.sigma
