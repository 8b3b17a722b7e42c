"""Bundler's models: photos with known poses and the points that they see.

Snavely, Seitz and Szeliski, "Photo Tourism", SIGGRAPH 2006. The format is described in the manual
of Bundler 0.4, https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.sfm.bundler_file import read_bundler
from cadalign.datasets.sfm.correspondences import Correspondences, CorrespondenceSet, rigid_pose
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import OPENGL_AXES
from cadalign.io.images import open_photo

ImageSize = tuple[int, int]
"""Width and height [px]."""

# Bundler's camera looks down -z with y up, cadalign's down z with y down.
_IMAGE_SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".ppm", ".pgm", ".tif", ".tiff", ".bmp"))
# How far keypoints may lie outside the image's pixel centres [px].
_MARGIN = 1.0


class Bundler(CorrespondenceSet):
    """The photos of a Bundler model (``bundle.out``, version 0.3), in the file's order.

    Poses are turned into cadalign's axes and observations into its pixels: Bundler's origin is the
    middle of the image, ((w - 1) / 2, (h - 1) / 2), its y points up. The principal point is the
    middle of the image, the distortion (k1, k2).

    Photos that Bundler could not place (focal length 0) are left out; `unplaced` names them. Ids
    are the names in ``list.txt``, or in the folder ``images``, or else the position in the file.

    Parameters
    ----------
    path : str or path-like
        The file, or a folder with one ``*.out`` in it (or in ``bundle``).
    sizes : (width, height), or a sequence of one for each photo of the file, optional
        Image sizes [px]. By default those of the photos, which are sought beside the file: those
        that ``list.txt`` names, or the files of a folder ``images`` in the order of their names if
        they are as many as the file's photos. Where there are none, the smallest size that has
        all of the observations in the image, which does not change any projection.

    Raises
    ------
    DataError
        If the file is missing, cut short or malformed. Asking for an image raises it if its camera
        is invalid or an observation lies outside the photo.
    InputError
        If ``sizes`` don't match the file.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        sizes: ImageSize | Sequence[ImageSize] | None = None,
    ) -> None:
        file = _find_file(Path(path))
        self._model = read_bundler(file)
        count = len(self._model.cameras)
        self._sizes = _as_sizes(sizes, count)
        photos = _find_photos(file, count)
        self._photos = photos.paths
        placed = self._model.cameras[:, 0] != 0
        self._rows = np.flatnonzero(placed)
        self.unplaced = tuple(photos.names[row] for row in np.flatnonzero(~placed))
        """The ids of the photos without a pose."""
        super().__init__(file, [photos.names[row] for row in self._rows])

    def _read(self, position: int) -> Correspondences:
        row = int(self._rows[position])
        name = self.ids[position]
        focal, k1, k2 = self._model.cameras[row, :3].tolist()
        points, centred = self._model.views(row)
        width, height = self._size(row, centred, name)
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        pose = self._model.cameras[row, 3:].reshape(4, 3)
        return Correspondences(
            id=name,
            points_3d=self._model.points[points],
            points_2d=centred * (1, -1) + middle,
            camera=Camera(width, height, focal, focal, middle[0], middle[1], (k1, k2, 0.0, 0.0)),
            cam_from_world=rigid_pose(OPENGL_AXES[:, None] * pose[:3], OPENGL_AXES * pose[3]),
            point_ids=points,
        )

    def _size(self, row: int, centred: FloatArray, name: str) -> ImageSize:
        size, photo = None, self._photos[row]
        if self._sizes is not None:
            size = self._sizes[row]
        elif photo is not None:
            size = _photo_size(photo)
        reach = np.abs(centred).max(axis=0, initial=0.0)
        if not np.isfinite(reach).all():
            raise InputError("an observation is NaN or infinite", where="observations")
        if size is None:
            return 2 * int(np.ceil(reach[0])) + 1, 2 * int(np.ceil(reach[1])) + 1
        if (reach > (np.array(size) - 1) / 2 + _MARGIN).any():
            raise DataError(
                f"observations reach {reach[0]:.1f} and {reach[1]:.1f} px from the middle, outside "
                f"an image of {size[0]} x {size[1]}",
                where=f"{self.source}, image {name}",
                fix="give the sizes of the photos that the model was made from",
            )
        return size


@dataclass(frozen=True)
class _Photos:
    """The ids of a model's photos and their files, where there are any."""

    names: tuple[str, ...]
    paths: tuple[Path | None, ...]


def _find_file(path: Path) -> Path:
    if path.is_file():
        return path
    if not path.is_dir():
        raise DataError("no such file", where=str(path), fix="give a bundle.out")
    for pattern in ("bundle.out", "bundle/bundle.out", "*.out"):
        found = sorted(path.glob(pattern))
        if len(found) == 1:
            return found[0]
        if found:
            names = ", ".join(file.name for file in found)
            raise DataError(f"there are {names}", where=str(path), fix="give one of these files")
    raise DataError("there is no bundle.out", where=str(path), fix="give Bundler's output file")


def _find_photos(file: Path, count: int) -> _Photos:
    """The photos beside a model: those of its list, or those of a folder ``images``."""
    # Bundler writes bundle/bundle.out beside list.txt.
    for folder in (file.parent, file.parent.parent):
        if (folder / "list.txt").is_file():
            return _listed_photos(folder / "list.txt", file, count)
    folder = file.parent / "images"
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    found = [path for path in found if path.suffix.lower() in _IMAGE_SUFFIXES]
    if len(found) == count:
        return _Photos(tuple(path.name for path in found), tuple(found))
    return _Photos(tuple(str(row) for row in range(count)), (None,) * count)


def _listed_photos(listing: Path, file: Path, count: int) -> _Photos:
    # A line is a path, optionally followed by 0 and the focal length that the EXIF data give.
    lines = listing.read_text(encoding="utf-8", errors="replace").split("\n")
    names = [line.split()[0].removeprefix("./") for line in lines if line.strip()]
    if len(names) != count:
        raise DataError(
            f"names {len(names)} photos, {file.name} has {count}",
            where=str(listing),
            fix="the list must be the one that the model was made with",
        )
    paths = []
    for name in names:
        candidates = [listing.parent / name, listing.parent / "images" / Path(name).name]
        paths.append(next((path for path in candidates if path.is_file()), None))
    return _Photos(tuple(names), tuple(paths))


def _photo_size(path: Path) -> ImageSize:
    with open_photo(path) as photo:  # not turned upright: Bundler does not either
        return photo.size


def _as_sizes(
    sizes: ImageSize | Sequence[ImageSize] | None, count: int
) -> tuple[ImageSize, ...] | None:
    if sizes is None:
        return None
    array = np.asarray(sizes)
    if array.shape == (2,):
        array = np.tile(array, (count, 1))
    if array.shape != (count, 2) or array.dtype.kind not in "iu" or (array < 1).any():
        raise InputError(
            f"not a (width, height), nor one for each of {count} photos", where="sizes"
        )
    return tuple((int(width), int(height)) for width, height in array)
