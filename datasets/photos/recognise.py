"""Recognition of the data set that lies in a folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cadalign.datasets.photos import bop, pascal3d, pascal3d_detections, pix3d, posed_photos
from cadalign.datasets.photos.bop import Bop
from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.datasets.photos.kitti import KittiCars
from cadalign.datasets.photos.objectron import Objectron, has_annotations
from cadalign.datasets.photos.pascal3d import Pascal3D
from cadalign.datasets.photos.pascal3d_detections import Pascal3DDetections
from cadalign.datasets.photos.pix3d import Pix3D
from cadalign.datasets.photos.posed_photos import PosedPhotos
from cadalign.datasets.photos.scan2cad import Scan2CAD
from cadalign.errors import DataError


@dataclass(frozen=True)
class PhotoFormat:
    """A format of data sets of photos.

    Parameters
    ----------
    signature : str
        What tells it, for messages.
    is_here : callable
        Whether a folder holds it.
    open : callable
        Makes the data set of the folder.
    """

    signature: str
    is_here: Callable[[Path], bool]
    open: Callable[[Path], PhotoDataset]


def _has(*patterns: str) -> Callable[[Path], bool]:
    return lambda folder: any(next(folder.glob(pattern), None) is not None for pattern in patterns)


_SCAN2CAD = ("full_annotations.json", "example_annotation.json", "annot.json", "samples/annot.json")
_KITTI = ("cars.json", "car_tracks.json", "label_2", "label_02", "training/label_2",
          "training/label_02")  # fmt: skip
PHOTO_FORMATS = (
    PhotoFormat("Scan2CAD: full_annotations.json or annot.json", _has(*_SCAN2CAD), Scan2CAD),
    PhotoFormat("Pix3D: pix3d.json", _has(pix3d.ANNOTATIONS), Pix3D),
    PhotoFormat(
        "BOP: scene_gt.json, in the folder or one or two below",
        lambda folder: next(bop.find_scenes(folder), None) is not None,
        Bop,
    ),
    PhotoFormat("KITTI: label_2, label_02, cars.json or car_tracks.json", _has(*_KITTI), KittiCars),
    PhotoFormat(
        "PASCAL3D+ or ObjectNet3D: Annotations with .mat files",
        _has(f"{pascal3d.ANNOTATIONS}/*.mat", f"{pascal3d.ANNOTATIONS}/*/*.mat"),
        Pascal3D,
    ),
    PhotoFormat(
        "PASCAL3D+ photos with detected keypoints: annot/*.mat",
        _has(f"{pascal3d_detections.ANNOTATIONS}/*.mat"),
        Pascal3DDetections,
    ),
    PhotoFormat("posed photos: poses.json", _has(posed_photos.POSES), PosedPhotos),
    PhotoFormat(
        "Objectron: .pbdata files, or JSON files in annotations",
        has_annotations,
        Objectron,
    ),
)
"""The known formats, in the order in which they are looked for."""


def open_photos(path: str | os.PathLike[str]) -> PhotoDataset:
    """Open the data set of photos that lies in a folder, whichever format it has.

    Parameters
    ----------
    path : str or path-like
        The folder; see the classes for what may lie in it: `Scan2CAD`, `Pix3D`, `Bop`, `KittiCars`,
        `Pascal3D`, `Pascal3DDetections`, `PosedPhotos`, `Objectron`.

    Returns
    -------
    PhotoDataset
        Its `PhotoDataset.kind` names the format, `PhotoDataset.summary` counts what is in it.

    Raises
    ------
    DataError
        If there is no such folder, no known format in it, or it cannot be read.

    Examples
    --------
    >>> dataset = cadalign.datasets.open("KITTI/training")  # doctest: +SKIP
    >>> dataset  # doctest: +SKIP
    KittiCars('KITTI/training'): 7481 photos
    """
    folder = Path(path)
    if "\0" in str(path) or not folder.is_dir():
        raise DataError("no such folder", where=repr(str(path)), fix="give a data set's folder")
    for each in PHOTO_FORMATS:
        if each.is_here(folder):
            return each.open(folder)
    raise DataError(
        "no data set of photos is recognised in this folder",
        where=str(folder),
        fix=f"known are: {'; '.join(each.signature for each in PHOTO_FORMATS)}",
    )
