"""Data sets of photos written in other forms, and a format that is one module and its line."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.files import write_json
from support.photo_sets import WRITERS, write_bop, write_kitti, write_pix3d, write_scan2cad

import cadalign.datasets
from cadalign import Alignment, Camera
from cadalign.datasets import CadModel, Photo, PhotoDataset, PhotoFormat, PhotoObject, Truth
from cadalign.datasets.formats import PHOTO_FORMATS, open_photos, write_photos
from cadalign.datasets.photos.dataset import has, parse, read_list
from cadalign.datasets.photos.photo import existing
from cadalign.datasets.photos.placed import PlacedObject, converted
from cadalign.errors import DataError, InputError
from cadalign.geometry.box import Box
from cadalign.io.documents import ForeignDocument, PathText, Point3, Positive
from cadalign.io.files import write_json as write_list

# A format of one's own: what it reads, what it writes, its file structs. In the tree this is a
# module of `cadalign.datasets.photos`, and TOY its line in `PHOTO_FORMATS`.


class _Toy(ForeignDocument):
    image: PathText
    mesh: PathText
    category: str
    camera: tuple[int, int, Positive, Positive, float, float]
    rotation: tuple[Point3, Point3, Point3]
    translation: Point3
    scale: Point3


class ToyPhotos(PhotoDataset):
    """Photos of one object each, as ``toy.json`` lists them [m]."""

    kind = "toy"

    def __init__(self, root: Path) -> None:
        self._entries = read_list(root / "toy.json")
        super().__init__(root, map(str, range(len(self._entries))))

    def read(self, index: int) -> Photo:
        entry: _Toy = parse(self._entries[index], _Toy, path=self.root / "toy.json", where="entry")
        pose = Alignment(np.array(entry.rotation), entry.translation, entry.scale)
        model = CadModel("toy", existing(self.root / entry.mesh))
        found = PhotoObject("0", entry.category, truth=Truth(pose, metres=1.0), model=model)
        return Photo(self.names[index], self.root / entry.image, Camera(*entry.camera), (found,))


def write_toy(folder: Path, numbered: Iterable[tuple[int, PlacedObject]]) -> list[InputError]:
    """Write objects as entries of ``toy.json``; returns why objects were left out."""

    def entry(number: int, placed: PlacedObject) -> dict[str, Any]:
        placed.require_plain_camera("toy.json")
        placed.write_model(folder / f"{number}.obj", is_stretched=False)
        c = placed.camera
        return {
            "image": placed.copy_image(folder / f"{number}").name,
            "mesh": f"{number}.obj",
            "category": placed.found.category,
            "camera": [c.width, c.height, c.fx, c.fy, c.cx, c.cy],
            "rotation": placed.pose.rotation.tolist(),
            "translation": placed.pose.translation.tolist(),
            "scale": placed.scale.tolist(),
        }

    entries, problems = converted(numbered, entry)
    write_list(folder / "toy.json", entries)
    return problems


TOY = PhotoFormat("toy", "toy: toy.json", has("toy.json"), ToyPhotos, write_toy)
FORMATS = (*PHOTO_FORMATS, TOY)


def corners(photo: Photo) -> np.ndarray:
    """The corners (8, 3) of the only object's box in the camera [m], in a fixed order."""
    (found,) = photo.objects
    pose = found.truth.cam_from_model
    assert pose is not None
    assert found.model is not None
    bounds = found.model.bounds
    if bounds is None:
        bounds = found.model.load_mesh().bounds
    points = Box.from_model(bounds, pose).corners * (found.truth.metres or 1.0)
    return points[np.lexsort(points.T)]


def depth(photo: Photo) -> float:
    """Depth of the nearest corner [m]."""
    return float(corners(photo)[:, 2].min())


@pytest.mark.parametrize("form", ["toy", "pix3d", "bop", "scan2cad"])
@pytest.mark.parametrize("source", ["Pix3D", "BOP", "Scan2CAD", "PASCAL3D+"])
def test_a_data_set_comes_back_from_another_form(tmp_path: Path, source: str, form: str) -> None:
    given = cadalign.datasets.open(WRITERS[source](tmp_path / "given"))
    assert write_photos(tmp_path / "new", given, form, formats=FORMATS) == ()
    read = open_photos(tmp_path / "new", formats=FORMATS)
    assert len(read) == len(given)
    assert not read.problems
    # Objectron's files lie in folders of their categories.
    for one, other in zip(*(sorted(each, key=depth) for each in (given, read)), strict=True):
        np.testing.assert_allclose(corners(other), corners(one), atol=1e-6)
        np.testing.assert_array_equal(other.read_image(), one.read_image())
        assert other.camera is not None
        camera = one.objects[0].truth.camera or one.camera
        assert camera is not None
        np.testing.assert_allclose(other.camera.matrix, camera.matrix, atol=1e-9)


def test_an_object_that_stands_upright_comes_back_from_kitti(tmp_path: Path) -> None:
    (photo, *_) = cadalign.datasets.open(write_pix3d(tmp_path / "given"))
    (found,) = photo.objects
    level = Rotation.from_euler("xy", [180, 40], degrees=True).as_matrix()
    truth = replace(found.truth, cam_from_model=Alignment(level, [0.1, 0.2, 3.0], (1, 1, 1)))
    upright = replace(photo, objects=(replace(found, truth=truth),))
    assert write_photos(tmp_path / "new", [upright], "kitti") == ()
    (read,) = cadalign.datasets.open(tmp_path / "new")
    np.testing.assert_array_equal(read.read_image(), photo.read_image())
    box = read.objects[0].truth.box
    assert box is not None
    written = box.corners[np.lexsort(np.round(box.corners, 6).T)]
    expected = corners(upright)
    np.testing.assert_allclose(written, expected[np.lexsort(np.round(expected, 6).T)], atol=1e-6)


def test_masks_and_keypoints_come_back(tmp_path: Path) -> None:
    given = cadalign.datasets.open(write_pix3d(tmp_path / "given"))
    write_photos(tmp_path / "bop", given, "bop")
    masks = cadalign.datasets.open(tmp_path / "bop")
    write_photos(tmp_path / "scan2cad", given, "scan2cad")
    marks = cadalign.datasets.open(tmp_path / "scan2cad")
    for photo, masked, marked in zip(given, masks, marks, strict=True):
        (one,), (mask,), (mark,) = photo.objects, masked.objects, marked.objects
        np.testing.assert_array_equal(mask.read_mask(), one.read_mask())
        np.testing.assert_allclose(mask.bbox, one.bbox)
        assert one.keypoints is not None
        assert mark.keypoints is not None
        np.testing.assert_allclose(mark.keypoints.points_2d, one.keypoints.points_2d, atol=1e-6)


def test_what_objects_lack_is_told_and_the_others_are_written(tmp_path: Path) -> None:
    given = cadalign.datasets.open(write_bop(tmp_path / "given"))
    (tmp_path / "given/test/000001/rgb/000001.png").unlink()
    (problem,) = write_photos(tmp_path / "new", given, "pix3d")
    assert str(problem).endswith("test/000001/1: the image of this photo is not there")
    assert len(cadalign.datasets.open(tmp_path / "new")) == 1
    damaged = cadalign.datasets.open(write_pix3d(tmp_path / "damaged"))
    (tmp_path / "damaged/img/1.png").write_bytes(b"no picture")
    (problem,) = write_photos(tmp_path / "rest", damaged, "bop")
    assert "1.png: not an image that can be read" in str(problem)
    assert len(cadalign.datasets.open(tmp_path / "rest")) == 2
    bare = cadalign.datasets.open(write_bop(tmp_path / "bare"))
    (tmp_path / "bare/models/obj_000001.ply").unlink()
    with pytest.raises(InputError, match="model obj_000001: there is no mesh of this model"):
        write_photos(tmp_path / "none", bare, "toy", formats=FORMATS)
    boxes = cadalign.datasets.open(write_kitti(tmp_path / "kitti"))
    with pytest.raises(InputError, match="object 0 has no pose with all scales"):
        write_photos(tmp_path / "boxes", boxes, "bop")
    photo = next(iter(given))
    aside = replace(photo, camera=Camera(320, 240, 300, 300, 140, 119.5))
    with pytest.raises(InputError, match="Pix3D has the principal point in the image's middle"):
        write_photos(tmp_path / "aside", [aside], "pix3d")
    # Nothing is in the way of another try.
    assert [name for name in ("none", "boxes", "aside") if (tmp_path / name).exists()] == []
    escaping = replace(photo, objects=(replace(photo.objects[0], category="../../x"),))
    write_photos(tmp_path / "inside" / "set", [photo, escaping], "pix3d")
    assert not (tmp_path / "x").exists()


def test_what_cannot_be_written_at_all_is_refused(tmp_path: Path) -> None:
    given = cadalign.datasets.open(write_scan2cad(tmp_path / "given"))
    with pytest.raises(InputError, match="unknown form 'toy'") as caught:
        write_photos(tmp_path / "new", given, "toy")
    assert "known are scan2cad, pix3d, bop, kitti" in str(caught.value)
    with pytest.raises(InputError, match="photos: there is no object to write"):
        write_photos(tmp_path / "new", [], "bop")
    with pytest.raises(DataError, match="the folder is not empty"):
        write_photos(tmp_path / "given", given, "bop")


def test_a_damaged_file_of_a_format_of_ones_own_is_told_of(tmp_path: Path) -> None:
    write_json(tmp_path / "toy.json", [{"image": "a.png", "mesh": "a.obj", "category": 3}])
    with pytest.raises(DataError, match=r"toy\.json: entry\.category: 3 is not a text"):
        open_photos(tmp_path, formats=FORMATS)[0]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"toy: toy\.json"):
        open_photos(tmp_path / "empty", formats=FORMATS)
