"""PASCAL3D+ and ObjectNet3D: objects in photos with viewpoints, and CAD models with anchors.

Xiang et al., "Beyond PASCAL: A Benchmark for 3D Object Detection in the Wild", WACV 2014;
Xiang et al., "ObjectNet3D: A Large Scale Database for 3D Object Recognition", ECCV 2016.
"""

from __future__ import annotations

import os
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import field

from cadalign.arrays import FloatArray, as_floats
from cadalign.datasets.photos.dataset import PhotoDataset, read_each
from cadalign.datasets.photos.mat_files import read_structs, structs_of
from cadalign.datasets.photos.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing,
    first_existing,
)
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import OPENGL_AXES, Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    Id,
    PathText,
    Point2,
    Positive,
    Text,
    convert,
    in_file,
    read_json,
)
from cadalign.io.files import as_path, listed
from cadalign.io.images import photo_size

ANNOTATIONS = "Annotations"
DETECTED = "annot"
_OBSERVATIONS = "observations"
_MOST_VERTICES = 2**31
# MATLAB counts pixels from 1.
_FIRST_PIXEL = 1.0
# The focal length, in pixels, that annotations without one were made with.
_VIEWPORT = 3000.0
_VISIBLE = 1
_CAD_FOLDERS = ("CAD", "CAD/mat", "cad")
_CAD = "[Cc][Aa][Dd]/**/*.mat"  # files in any of these
_IMAGE_FOLDERS = ("Images", "images")
_IMAGES = (".jpg", ".JPEG", ".jpeg", ".png")


class _Record(ForeignDocument):
    objects: Any = None
    size: dict[str, Positive] | None = None
    imgsize: list[Positive] | None = None

    @property
    def written_size(self) -> tuple[int, int] | None:
        """Width and height of the image, where they are known."""
        size = self.size or dict(zip(("width", "height"), self.imgsize or (), strict=False))
        known = {"width", "height"} <= size.keys()
        return (int(size["width"]), int(size["height"])) if known else None


class _Anchor(ForeignDocument):
    location: Point2 | None = None
    status: Finite | None = None


class _Viewpoint(ForeignDocument):
    azimuth: Finite
    elevation: Finite
    theta: Finite
    distance: Finite
    px: Finite
    py: Finite
    focal: Finite | None = None
    viewport: Finite | None = None


class _Object(ForeignDocument):
    category: Id = field(name="class")
    bbox: tuple[Finite, Finite, Finite, Finite]
    cad_index: Finite | None = None
    anchors: dict[str, _Anchor | None] | None = None
    viewpoint: dict[str, Any] | None = None


class Pascal3D(PhotoDataset):
    """PASCAL3D+, or ObjectNet3D.

    ::

        Annotations/<category>_<source>/<image>.mat    Images/<category>_<source>/<image>.jpg
        Annotations/<image>.mat                        Images/<image>.JPEG     (ObjectNet3D)
        CAD/<category>.mat                             CAD/mat/<category>.mat  (ObjectNet3D)

    The focal length of the photos is not known. Viewpoints were annotated under a conventional one
    (3000 px) and with the principal point at the object: `Truth.camera` is that camera, under
    which `Truth.cam_from_model` fits the photo. Its rotation counts; lengths have no unit. Objects
    without a continuous viewpoint (distance 0) have no pose. Anchors that are visible are the
    keypoints. In PASCAL3D+ only the objects of the folder's category are taken.

    Raises DataError if there are no annotations.
    """

    kind = "PASCAL3D+"
    signature = f"PASCAL3D+ or ObjectNet3D: {ANNOTATIONS} with .mat files"
    marks = (f"{ANNOTATIONS}/*.mat", f"{ANNOTATIONS}/*/*.mat")
    patterns = (f"{ANNOTATIONS}/*.mat", f"{ANNOTATIONS}/*/*.mat", _CAD)

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        # Annotation files, and the category whose objects each annotates; None for all.
        place = folder / ANNOTATIONS
        self._records: list[tuple[Path, str | None]] = [
            *((path, None) for path in listed(place, "*.mat")),
            *((p, p.parent.name.rpartition("_")[0] or None) for p in listed(place, "*/*.mat")),
        ]
        if not self._records:
            what = f"there are no {ANNOTATIONS}/*.mat nor {ANNOTATIONS}/*/*.mat"
            fix = "give the folder of PASCAL3D+ or ObjectNet3D"
            raise DataError(what, where=str(folder), fix=fix)
        names = (path.relative_to(place).with_suffix("").as_posix() for path, _ in self._records)
        super().__init__(folder, names)

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        path, taken = self._records[index]
        with in_file(path):
            found: _Record = convert(read_structs(path, "record")[0], _Record)
        name = self.names[index]
        image = find_image(self.root, name)
        size = found.written_size if image is None else photo_size(image)
        if size is None:
            what = "the image is missing, and its size is unknown"
            raise DataError(what, where=str(path))
        camera = Camera.without_focal(*size)

        def read_object(number: int, each: Any) -> PhotoObject | None:
            shown: _Object = convert(each, _Object)
            if taken not in (None, shown.category):
                return None
            return _object(number, shown, camera, self.root)

        objects, problems = read_each(structs_of(found.objects), read_object, where=str(path))
        return Photo(name, image, camera, objects, problems=problems)


class _Photos(ForeignDocument):
    imgname: list[PathText]
    category: list[Id] = field(name="class")
    cad_index: list[Finite]

    def __post_init__(self) -> None:
        if len({len(each) for each in (self.imgname, self.category, self.cad_index)}) != 1:
            raise InputError("its lists have different lengths")


class _Keypoint(ForeignDocument):
    uv: Point2
    name: Text
    confidence: Finite | None = None


class _Observation(ForeignDocument):
    image: PathText
    keypoints: list[_Keypoint]


class Pascal3DDetections(PhotoDataset):
    """Photos of PASCAL3D+ with the keypoints of a detector, and without viewpoints.

    The layout of the data of Pavlakos et al., "6-DoF Object Pose from Semantic Keypoints", ICRA
    2017::

        annot/*.mat           a struct ``annot`` of lists: imgname, class, cad_index
        images/<imgname>.jpg
        cad/<category>.mat    as in PASCAL3D+
        observations/*.json   {"image", "keypoints": [{"name", "uv", "confidence"}]} of each photo

    There are no poses, and the file's squares around the objects are crops, no rectangles of
    theirs. Photos that are listed but not there are problems.

    Raises DataError if there are no lists of photos, or one cannot be read.
    """

    kind = "PASCAL3D+ photos with detected keypoints"
    signature = f"PASCAL3D+ photos with detected keypoints: {DETECTED}/*.mat"
    marks = (f"{DETECTED}/*.mat",)
    patterns = (f"{DETECTED}/*.mat", f"{_OBSERVATIONS}/*.json", _CAD)

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        self._records: list[tuple[str, int]] = []  # category and number of the CAD model
        names: list[str] = []
        for path in listed(folder / DETECTED, "*.mat"):
            with in_file(path):
                found: _Photos = convert(read_structs(path, "annot")[0], _Photos)
            names += found.imgname
            self._records += zip(found.category, map(int, found.cad_index), strict=True)
        if not names:
            raise DataError(f"there are no {DETECTED}/*.mat", where=str(folder))
        super().__init__(folder, names)
        self._observed: dict[str, list[_Keypoint]] | None = None  # by the photos' names

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        name, (category, cad_index) = self.names[index], self._records[index]
        image = find_image(self.root, name)
        if image is None:
            raise DataError("the image is missing", where=f"{self.root}, photo {name}")
        shown = PhotoObject(
            object_id="0",
            category=category,
            keypoints=self._keypoints(name),
            model=cad_model(self.root, category, cad_index),
        )
        return Photo(name, image, Camera.without_focal(*photo_size(image)), (shown,))

    def _keypoints(self, name: str) -> PhotoKeypoints | None:
        if self._observed is None:
            self._observed = {}
            for path in listed(self.root / _OBSERVATIONS, "*.json"):
                try:
                    with in_file(path):
                        observation = convert(read_json(path), _Observation)
                    self._observed[Path(observation.image).stem] = observation.keypoints
                except DataError as error:
                    self._tell(str(path), error)
        if name not in self._observed:
            return None
        found = self._observed[name]
        scores = [each.confidence for each in found if each.confidence is not None]
        return PhotoKeypoints(
            points_2d=np.array([each.uv for each in found], dtype=float).reshape(-1, 2),
            names=tuple(each.name for each in found),
            scores=np.array(scores) if scores else None,
        )


def find_image(root: Path, name: str) -> Path | None:
    """Find the image of an annotation, named without its ending; None where it is missing."""
    return first_existing(
        root / folder / f"{name}{end}" for folder in _IMAGE_FOLDERS for end in _IMAGES
    )


def cad_model(root: Path, category: str, index: int) -> CadModel | None:
    """The CAD model of a number from 1; None where the category has no file."""
    folders = (root / name for name in _CAD_FOLDERS)
    folder = next((folder for folder in folders if listed(folder, "*.mat")), None)
    if folder is None or not existing(folder / f"{category}.mat"):
        return None
    which = folder / f"{category}.mat", category, index
    name = f"{category}/{index:02d}"
    return CadModel(name, partial(_load_mesh, *which), partial(_load_keypoints, *which))


def _object(number: int, found: _Object, camera: Camera, root: Path) -> PhotoObject:
    index = int(found.cad_index or 0)
    return PhotoObject(
        object_id=str(number),
        category=found.category,
        truth=_truth(found.viewpoint or {}, camera),
        keypoints=_anchors(found.anchors or {}),
        model=cad_model(root, found.category, index) if index >= 1 else None,
        bbox=np.array(found.bbox) - _FIRST_PIXEL,
    )


def _anchors(anchors: dict[str, _Anchor | None]) -> PhotoKeypoints | None:
    marked = {
        name: each.location
        for name, each in anchors.items()
        if each is not None and each.status == _VISIBLE and each.location is not None
    }
    if not marked:
        return None
    points = np.array(list(marked.values())) - _FIRST_PIXEL
    return PhotoKeypoints(points, tuple(marked))


def _truth(viewpoint: dict[str, Any], camera: Camera) -> Truth:
    """The pose, as PASCAL3D+'s ``project_3d.m`` projects the model.

    The camera stands at azimuth, elevation and distance around the model, looks at its origin along
    -z with y up, and is then turned by theta about its axis.
    """
    if not viewpoint.get("distance"):
        return Truth()
    found: _Viewpoint = convert(viewpoint, _Viewpoint, "viewpoint")
    angles = np.array([found.azimuth, found.elevation, found.theta])
    azimuth, elevation, theta = np.radians(np.fmod(angles, 360.0)).tolist()
    focal = (found.focal or 1.0) * (found.viewport or _VIEWPORT)
    across = np.cos(elevation)
    direction = [across * np.sin(azimuth), -across * np.cos(azimuth), np.sin(elevation)]
    center = found.distance * np.array(direction)
    about_x, about_z = np.eye(3)[[0, 2]]
    lean, turn = rotation_from_vector((elevation - np.pi / 2) * about_x), -azimuth * about_z
    upright = lean @ rotation_from_vector(turn)
    rotation = OPENGL_AXES[:, None] * (rotation_from_vector(theta * about_z) @ upright)
    cx, cy = found.px - _FIRST_PIXEL, found.py - _FIRST_PIXEL
    annotated = Camera(camera.width, camera.height, focal, focal, cx, cy)
    pose = Alignment(rotation, -rotation @ center, np.ones(3))
    return Truth(cam_from_model=pose, camera=annotated)


# CAD models -------------------------------------------------------------------------------------


# A category's file has a variable of the category's name: a struct array with ``vertices``,
# ``faces`` (from 1), ``pnames`` and one field per named anchor. x is lateral, y along the length,
# z up. Models have numbers from 1, as in the annotations.


def _load_mesh(path: Path, category: str, index: int) -> Mesh:
    found = _find_cad(path, category, index)
    where = f"{path}: model {index}"
    with in_file(where):
        vertices, faces = _rows(found, "vertices"), _rows(found, "faces")
        if not (np.abs(faces) < _MOST_VERTICES).all():
            raise InputError("has entries that are no numbers of vertices", where="faces")
        return Mesh(vertices, faces.astype(np.int64) - 1, source=where)


def _load_keypoints(path: Path, category: str, index: int) -> NamedPoints | None:
    found = _find_cad(path, category, index)
    with in_file(f"{path}: model {index}"):
        given = found.get("pnames") or []
        names = convert([given] if isinstance(given, str) else given, list[Text], "pnames")
        anchors = {name: _rows(found, name) for name in names if found.get(name) is not None}
    present = {name: xyz[0] for name, xyz in anchors.items() if len(xyz) == 1}
    return NamedPoints(tuple(present), np.array(list(present.values()))) if present else None


def _rows(found: dict[str, Any], name: str) -> FloatArray:
    """A field of points or triangles (k, 3); MATLAB's only row has one dimension."""
    rows = np.array(found.get(name), dtype=object)
    return as_floats(rows.reshape(1, -1) if rows.ndim < 2 else rows, name=name, shape=(None, 3))


def _find_cad(path: Path, category: str, index: int) -> dict[str, Any]:
    models = _models(path, category)
    if not 1 <= index <= len(models):
        raise DataError(f"there is no model {index}, only {len(models)}", where=str(path))
    return models[index - 1]


# A category's file takes a second to read, and all of a category's objects need it.
_models = lru_cache(maxsize=4)(read_structs)
