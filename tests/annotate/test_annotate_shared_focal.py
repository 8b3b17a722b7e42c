"""Objects of one photo share the focal length of its camera."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, aligned_once, fitted, flat

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.arrays import FloatArray
from cadalign.estimation.result import Result
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long


def put(
    session: Session, case: Case, pose: Alignment, *, slot: int, camera: Camera | None = None
) -> None:
    """Place twelve pairs, corners of the model's surface, where a pose has them in the photo."""
    camera, rng = camera or case.instance.camera, np.random.default_rng(slot)
    samples = session.models[0].cad.samples
    inside = camera.contains(camera.project(pose.apply([point.xyz for point in samples])))
    chosen = [point for point, is_in in zip(samples, inside, strict=True) if is_in][:12]
    pixels = camera.project(pose.apply([point.xyz for point in chosen]))
    with aligned_once(session):
        for point, uv in zip(chosen, pixels + 0.5 * rng.normal(size=pixels.shape), strict=True):
            known = session.models[0].registry.find(point.xyz, tolerance=1e-6)
            keypoint = session.models[0].registry.add(point) if known is None else known
            perform(session, 0, {"do": "place_uv", "uv": uv.tolist()}, slot=slot)
            perform(session, 0, {"do": "place_keypoint", "keypoint": keypoint}, slot=slot)


def aligned(session: Session, slot: int) -> Result:
    result = session.live(session.objects[0][slot])[0].result
    assert result is not None
    return result


def focal_fact(session: Session, slot: int) -> str:
    facts: Sequence[dict[str, Any]] = page_state(session, 0, slot=slot)["alignment"]["facts"]
    return next(str(fact["note"]) for fact in facts if fact["label"] == "Focal length")


def saved(case: Case, name: str) -> dict[str, Any]:
    return dict(json.loads((case.folder / f"{name}_fit" / "fit.json").read_text()))


def covariances(found: dict[str, Any]) -> FloatArray:
    return flat(found["covariance"])


@pytest.fixture
def near(case: Case) -> Alignment:
    """A pose of the chair near the camera, where perspective tells the focal length."""
    pose = case.instance.cam_from_model
    return replace(pose, translation=pose.translation * 0.7)


@pytest.fixture
def two(case: Case, near: Alignment) -> Session:
    """A session without a camera, with a chair far off and then one near to it."""
    session = case.open(camera=None)
    put(session, case, case.instance.cam_from_model, slot=0)
    perform(session, 0, {"do": "add_object", "name": "near chair"})
    put(session, case, near, slot=1)
    return session


def test_objects_of_one_photo_share_its_focal_length(two: Session, case: Case) -> None:
    true, together = case.instance.camera.fx, aligned(two, 0)
    assert "the photo's other objects" in focal_fact(two, 0)
    perform(two, 0, {"do": "delete_object"}, slot=1)
    alone = aligned(two, 0)
    assert focal_fact(two, 0) == "estimated"
    assert together.std is not None
    assert alone.std is not None
    assert together.std.focal < 0.8 * alone.std.focal
    assert abs(math.log(together.camera.fx / true)) < abs(math.log(alone.camera.fx / true))
    assert abs(math.log(together.camera.fx / true)) < 3 * together.std.focal
    perform(two, 0, {"do": "restore_object"}, slot=0)
    assert aligned(two, 0).camera == together.camera


def test_deleting_the_other_object_gives_the_answer_alone(case: Case, near: Alignment) -> None:
    session = case.open(camera=None)
    put(session, case, near, slot=0)
    alone = aligned(session, 0).to_dict()
    perform(session, 0, {"do": "add_object"})
    put(session, case, case.instance.cam_from_model, slot=1)
    assert aligned(session, 0).to_dict() != alone
    assert saved(case, "photo")["covariance"] == aligned(session, 0).to_dict()["covariance"]
    perform(session, 0, {"do": "delete_object"}, slot=1)
    assert aligned(session, 0).to_dict() == alone
    np.testing.assert_array_equal(covariances(saved(case, "photo")), covariances(alone))


def test_files_hold_the_prior_of_the_photo_and_open_alike(
    two: Session, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = [aligned(two, slot) for slot in (0, 1)]
    for name in ("photo", "photo.object-2"):
        options = Observation.load(case.folder / f"{name}.json").fit_options
        assert "focal_prior" not in options  # that of usual lenses, which a fit takes by default
    again = case.open(camera=None)
    for slot, result in enumerate(shown):
        np.testing.assert_allclose(aligned(again, slot).camera.fx, result.camera.fx, rtol=1e-6)
    perform(two, 0, {"do": "delete_object"}, slot=1)
    command = fitted(case, capsys, "photo.json")
    np.testing.assert_allclose(
        flat(command["alignment"]), flat(aligned(two, 0).to_dict()["alignment"]), rtol=1e-9
    )


def test_an_object_that_contradicts_another_is_named(case: Case) -> None:
    session, pose = case.open(camera=None), case.instance.cam_from_model
    put(session, case, pose, slot=0)
    alone = aligned(session, 0)
    perform(session, 0, {"do": "add_object", "name": "wide"})
    half = case.instance.camera.with_focal(case.instance.camera.fx / 2)
    closer = replace(pose, translation=pose.translation / 2)
    put(session, case, closer, slot=1, camera=half)
    for slot in (0, 1):
        notes = page_state(session, 0, slot=slot)["alignment"]["notes"]
        assert any("contradicts the focal length of the other objects" in note for note in notes)
        assert focal_fact(session, slot) == "estimated"
    assert aligned(session, 0).to_dict() == alone.to_dict()
