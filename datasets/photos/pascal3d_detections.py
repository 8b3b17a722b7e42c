"""Photos of PASCAL3D+ with the keypoints of a detector, and without viewpoints.

The layout of the data of Pavlakos et al., "6-DoF Object Pose from Semantic Keypoints", ICRA 2017::

    annot/*.mat           a struct ``annot`` of lists: imgname, class, cad_index
    images/<imgname>.jpg
    cad/<category>.mat    as in PASCAL3D+
    observations/*.json   {"image", "keypoints": [{"name", "uv", "confidence"}]} of each photo
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.mat_files import read_structs
from cadalign.datasets.photos.pascal3d import cad_folder, cad_model, find_image
from cadalign.datasets.photos.photo import Photo, PhotoKeypoints, PhotoObject
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import Finite, ForeignDocument, PathText, Point2, Text, read_document
from cadalign.io.images import photo_size

ANNOTATIONS = "annot"
_OBSERVATIONS = "observations"


class _Keypoint(ForeignDocument):
    uv: Point2
    name: Text
    confidence: Finite | None = None


class _Observation(ForeignDocument):
    image: PathText
    keypoints: list[_Keypoint]


@dataclass(frozen=True)
class _Record:
    category: str
    cad_index: int


class Pascal3DDetections(PhotoDataset):
    """Photos of PASCAL3D+ with a detector's keypoints; see the module's documentation.

    There are no poses, and the file's squares around the objects are crops, no rectangles of
    theirs. Photos that are listed but not there are problems.

    Parameters
    ----------
    root : str or path-like
        The folder.

    Raises
    ------
    DataError
        If there are no lists of photos, or one cannot be read.
    """

    kind = "PASCAL3D+ photos with detected keypoints"

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = Path(root)
        self._records: list[_Record] = []
        names: list[str] = []
        for path in sorted((folder / ANNOTATIONS).glob("*.mat")):
            found = read_structs(path, "annot")[0]
            try:
                images, categories = found.texts("imgname"), found.texts("class")
                indices = found.array("cad_index").ravel()
            except InputError as error:
                raise DataError(error.what, where=f"{path}: {error.where}") from None
            counts = {len(each) for each in (images, categories, indices)}
            if len(counts) != 1:
                raise DataError("its lists have different lengths", where=str(path))
            names += images
            self._records += [
                _Record(category, int(index))
                for category, index in zip(categories, indices, strict=True)
            ]
        if not names:
            raise DataError(f"there are no {ANNOTATIONS}/*.mat", where=str(folder))
        super().__init__(folder, names)
        self._observations: dict[str, Path] | None = None

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        name, record = self.names[index], self._records[index]
        image = find_image(self.root, name)
        if image is None:
            raise DataError("the image is missing", where=f"{self.root}, photo {name}")
        shown = PhotoObject(
            object_id="0",
            category=record.category,
            keypoints=self._keypoints(name),
            model=cad_model(cad_folder(self.root), record.category, record.cad_index),
        )
        return Photo(name, image, Camera.without_focal(*photo_size(image)), (shown,))

    def _keypoints(self, name: str) -> PhotoKeypoints | None:
        if self._observations is None:
            self._observations = {}
            for path in sorted((self.root / _OBSERVATIONS).glob("*.json")):
                stem = Path(read_document(path, _Observation).image).stem
                self._observations[stem] = path
        if name not in self._observations:
            return None
        found = read_document(self._observations[name], _Observation).keypoints
        scores = [each.confidence for each in found if each.confidence is not None]
        return PhotoKeypoints(
            points_2d=np.array([each.uv for each in found], dtype=float).reshape(-1, 2),
            names=tuple(each.name for each in found),
            visible=np.ones(len(found), dtype=bool),
            scores=np.array(scores) if scores else None,
        )
