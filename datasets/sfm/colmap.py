"""COLMAP's sparse models, read and written: photos with known poses and the points they see.

Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016. The format is described at
https://colmap.github.io/format.html.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cadalign.arrays import IntArray
from cadalign.datasets.sfm import colmap_files
from cadalign.datasets.sfm.correspondences import (
    CameraView,
    CorrespondenceFormat,
    Correspondences,
    CorrespondenceSet,
    rigid_pose,
)
from cadalign.errors import DataError, InputError, brief
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE
from cadalign.geometry.rotations import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from cadalign.io.files import write_text, writing

_STEMS = ("cameras", "images", "points3D")
_SUBFOLDERS = (".", "sparse/0", "sparse", "0")


class Colmap(CorrespondenceSet):
    """The photos of a COLMAP model, sorted by name; text or binary.

    Observations that belong to no point are left out. Poses and observations are checked image by
    image, when they are asked for; see `CorrespondenceSet`.

    Parameters
    ----------
    path : str or path-like
        The folder with ``cameras``, ``images`` and ``points3D`` (``.bin`` or ``.txt``), or one
        that holds them in ``sparse/0``, ``sparse`` or ``0``.

    Raises
    ------
    DataError
        If files are missing, cut short or malformed, or a name or number occurs twice. Asking for
        an image raises it if the image observes points that don't exist, or its camera's model is
        none of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV.

    Examples
    --------
    >>> images = Colmap("reconstruction")  # doctest: +SKIP
    >>> images.ids  # doctest: +SKIP
    ('00.jpg', '01.jpg')
    >>> seen = images["00.jpg"]  # doctest: +SKIP
    >>> float(np.median(np.linalg.norm(seen.residuals(), axis=1)))  # doctest: +SKIP
    0.25
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        folder, suffix = _find_model(Path(path))
        self._camera_file, image_file, self._point_file = (
            folder / f"{stem}{suffix}" for stem in _STEMS
        )
        read = colmap_files.READERS[suffix]
        self._cameras = read.cameras(self._camera_file)
        ids, xyz = read.points(self._point_file)
        images = read.images(image_file)
        order = np.argsort(ids, kind="stable")
        self._point_ids, self._points = ids[order], xyz[order]
        twice = self._point_ids[1:][self._point_ids[1:] == self._point_ids[:-1]]
        if len(twice):
            raise DataError(f"point {twice[0]} occurs twice", where=str(self._point_file))
        self._images = sorted(images, key=lambda image: image[0])
        super().__init__(image_file, [name for name, _ in self._images])

    def _read(self, position: int) -> Correspondences:
        name, read_view = self._images[position]
        view = read_view()
        rows = view.point_ids != colmap_files.INVALID_POINT
        point_ids = view.point_ids[rows]
        return Correspondences(
            id=name,
            points_3d=self._points[self._point_rows(point_ids, name)],
            points_2d=view.points_2d[rows] - PIXEL_CENTRE,
            camera=self._camera(view.camera_id, name),
            cam_from_world=rigid_pose(rotation_from_quat_wxyz(view.quat_wxyz), view.translation),
            point_ids=point_ids,
        )

    def _point_rows(self, point_ids: IntArray, name: str) -> IntArray:
        rows = np.searchsorted(self._point_ids, point_ids)
        known = rows < len(self._point_ids)
        known[known] = self._point_ids[rows[known]] == point_ids[known]
        missing = np.unique(point_ids[~known])
        if len(missing):
            raise DataError(
                f"{len(missing)} of the points that it observes do not exist, the first is point "
                f"{missing[0]}",
                where=f"{self.source}, image {brief(name)}",
                fix=f"does {self._point_file.name} belong to the same model?",
            )
        return rows

    def _camera(self, camera_id: int, name: str) -> Camera:
        if camera_id not in self._cameras:
            raise DataError(
                f"there is no camera {camera_id}",
                where=f"{self.source}, image {brief(name)}",
                fix=f"does {self._camera_file.name} belong to the same model?",
            )
        try:
            return Camera.from_dict(self._cameras[camera_id])
        except InputError as error:
            where = f"{self._camera_file}, camera {camera_id}"
            raise DataError(error.what, where=where, fix=error.fix) from None


def _find_model(root: Path) -> tuple[Path, str]:
    """The folder and the suffix of a model's files."""
    if not root.is_dir():
        raise DataError("no such folder", where=str(root), fix="give the folder of a COLMAP model")
    incomplete = ""
    for folder in (root / name for name in _SUBFOLDERS):
        for suffix in colmap_files.READERS:
            missing = [stem for stem in _STEMS if not (folder / f"{stem}{suffix}").is_file()]
            if not missing:
                return folder, suffix
            if len(missing) < len(_STEMS) and not incomplete:
                incomplete = f"{folder / missing[0]}{suffix} is missing"
    raise DataError(
        incomplete or "there is no COLMAP model",
        where=str(root),
        fix="cameras, images and points3D are needed, all three as .bin or as .txt",
    )


def write_colmap(folder: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write a model without points as text, whose cameras other programs read.

    Cameras that are equal are written once. Refused are poses with a scale, and names that are
    missing, hold a line break or occur twice.
    """
    if not views:
        raise InputError("give at least one view", where="views")
    names = [view.name for view in views]
    if len(set(names)) < len(names) or any(not n or "\n" in n or n != n.strip() for n in names):
        raise InputError("every view needs an image name of its own", where="views")
    numbers: dict[Camera, int] = {}
    images = []
    for number, view in enumerate(views, start=1):
        camera_id = numbers.setdefault(view.camera, len(numbers) + 1)
        pose = view.rigid(f"views[{number - 1}]")
        values = [*quat_wxyz_from_rotation(pose.rotation), *pose.translation]
        text = " ".join(f"{value:.17g}" for value in values)
        images.append(f"{number} {text} {camera_id} {view.name}\n\n")
    cameras = []
    for camera, camera_id in numbers.items():
        entry = camera.to_dict()
        params = " ".join(f"{value:.17g}" for value in entry["params"])
        cameras.append(f"{camera_id} {entry['model']} {camera.width} {camera.height} {params}\n")
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "cameras.txt", "".join(cameras))
    write_text(folder / "images.txt", "".join(images))
    write_text(folder / "points3D.txt", "")


FORMAT = CorrespondenceFormat(
    "colmap",
    Colmap,
    "cameras, images and points3D (.bin or .txt; also in sparse/0, sparse or 0)",
    tuple(
        tuple(f"{folder}/{stem}{suffix}" for stem in _STEMS)
        for folder in _SUBFOLDERS
        for suffix in colmap_files.READERS
    ),
)
