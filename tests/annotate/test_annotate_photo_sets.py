"""Annotations exported as data sets, read back by the readers of these."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest
from support.annotating import Case, place, place_all, served

import cadalign.datasets
from cadalign.annotate.actions import perform
from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.exporting import annotated_photos
from cadalign.annotate.session import Session
from cadalign.cli import main
from cadalign.datasets.photos.photo import Photo
from cadalign.datasets.photos.placed import PlacedObject
from cadalign.errors import CadalignError
from cadalign.export.aligned_object import FORMS, write_photo_set
from cadalign.io.images import read_photo
from cadalign.render import cast_geometry

pytestmark = pytest.mark.long

KINDS = {
    "pix3d": "Pix3D",
    "bop": "BOP",
    "scan2cad": "Scan2CAD",
    "kitti": "KITTI",
    "objectron": "Objectron",
}
HAVE_KEYPOINTS = ("pix3d", "scan2cad", "kitti")
NAMED = ("kitti",)
HAVE_MASKS = ("pix3d", "bop")
RIGID = ("pix3d", "bop")
UPRIGHT = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.8, 0.0, -0.6]])
"""The rotation of a model that stands upright before a level camera."""


@pytest.fixture
def annotated(case: Case) -> Session:
    """Eight pairs and a mask; the clicks of the instance."""
    session = case.open()
    place_all(session, case, count=8)
    pose = case.instance.cam_from_model
    geometry = cast_geometry(session.models[0].cad.scene, case.instance.camera, pose)
    runs = np.flatnonzero(np.diff(np.r_[0, geometry.mask.ravel().astype(int), 0]))
    lengths = np.diff(np.r_[0, runs, geometry.mask.size])
    perform(session, 0, {"do": "mask_load", "runs": [int(each) for each in lengths if each >= 0]})
    return session


def with_pose(photo: Photo, **changed: np.ndarray) -> Photo:
    """The photo with another rotation or stretch of the object."""
    (found,) = photo.objects
    pose = replace(found.truth.cam_from_model, **changed)
    truth = replace(found.truth, cam_from_model=pose)
    return replace(photo, objects=(replace(found, truth=truth),))


@pytest.mark.parametrize("form", FORMS)
def test_what_is_written_is_read_back(annotated: Session, tmp_path: Path, form: str) -> None:
    (photo,) = annotated_photos(annotated)
    scale = np.array([1.0, 1.2, 0.8])  # which some forms have no place for
    photo = with_pose(photo, scale=scale)
    if form == "kitti":
        photo = with_pose(photo, rotation=UPRIGHT)
    folder = tmp_path / form
    assert write_photo_set(folder, [photo], form) == ()
    dataset = cadalign.datasets.open(folder)
    assert dataset.kind == KINDS[form]
    assert not dataset.problems
    (read,) = dataset
    assert not read.problems
    (found,) = read.objects

    placed = PlacedObject(photo, photo.objects[0])
    camera = placed.camera
    assert read.camera is not None
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(read.camera, name) == pytest.approx(getattr(camera, name), abs=1e-9)
    assert isinstance(read.image, Path)
    assert isinstance(photo.image, Path)
    np.testing.assert_array_equal(read_photo(read.image), read_photo(photo.image))

    pose = placed.found.truth.cam_from_model
    bounds = placed.model.bounds
    assert pose is not None
    assert bounds is not None
    corners = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T
    unit = 1000.0 if form == "bop" else 1.0
    if form == "kitti":  # which has yaw alone
        assert found.truth.box is not None
        center = pose.apply(bounds.mean(axis=0)[None])[0]
        np.testing.assert_allclose(found.truth.box.center, center, atol=1e-9)
    elif form == "objectron":
        assert found.truth.box is not None
        there = found.truth.box.corners
        for corner in pose.apply(corners):
            assert np.linalg.norm(there - corner, axis=1).min() < 1e-9
    else:
        assert found.truth.cam_from_model is not None
        ends = corners * scale * unit if form in RIGID else corners
        np.testing.assert_allclose(
            found.truth.cam_from_model.apply(ends) / unit, pose.apply(corners), atol=1e-9
        )
        assert found.model is not None
        mesh = found.model.load_mesh()
        own = placed.model.load_mesh()
        np.testing.assert_array_equal(mesh.faces, own.faces)
        stretched = own.vertices * scale * unit if form in RIGID else own.vertices
        np.testing.assert_allclose(mesh.vertices, stretched, rtol=1e-6, atol=1e-6 * unit)
    if form in HAVE_KEYPOINTS:
        assert found.keypoints is not None
        assert found.model is not None
        points = found.model.load_keypoints()
        assert points is not None
        marked = placed.marked
        assert len(found.keypoints) == len(marked) == 8
        names = placed.names if form in NAMED else tuple(map(str, range(len(placed.names))))
        seen = dict(zip(found.keypoints.names, found.keypoints.points_2d, strict=True))
        for name, own_name in zip(names, placed.names, strict=True):
            np.testing.assert_allclose(seen[name], marked[own_name], atol=1e-6)
    if form in HAVE_MASKS:
        assert found.mask_path is not None
        mask = placed.found.mask_path
        assert mask is not None
        np.testing.assert_array_equal(read_photo(found.mask_path), read_photo(mask))


def test_command_and_page_write_the_same(
    annotated: Session, case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "set"
    given = [str(case.photo), str(case.model), "--camera", str(case.camera), "--no-open"]
    assert main(["annotate", *given, "--export", str(folder), "--form", "pix3d"]) == 0
    assert "1 photos in the form of pix3d" in capsys.readouterr().err.replace("\n", " ")
    with served(annotated) as access:
        headers = {"X-Cadalign-Token": access.token}
        answer = httpx.get(f"{access.address}export/pix3d.zip", headers=headers)
        assert answer.status_code == 200
        refused = httpx.get(f"{access.address}export/xyz.zip", headers=headers)
        assert refused.status_code == 422
        assert "unknown form 'xyz'" in refused.json()["error"]
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    names = sorted(each for each in archive.namelist() if not each.endswith("/"))
    assert names == sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )
    ours = json.loads(archive.read("pix3d.json"))
    theirs = json.loads((folder / "pix3d.json").read_text())
    np.testing.assert_allclose(ours[0]["trans_mat"], theirs[0]["trans_mat"], rtol=1e-9)


def test_photos_that_a_form_cannot_hold_are_left_out(annotated: Session, tmp_path: Path) -> None:
    (photo,) = annotated_photos(annotated)
    about_z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    photo, tilted = (with_pose(photo, rotation=turn @ UPRIGHT) for turn in (np.eye(3), about_z))
    (problem,) = write_photo_set(tmp_path / "two", [tilted, photo], "kitti")
    assert "tilted by" in str(problem)
    assert len(cadalign.datasets.open(tmp_path / "two")) == 1
    with pytest.raises(CadalignError, match="tilted by"):
        write_photo_set(tmp_path / "none", [tilted], "kitti")
    with pytest.raises(CadalignError, match="not empty"):
        write_photo_set(tmp_path / "two", [photo], "pix3d")
    with pytest.raises(CadalignError, match="no photo has an alignment"):
        write_photo_set(tmp_path / "new", [], "pix3d")


def test_skipped_and_unaligned_photos_are_no_part(case: Case) -> None:
    session = case.open()
    assert annotated_photos(session) == []
    place_all(session, case, count=6)
    live, _ = session.live(session.photos[0])
    assert isinstance(live, LiveAlignment)
    assert len(annotated_photos(session)) == 1
    perform(session, 0, {"do": "mark", "mark": "skipped"})
    assert annotated_photos(session) == []
    perform(session, 0, {"do": "mark"})
    place(session, *case.clicks[6])
    assert len(annotated_photos(session)) == 1
