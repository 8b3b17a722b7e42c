"""Masks, vertical edges and known lengths: used as by `cadalign fit`, saved, and undone."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from support.annotating import Case, agree_with_fit, place_all
from support.refusals import refusal_text

from cadalign import Camera
from cadalign.annotate.actions import perform
from cadalign.annotate.evidence import decode_runs, encode_runs, find_up
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError
from cadalign.io.images import read_grey, write_image
from cadalign.render import cast_geometry

pytestmark = pytest.mark.long


def true_mask(case: Case) -> np.ndarray:
    instance = case.instance
    assert instance.scene is not None
    return cast_geometry(instance.scene, instance.camera, instance.cam_from_model).mask


def true_verticals(case: Case, noise: float = 0.0) -> list[tuple[tuple[float, float], ...]]:
    """Vertical edges about the object, as the photo shows them."""
    instance = case.instance
    rng = np.random.default_rng(0)
    edges = []
    for x, z in ((-0.4, -0.4), (0.4, -0.4), (0.4, 0.4)):
        ends = instance.cam_from_model.apply(np.array([[x, -0.3, z], [x, 0.3, z]]))
        uv = instance.camera.project(ends) + noise * rng.normal(size=(2, 2))
        edges.append(tuple((float(u), float(v)) for u, v in uv))
    return edges


def inside(case: Case, edges: list[Any]) -> list[Any]:
    camera = case.instance.camera
    low, high = np.zeros(2), np.array([camera.width - 1, camera.height - 1])
    return [tuple(tuple(np.clip(end, low, high).tolist()) for end in edge) for edge in edges]


def load(session: Session, mask: np.ndarray) -> None:
    perform(session, 0, {"do": "mask_load", "runs": list(encode_runs(mask))})


def box(u: int, v: int) -> np.ndarray:
    """A mask of some pixels."""
    mask = np.zeros((480, 640), dtype=bool)
    mask[v - 8 : v + 9, u - 8 : u + 9] = True
    return mask


def test_runs_are_those_of_the_pixels() -> None:
    mask = np.random.default_rng(0).uniform(size=(50, 60)) < 0.3
    np.testing.assert_array_equal(decode_runs(encode_runs(mask), 60, 50), mask)
    with pytest.raises(CadalignError, match="60 x 50 pixels"):
        decode_runs((1, 2, 3), 60, 50)


def test_mask_is_used_saved_and_undone(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    without = place_all(session, case, count=6)["alignment"]
    runs = encode_runs(true_mask(case))
    perform(session, 0, {"do": "mask_load", "runs": list(runs)})
    shown = agree_with_fit(session, case, capsys)
    assert shown["also_used"] == "mask"
    assert shown["alignment"] != without["alignment"]
    np.testing.assert_array_equal(read_grey(case.folder / "photo.mask.png") != 0, true_mask(case))
    # Another one takes its place and is undone.
    load(session, box(100, 100))
    np.testing.assert_array_equal(read_grey(case.folder / "photo.mask.png") != 0, box(100, 100))
    perform(session, 0, {"do": "undo"})
    np.testing.assert_array_equal(read_grey(case.folder / "photo.mask.png") != 0, true_mask(case))
    again = case.open(keypoints=None)
    assert page_state(again, 0)["alignment"]["alignment"] == shown["alignment"]
    perform(session, 0, {"do": "undo"})
    assert page_state(session, 0)["alignment"]["also_used"] == ""
    assert "mask" not in json.loads(case.observation.read_text())


def test_mask_of_a_file_is_not_changed(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=5)
    load(session, true_mask(case))
    first = case.folder / "photo.mask.png"
    before = first.read_bytes()
    again = case.open(keypoints=None)
    load(again, box(10, 10))
    assert first.read_bytes() == before
    assert json.loads(case.observation.read_text())["mask"] == "photo.mask-2.png"
    assert (read_grey(case.folder / "photo.mask-2.png") != 0)[10, 10]
    perform(again, 0, {"do": "undo"})
    assert json.loads(case.observation.read_text())["mask"] == "photo.mask.png"
    # Masks are no photos of the folder.
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
    load(session, box(20, 20))
    perform(session, 0, {"do": "mask_cut", "corners": corners})  # beside what is there
    np.testing.assert_array_equal(session.annotation(0).mask, found | box(20, 20))


def test_vertical_edges_tell_gravity(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    place_all(session, case, count=5)
    edges = inside(case, true_verticals(case))
    assert "another" in perform(session, 0, {"do": "vertical", "ends": edges[0]}).message
    assert page_state(session, 0)["alignment"]["also_used"] == ""
    for edge in edges[1:]:
        perform(session, 0, {"do": "vertical", "ends": edge})
    shown = agree_with_fit(session, case, capsys)
    assert shown["also_used"] == "gravity"
    stored = json.loads(case.observation.read_text())
    wanted = case.instance.cam_from_model.rotation @ [0, 1, 0]
    assert np.degrees(np.arccos(np.clip(np.dot(stored["up"], wanted), -1, 1))) < 6
    again = case.open(keypoints=None)
    assert len(page_state(again, 0)["evidence"]["verticals"]) == 3
    perform(again, 0, {"do": "gravity_clear"})
    assert "up" not in json.loads(case.observation.read_text())


def test_direction_and_deviation_of_vertical_edges() -> None:
    camera = Camera.from_fov(640, 480, fov_x=60.0)
    rng = np.random.default_rng(1)
    up = np.array([0.1, -0.9, 0.2])
    up /= np.linalg.norm(up)
    errors = []
    for _ in range(300):
        edges = []
        for x in (-1.0, 0.4, 1.1):
            ends = np.array([x, 0.6, 4.0]) + np.outer([0.0, 1.6], up)
            uv = camera.project(ends) + rng.normal(size=(2, 2))
            edges.append(tuple(map(tuple, uv.tolist())))
        found = find_up(tuple(edges), camera)
        assert found is not None
        angle = np.degrees(np.arccos(np.clip(found[0] @ up, -1, 1)))
        errors.append(angle / found[1])
    # Deviations are of the worst direction, and not below half a degree.
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 1.2
    assert find_up(((((100.0, 100.0)), (100.0, 300.0)),) * 2, camera) is None


def test_known_length_is_used(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    session = case.open()
    place_all(session, case, count=6)
    perform(session, 0, {"do": "lengths", "height": 0.91, "sigma": 0.01})
    assert agree_with_fit(session, case, capsys)["also_used"] == "known height"
    evidence = page_state(case.open(keypoints=None), 0)["evidence"]
    assert evidence["lengths"] == {"width": None, "height": 0.91, "length": None}
    assert evidence["length_sigma"] == 0.01
    with pytest.raises(CadalignError, match="is no length"):
        perform(session, 0, {"do": "lengths", "width": -1})
    perform(session, 0, {"do": "lengths"})
    assert "size" not in json.loads(case.observation.read_text())


def test_a_mask_that_was_taken_from_the_file_does_not_come_back(case: Case) -> None:
    session = case.open(prepared=False)
    place_all(session, case, count=4)
    load(session, box(200, 200))
    assert case.open(prepared=False).photos[0].document.evidence.mask is not None
    data = json.loads(case.observation.read_text())
    assert data.pop("mask") == "photo.mask.png"
    case.observation.write_text(json.dumps(data))
    again = case.open(prepared=False)
    assert again.photos[0].document.evidence.mask is None
    assert len(again.photos[0].document.pairs) == 4


def test_masks_that_cannot_be_the_photos_are_refused(case: Case) -> None:
    small, colored = case.folder / "small.png", case.folder / "colored.png"
    write_image(small, np.full((24, 32), 255, dtype=np.uint8))
    write_image(colored, np.zeros((480, 640, 3), dtype=np.uint8))
    for mask, what in (
        (
            small,
            "the mask has 32 x 24 pixels, the photo 640 x 480; give a mask of the photo's size",
        ),
        (colored, "the image has the mode RGB"),
        (case.folder / "nowhere.png", "no such file"),
    ):
        assert refusal_text(lambda m=mask: case.open(mask=m)).startswith(f"{mask}: {what}")
    session = case.open(prepared=False)
    runs = {"do": "mask_load", "runs": [640 * 480]}
    assert refusal_text(lambda: perform(session, 0, runs)).startswith("mask: no pixel of the mask")
    assert session.photos[0].document.evidence.mask is None


def test_a_mask_of_noise_keeps_no_server_busy(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=6)
    noise = np.random.default_rng(0).uniform(size=(480, 640)) < 0.5
    perform(session, 0, {"do": "mask_load", "runs": list(encode_runs(noise))})
    shown = page_state(session, 0)["alignment"]
    assert shown["status"] == "none"
    assert "photo.png.mask: has a contour of 56," in shown["message"]
    perform(session, 0, {"do": "undo"})
    assert page_state(session, 0)["alignment"]["status"] == "done"


def test_a_mask_of_others_is_not_written_over(case: Case) -> None:
    theirs = case.folder / "photo.mask.png"
    write_image(theirs, np.full((480, 640), 7, dtype=np.uint8))
    kept = theirs.read_bytes()

    def named() -> str:
        (view,) = json.loads(case.observation.read_text())["views"]
        return str(view["mask"])

    for start in ({}, {"mask": theirs}):
        session = case.open(prepared=False, **start)
        perform(session, 0, {"do": "mask_clear"})
        load(session, box(200, 200))
        assert named() == "photo.mask-2.png"
        (case.folder / "photo.mask-2.png").unlink()
        assert theirs.read_bytes() == kept
