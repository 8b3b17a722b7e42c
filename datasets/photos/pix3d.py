"""Pix3D: furniture in photos with its exact models, poses, masks and keypoints.

Sun et al., "Pix3D: Dataset and Methods for Single-Image 3D Shape Modeling", CVPR 2018.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.datasets.meshes.load import load_mesh
from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing,
)
from cadalign.datasets.photos.records import parse, read_list
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE
from cadalign.geometry.mesh import Mesh
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
    in_file,
)
from cadalign.io.files import damaged, reading

ANNOTATIONS = "pix3d.json"
# The width of the sensor that focal lengths are for [mm].
_SENSOR = 32.0
# Pix3D's camera has x to the left, y up and z forward.
_PIX3D_AXES = np.array([-1.0, -1.0, 1.0])
_FLAGS = {"truncated": "truncated", "occluded": "occluded", "slightly_occluded": "occluded"}


class _Entry(ForeignDocument):
    img: PathText
    category: Text
    img_size: tuple[Positive, Positive]
    model: PathText | None = None
    mask: PathText | None = None
    keypoints_2d: list[list[Point2]] | None = None
    keypoints_3d: PathText | None = None
    rot_mat: tuple[Point3, Point3, Point3] | None = None
    trans_mat: Point3 | None = None
    focal_length: Positive | None = None
    bbox: tuple[Finite, Finite, Finite, Finite] | None = None
    truncated: bool = False
    occluded: bool = False
    slightly_occluded: bool = False


@dataclass(frozen=True)
class _Model:
    """A model's files, either of which may be missing."""

    mesh_path: Path | None
    keypoints_path: Path | None

    def load_mesh(self) -> Mesh | None:
        return None if self.mesh_path is None else load_mesh(self.mesh_path)

    def load_keypoints(self) -> NamedPoints | None:
        if self.keypoints_path is None:
            return None
        with reading(self.keypoints_path):
            rows = self.keypoints_path.read_text(encoding="utf-8").split("\n")
        try:
            xyz = np.array([row.split() for row in rows if row.strip()], dtype=np.float64)
        except ValueError:
            raise damaged("not a table of numbers", self.keypoints_path) from None
        if xyz.ndim != 2 or xyz.shape[1] != 3 or not np.isfinite(xyz).all():
            raise damaged("not a table of x, y, z", self.keypoints_path)
        return NamedPoints(tuple(str(row) for row in range(len(xyz))), xyz)


class Pix3D(PhotoDataset):
    """Photos with one annotated object each, as ``pix3d.json`` lists them.

    The pose is complete, but its unit is the model's own. The camera's focal length is the
    annotation's estimate, on a sensor of 32 mm across the image; its principal point is the
    image's middle. Pix3D's camera has x to the left, y up and z forward. Keypoints are named by
    their numbers: of several annotators' the mean of those who marked them. Pixels are counted
    from the corner of the image there, from the corner pixel's centre here.

    Parameters
    ----------
    root : str or path-like
        The folder of ``pix3d.json``.

    Raises
    ------
    DataError
        If the file is missing or cannot be read.
    """

    kind = "Pix3D"

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = Path(root)
        self._entries = read_list(folder / ANNOTATIONS)
        super().__init__(folder, (str(number) for number in range(len(self._entries))))

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        path, where = self.root / ANNOTATIONS, f"[{index}]"
        # Names that begin with a digit are no fields.
        fields = parse(self._entries[index], dict[str, Any], path=path, where=where)
        for name in ("2d_keypoints", "3d_keypoints"):
            if name in fields:
                fields[f"keypoints_{name[:2]}"] = fields[name]
        for name in _FLAGS:  # some entries have texts
            fields[name] = str(fields.get(name, False)).lower() == "true"
        with in_file(path):
            entry: _Entry = convert(fields, _Entry, where)
        width, height = map(int, entry.img_size)
        camera = Camera.without_focal(width, height)
        if entry.focal_length is not None:
            camera = camera.with_focal(entry.focal_length / _SENSOR * width)
        shown = PhotoObject(
            object_id="0",
            category=entry.category,
            truth=_truth(entry),
            keypoints=_keypoints(entry),
            model=self._model(entry),
            mask_path=None if entry.mask is None else existing(self.root / entry.mask),
            bbox=None if entry.bbox is None else np.array(entry.bbox) - PIXEL_CENTRE,
            flags=frozenset(flag for name, flag in _FLAGS.items() if getattr(entry, name)),
        )
        return Photo(self.names[index], existing(self.root / entry.img), camera, (shown,))

    def _model(self, entry: _Entry) -> CadModel | None:
        if entry.model is None:
            return None
        keypoints = None if entry.keypoints_3d is None else self.root / entry.keypoints_3d
        files = _Model(
            existing(self.root / entry.model), None if keypoints is None else existing(keypoints)
        )
        return CadModel(entry.model, files)


def _truth(entry: _Entry) -> Truth:
    if entry.rot_mat is None or entry.trans_mat is None:
        return Truth()
    rotation = _PIX3D_AXES[:, None] * nearest_rotation(np.array(entry.rot_mat))
    return Truth(Alignment(rotation, _PIX3D_AXES * entry.trans_mat, np.ones(3)))


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
    mean = [given[is_marked[:, row], row].mean(axis=0) - PIXEL_CENTRE for row in rows]
    names = tuple(str(row) for row in rows)
    return PhotoKeypoints(np.array(mean), names, np.ones(len(rows), dtype=bool))
