"""A file of posed photos: `poses.json` names each photo's camera, model and pose [mm].

The file is described in docs/formats/photo_files.md.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from cadalign.datasets.photos.dataset import PhotoDataset, PhotoFormat, has, parse, read_table
from cadalign.datasets.photos.photo import CadModel, Photo, PhotoObject, Truth, existing
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.documents import Finite, ForeignDocument, PathText, Positive
from cadalign.io.files import as_path

POSES = "poses.json"
_Row = tuple[Finite, Finite, Finite, Finite]


class _Camera(ForeignDocument):
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    width: Positive
    height: Positive


class _Entry(ForeignDocument):
    model: PathText
    cam_from_model: tuple[_Row, _Row, _Row, _Row]
    camera: _Camera


class PosedPhotos(PhotoDataset):
    """Photos of one object each, as ``poses.json`` lists them; see docs/formats/photo_files.md.

    Raises DataError if ``poses.json`` in the folder ``root`` is missing or cannot be read.
    """

    kind = "posed photos (BOP's units)"

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        self._table = read_table(folder / POSES)
        super().__init__(folder, self._table)

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        name = self.names[index]
        entry: _Entry = parse(self._table[name], _Entry, path=self.root / POSES, where=name)
        found = entry.camera
        size = int(found.width), int(found.height)
        camera = Camera(*size, found.fx, found.fy, found.cx, found.cy)
        matrix = np.array(entry.cam_from_model)
        alignment = Alignment(nearest_rotation(matrix[:3, :3]), matrix[:3, 3], np.ones(3))
        model = Path(entry.model)
        shown = PhotoObject(
            object_id="0",
            category=model.stem,
            truth=Truth(cam_from_model=alignment, metres=1e-3),
            model=CadModel(model.stem, existing(self.root / model)),
        )
        return Photo(name, existing(self.root / name), camera, (shown,))


FORMAT = PhotoFormat(f"posed photos: {POSES}", has(POSES), PosedPhotos)
