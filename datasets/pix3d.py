"""Pix3D: photos of furniture with exact CAD models, poses, masks and keypoints.

Sun et al., "Pix3D: Dataset and Methods for Single-Image 3D Shape Modeling", CVPR 2018.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from msgspec import field

from cadalign.datasets.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoDataset,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing_file,
    read_matrix,
)
from cadalign.datasets.records import read_list
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import PIXEL_CENTRE
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    PathText,
    Point2,
    Point3,
    Positive,
    Text,
    convert,
    name_file,
)
from cadalign.io.files import as_path
from cadalign.io.meshes.files import load_mesh

T = TypeVar("T")
ANNOTATIONS = "pix3d.json"
# Sensor width of the annotated focal lengths [mm].
_SENSOR = 32.0
# Pix3D's camera has x to the left, y up and z forward.
_PIX3D_AXES = np.array([-1.0, -1.0, 1.0])


class _Entry(ForeignDocument):
    img: PathText
    category: Text
    img_size: tuple[Positive, Positive]
    model: PathText
    mask: PathText
    focal_length: Positive
    bbox: tuple[Finite, Finite, Finite, Finite]
    rot_mat: tuple[Point3, Point3, Point3] | None = None
    trans_mat: Point3 | None = None
    keypoints_2d: list[list[Point2]] | None = field(default=None, name="2d_keypoints")
    keypoints_3d: PathText | None = field(default=None, name="3d_keypoints")


class Pix3D(PhotoDataset):
    """Photos with one annotated object each, listed in ``pix3d.json``.

    The pose is complete, in model units. The focal length is the annotation's estimate, on a
    sensor 32 mm wide; the principal point is the image's centre. Keypoints are named by their
    numbers; a keypoint's pixel is the mean over the annotators who marked it. Poses are converted
    from Pix3D's camera frame (x left, y up, z forward). Pixels are converted from Pix3D's origin at
    the image corner to pixel centres at integers.

    Raises DataError if ``pix3d.json`` in the folder ``root`` is missing or cannot be read.
    """

    kind = "Pix3D"
    signature = f"Pix3D: {ANNOTATIONS}"
    marks = (ANNOTATIONS,)
    patterns = (ANNOTATIONS, "model/**/*.txt")

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        self._entries = read_list(folder / ANNOTATIONS)
        super().__init__(folder, (str(number) for number in range(len(self._entries))))

    def read(self, index: int) -> Photo:
        """Read the photo at a position, counted from 0."""
        path = self.root / ANNOTATIONS
        with name_file(path):
            entry: _Entry = convert(self._entries[index], _Entry, f"[{index}]")
        width, height = map(int, entry.img_size)
        camera = _camera(width, height, entry.focal_length)
        shown = PhotoObject(
            object_id="0",
            category=entry.category,
            truth=_truth(entry),
            keypoints=_keypoints(entry),
            model=self._model(entry),
            mask_path=existing_file(self.root / entry.mask),
            bbox=np.array(entry.bbox) - PIXEL_CENTRE,
        )
        return Photo(self.names[index], existing_file(self.root / entry.img), camera, (shown,))

    def _model(self, entry: _Entry) -> CadModel:
        mesh, keypoints = partial(_load, self.root / entry.model, load_mesh), None
        if entry.keypoints_3d is not None:
            keypoints = partial(_load, self.root / entry.keypoints_3d, _read_keypoints)
        return CadModel(entry.model, mesh, keypoints)


def _load(path: Path, read: Callable[[Path], T]) -> T | None:
    """Read a model's file; None if it is missing."""
    return read(path) if existing_file(path) else None


def _read_keypoints(path: Path) -> NamedPoints:
    xyz = read_matrix(path, (None, 3))
    return NamedPoints(tuple(str(row) for row in range(len(xyz))), xyz)


@lru_cache(maxsize=64)
def _camera(width: int, height: int, focal_length: float) -> Camera:
    """The camera for an image size [px] and a focal length [mm]."""
    return Camera.from_size(width, height).replace_focal(focal_length / _SENSOR * width)


def _truth(entry: _Entry) -> Truth:
    if entry.rot_mat is None or entry.trans_mat is None:
        return Truth()
    rotation = _PIX3D_AXES[:, None] * nearest_rotation(np.array(entry.rot_mat))
    return Truth(Alignment(rotation, _PIX3D_AXES * entry.trans_mat, np.ones(3), is_valid=True))


def _keypoints(entry: _Entry) -> PhotoKeypoints | None:
    if not entry.keypoints_2d:
        return None
    counts = {len(each) for each in entry.keypoints_2d}
    if len(counts) != 1:
        raise InputError("annotators have different numbers of points", where="2d_keypoints")
    given = np.array(entry.keypoints_2d, dtype=float).reshape(len(entry.keypoints_2d), -1, 2)
    is_marked = np.asarray((given >= 0).all(axis=2))
    rows = np.flatnonzero(is_marked.any(axis=0))
    if not len(rows):
        return None
    marked = np.where(is_marked[:, :, None], given, 0.0)[:, rows]
    mean = marked.sum(axis=0) / is_marked[:, rows].sum(axis=0)[:, None] - PIXEL_CENTRE
    return PhotoKeypoints(mean, tuple(str(row) for row in rows))
