"""PASCAL3D+ and ObjectNet3D: objects in photos with viewpoints, and CAD models with anchors.

Xiang et al., "Beyond PASCAL: A Benchmark for 3D Object Detection in the Wild", WACV 2014;
Xiang et al., "ObjectNet3D: A Large Scale Database for 3D Object Recognition", ECCV 2016.
"""

from __future__ import annotations

import os
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.dataset import PhotoDataset, read_each
from cadalign.datasets.photos.mat_files import MatStruct, read_structs
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
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    PathText,
    Point2,
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
        found = read_structs(path, "record")[0]
        name = self.names[index]
        image = find_image(self.root, name)
        camera = Camera.without_focal(*_size(found, image))

        def read_object(number: int, each: MatStruct) -> PhotoObject | None:
            category = each.text("class")
            if taken not in (None, category):
                return None
            return _object(number, category, each, camera, self.root)

        objects, problems = read_each(found.structs("objects"), read_object, where=str(path))
        return Photo(name, image, camera, objects, problems=problems)


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
            found = read_structs(path, "annot")[0]
            with in_file(path):
                images, categories = found.texts("imgname"), found.texts("class")
                indices = found.array("cad_index").ravel()
                if len({len(each) for each in (images, categories, indices)}) != 1:
                    raise InputError("its lists have different lengths")
            names += images
            self._records += zip(categories, map(int, indices), strict=True)
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
            visible=np.ones(len(found), dtype=bool),
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


def _size(record: MatStruct, image: Path | None) -> tuple[int, int]:
    if image is not None:
        return photo_size(image)
    size = record.struct("size")
    if size is not None:
        return int(size.number("width")), int(size.number("height"))
    try:
        width, height = record.array("imgsize").ravel()[:2]
    except (InputError, ValueError):
        what = "the image is missing, and its size is unknown"
        raise DataError(what, where=record.where) from None
    return int(width), int(height)


def _object(
    number: int, category: str, found: MatStruct, camera: Camera, root: Path
) -> PhotoObject:
    index = int(found.number("cad_index", default=0.0))
    corners = found.array("bbox").ravel() - _FIRST_PIXEL
    if len(corners) != 4:
        raise InputError(f"{len(corners)} numbers are not a rectangle", where="bbox")
    viewpoint = found.struct("viewpoint")
    return PhotoObject(
        object_id=str(number),
        category=category,
        truth=Truth() if viewpoint is None else _truth(viewpoint, camera),
        keypoints=_anchors(found.struct("anchors")),
        model=cad_model(root, category, index) if index >= 1 else None,
        bbox=corners,
    )


def _anchors(anchors: MatStruct | None) -> PhotoKeypoints | None:
    marked: dict[str, FloatArray] = {}
    for name in anchors.names if anchors else ():
        each = anchors.struct(name) if anchors else None
        if each is not None and each.number("status", default=0.0) == _VISIBLE:
            location = each.array("location", 2)
            if len(location) == 1:
                marked[name] = location[0] - _FIRST_PIXEL
    if not marked:
        return None
    points = np.array(list(marked.values()))
    return PhotoKeypoints(points, tuple(marked), np.ones(len(points), dtype=bool))


def _truth(viewpoint: MatStruct, camera: Camera) -> Truth:
    """The pose, as PASCAL3D+'s ``project_3d.m`` projects the model.

    The camera stands at azimuth, elevation and distance around the model, looks at its origin along
    -z with y up, and is then turned by theta about its axis.
    """
    distance = viewpoint.number("distance", default=0.0)
    if distance == 0:
        return Truth()
    azimuth, elevation, theta = (
        np.radians(np.fmod(viewpoint.number(name), 360.0))
        for name in ("azimuth", "elevation", "theta")
    )
    focal = viewpoint.number("focal", default=1.0) * viewpoint.number("viewport", _VIEWPORT)
    across = np.cos(elevation)
    direction = [across * np.sin(azimuth), -across * np.cos(azimuth), np.sin(elevation)]
    center = distance * np.array(direction)
    about_x, about_z = np.eye(3)[[0, 2]]
    lean, turn = rotation_from_vector((elevation - np.pi / 2) * about_x), -azimuth * about_z
    upright = lean @ rotation_from_vector(turn)
    rotation = OPENGL_AXES[:, None] * (rotation_from_vector(theta * about_z) @ upright)
    cx, cy = (viewpoint.number(name) - _FIRST_PIXEL for name in ("px", "py"))
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
        vertices, faces = found.array("vertices", 3), found.array("faces", 3)
        if not (np.abs(faces) < _MOST_VERTICES).all():
            raise DataError("`faces` has entries that are no numbers of vertices", where=where)
        return Mesh(vertices, faces.astype(np.int64) - 1, source=where)


def _load_keypoints(path: Path, category: str, index: int) -> NamedPoints | None:
    found = _find_cad(path, category, index)
    with in_file(f"{path}: model {index}"):
        names = [name for name in found.texts("pnames") if name in found.names]
        anchors = {name: found.array(name, 3) for name in names}
    present = {name: xyz[0] for name, xyz in anchors.items() if len(xyz) == 1}
    return NamedPoints(tuple(present), np.array(list(present.values()))) if present else None


def _find_cad(path: Path, category: str, index: int) -> MatStruct:
    models = _models(path, category)
    if not 1 <= index <= len(models):
        raise DataError(f"there is no model {index}, only {len(models)}", where=str(path))
    return models[index - 1]


# A category's file takes a second to read, and all of a category's objects need it.
@lru_cache(maxsize=4)
def _models(path: Path, category: str) -> tuple[MatStruct, ...]:
    return read_structs(path, category)
