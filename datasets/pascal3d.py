"""PASCAL3D+: objects in photos with viewpoints, and CAD models with anchors.

Xiang et al., "Beyond PASCAL: A Benchmark for 3D Object Detection in the Wild", WACV 2014.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import field

from cadalign.arrays import FloatArray, as_floats
from cadalign.datasets.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoDataset,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    find_first_file,
    read_each,
)
from cadalign.errors import DataError, InputError, brief
from cadalign.geometry.alignment import OPENGL_AXES, Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    Id,
    Point2,
    Text,
    convert,
    name_file,
)
from cadalign.io.files import as_path, list_folder, read_bytes
from cadalign.io.images import photo_size

ANNOTATIONS = "Annotations"
_FILES = f"{ANNOTATIONS}/*/*.mat"
_MOST_VERTICES = 2**31
# MATLAB counts pixels from 1.
_FIRST_PIXEL = 1.0
# Default focal length of annotations [px].
_VIEWPORT = 3000.0
_VISIBLE = 1
_CAD_FOLDERS = ("CAD", "cad")
_IMAGES, _ENDINGS = "Images", (".jpg", ".JPEG")  # of PASCAL VOC and of ImageNet


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
    """PASCAL3D+.

    ::

        Annotations/<category>_<source>/<image>.mat
        Images/<category>_<source>/<image>.jpg         or .JPEG
        CAD/<category>.mat

    The photos' focal lengths are unknown. Viewpoints were annotated with a conventional focal
    length of 3000 px and the principal point at the object. `Truth.camera` is this camera, and
    `Truth.cam_from_model` fits the photo under it. The rotation is meaningful; lengths have no
    unit. Objects without a continuous viewpoint (distance 0) have no pose. Keypoints are the
    visible anchors. Objects of other categories than the folder's are left out.

    Raises DataError if there are no annotations.
    """

    kind = "PASCAL3D+"
    signature = f"PASCAL3D+: {_FILES}"
    marks = (_FILES,)
    patterns = (_FILES, *(f"{folder}/*.mat" for folder in _CAD_FOLDERS))

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        self._files = list_folder(folder, _FILES)
        if not self._files:
            fix = "give the folder of PASCAL3D+"
            raise DataError(f"there are no {_FILES}", where=str(folder), fix=fix)
        place = folder / ANNOTATIONS
        names = (path.relative_to(place).with_suffix("").as_posix() for path in self._files)
        super().__init__(folder, names)

    def read(self, index: int) -> Photo:
        """Read the photo at a position, counted from 0."""
        path = self._files[index]
        record = read_structs(path, "record")[0]
        name = self.names[index]
        image = find_first_file(self.root / _IMAGES / f"{name}{end}" for end in _ENDINGS)
        if image is None:
            raise DataError(f"its image is not in {_IMAGES}", where=str(path))
        camera = Camera.from_size(*photo_size(image))

        def read_object(number: int, each: Any) -> PhotoObject | None:
            shown: _Object = convert(each, _Object)
            is_of_folder = shown.category == path.parent.name.rpartition("_")[0]
            return _object(number, shown, camera, self.root) if is_of_folder else None

        objects, problems = read_each(
            list_structs(record.get("objects")), read_object, where=str(path)
        )
        return Photo(name, image, camera, objects, problems=problems)


def cad_model(root: Path, category: str, index: int) -> CadModel | None:
    """The CAD model of an index from 1; None if the category has no file."""
    path = find_first_file(root / folder / f"{category}.mat" for folder in _CAD_FOLDERS)
    if path is None:
        return None
    which = path, category, index
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
    """Compute the pose as in PASCAL3D+'s ``project_3d.m``.

    The camera's position is given by azimuth, elevation and distance from the model's origin. The
    camera looks at the origin along -z with y up, and is then turned by theta about its axis.
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


# A category's file has a variable with the category's name: a struct array with ``vertices``,
# ``faces`` (from 1), ``pnames`` and one field per named anchor. x is lateral, y along the length,
# z up. Models are counted from 1, as in the annotations.


def _load_mesh(path: Path, category: str, index: int) -> Mesh:
    found = _find_cad(path, category, index)
    where = f"{path}: model {index}"
    with name_file(where):
        vertices, faces = _rows(found, "vertices"), _rows(found, "faces")
        if not (np.abs(faces) < _MOST_VERTICES).all():
            raise InputError("vertex indices are out of range", where="faces")
        return Mesh(vertices, faces.astype(np.int64) - 1, source=where)


def _load_keypoints(path: Path, category: str, index: int) -> NamedPoints | None:
    found = _find_cad(path, category, index)
    with name_file(f"{path}: model {index}"):
        given = found.get("pnames") or []
        names = convert([given] if isinstance(given, str) else given, list[Text], "pnames")
        anchors = {name: _rows(found, name) for name in names if found.get(name) is not None}
    present = {name: xyz[0] for name, xyz in anchors.items() if len(xyz) == 1}
    return NamedPoints(tuple(present), np.array(list(present.values()))) if present else None


def _rows(found: dict[str, Any], name: str) -> FloatArray:
    """A field of points or triangles (k, 3); a single row is read as one-dimensional."""
    rows = np.array(found.get(name), dtype=object)
    return as_floats(rows.reshape(1, -1) if rows.ndim < 2 else rows, name=name, shape=(None, 3))


def _find_cad(path: Path, category: str, index: int) -> dict[str, Any]:
    models = _models(path, category)
    if not 1 <= index <= len(models):
        raise DataError(f"there is no model {index}, only {len(models)}", where=str(path))
    return models[index - 1]


# MATLAB's files --------------------------------------------------------------------------------

_HEADER = 128
_COMPRESSED = 15
# Size limit of an uncompressed variable: a constant, plus a multiple of the file's size.
_FREE_BYTES, _EXPANSION = 2**26, 32
_FIX = "get the file again; if it has version 7.3, save it in MATLAB with -v7"


def read_structs(path: Path, name: str) -> list[dict[str, Any]]:
    """Read a named struct or array of structs from a .mat file.

    Structs become dictionaries, arrays of structs or texts become lists, empty values become None.

    Raises DataError if the file cannot be read, is not a MATLAB file up to version 7, or has no
    such structs.
    """
    from scipy.io import loadmat, matlab  # takes a while to import

    data = read_bytes(path)
    try:
        if matlab.matfile_version(io.BytesIO(data))[0] == 1:
            data = _decompress(data)
        found = loadmat(io.BytesIO(data), variable_names=[name], simplify_cells=True)
    except Exception as error:  # SciPy raises errors of any type on damaged files
        what = f"not a MATLAB file that can be read ({brief(error)})"
        raise DataError(what, where=str(path), fix=_FIX) from None
    structs = list_structs(_simplify(found.get(name)))
    if not structs:
        raise DataError(f"there are no structs named {name} in this file", where=str(path))
    return structs


def list_structs(value: Any) -> list[dict[str, Any]]:
    """The structs of a field as a list; a single struct is not stored as a list."""
    values = value if isinstance(value, list) else [value]
    return [each for each in values if isinstance(each, dict)]


def _simplify(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _simplify(each) for name, each in value.items()}
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [_simplify(each) for each in value] or None
    return None if np.size(value) == 0 else value


def _decompress(data: bytes) -> bytes:
    """Decompress the variables of a file of version 5 to 7, and check their checksums.

    SciPy compares checksums only after it has read a variable; damaged data can crash it before.
    """
    tag = "<II" if data[_HEADER - 2 : _HEADER] == b"IM" else ">II"
    most = _FREE_BYTES + _EXPANSION * len(data)
    parts, start = [data[:_HEADER]], _HEADER
    while start < len(data):
        kind, size = struct.unpack_from(tag, data, start)
        content = start + struct.calcsize(tag)
        end = content + size
        if end > len(data):
            raise ValueError("it is cut short")
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            parts.append(stream.decompress(data[content:end], most))
            if not stream.eof:
                raise ValueError(f"a variable is cut short, or has more than {most} bytes")
        else:
            parts.append(data[start:end])
        start = end
    return b"".join(parts)


# A category's file takes a second to read, and all objects of the category need it.
_models = lru_cache(maxsize=4)(read_structs)
