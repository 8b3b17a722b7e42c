"""2D-3D correspondences of an image with a known pose, and a loader of blind PnP's.

The loader reads the NYU-RGBD and MegaDepth correspondences of Liu, Campbell, Li, Zhou, Song and
Yang, "Learning 2D-3D Correspondences To Solve The Blind Perspective-n-Point Problem", 2020
(github.com/Liumouliu/Deep_blind_PnP).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points, read_only
from cadalign.datasets.records import RecordSet
from cadalign.datasets.unpickling import load_pickle
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.files import as_path

# The virtual camera's focal length [px] if there is no focal.pkl.
_FOCAL = np.array([800.0])
_LARGEST_IMAGE = 2**30
# Largest median distance of matched points under the true pose [normalised].
_MAX_DISTANCE = 0.05
_REQUIRED, _OPTIONAL = ("matches", "R", "t"), ("inlier_matches", "focal")


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of a scene and their pixels in one image.

    Parameters
    ----------
    id : str
        The image's name, or the sample's number.
    points_3d : (n, 3) float
        Points [units of the scene].
    points_2d : (n, 2) float
        Pixels of the points [px]; integers are pixel centres.
    camera : Camera
        The calibrated camera.
    cam_from_world : Alignment
        The true pose; its scale is 1.

    Raises
    ------
    InputError
        If shapes don't match, a value is NaN or infinite, or the pose stretches the scene.

    Examples
    --------
    >>> camera = Camera(width=640, height=480, fx=500, fy=500, cx=319.5, cy=239.5)
    >>> pose = Alignment(np.eye(3), [0, 0, 2], [1, 1, 1])
    >>> seen = Correspondences("a.jpg", [[0, 0, 0], [1, 0, 0]], [[320.5, 239.5], [569.5, 239.5]],
    ...                        camera, pose)
    >>> seen.residuals().tolist()
    [[-1.0, 0.0], [0.0, 0.0]]
    """

    id: str
    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    cam_from_world: Alignment

    def __post_init__(self) -> None:
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_points(self.points_2d, name="points_2d", dimension=2)
        if len(points_2d) != len(points_3d):
            what = f"{len(points_2d)} rows, but points_3d has {len(points_3d)}"
            raise InputError(what, where="points_2d")
        if (self.cam_from_world.scale != 1).any():
            what = f"the scale is {self.cam_from_world.scale.tolist()}"
            fix = "a true pose does not stretch the scene: give the scale (1, 1, 1)"
            raise InputError(what, where="cam_from_world", fix=fix)
        object.__setattr__(self, "points_3d", read_only(points_3d))
        object.__setattr__(self, "points_2d", read_only(points_2d))

    def __len__(self) -> int:
        return len(self.points_3d)

    def residuals(self) -> FloatArray:
        """Compute projected minus observed points [px] under the true pose, (n, 2) float.

        Raises InputError if points lie behind the camera.
        """
        projected = self.camera.project(self.cam_from_world.apply(self.points_3d))
        return np.asarray(projected - self.points_2d)


class CorrespondenceSet(RecordSet[Correspondences]):
    """Images with their correspondences, read one by one.

    ``images["00.jpg"]`` and ``images[0]`` return one image's `Correspondences`. ``images.names``
    lists the names in order; see `cadalign.datasets.records.RecordSet`.
    """

    noun = "image"


def require_files(folder: Path, names: Iterable[str], *, fix: str) -> tuple[Path, ...]:
    """Return the paths of named files in a folder; raises DataError if any is missing."""
    if not folder.is_dir():
        raise DataError("no such folder", where=str(folder), fix=fix)
    files = tuple(folder / name for name in names)
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        what = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
        raise DataError(what, where=str(folder), fix=fix)
    return files


def rigid_pose(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Alignment:
    """Build a pose of scale 1; a rotation (3, 3) of few digits becomes the nearest rotation.

    ``translation`` is 3 values of any shape.
    """
    matrix = as_floats(rotation, name="rotation", shape=(3, 3))
    shift = as_floats(np.reshape(translation, -1), name="translation", shape=(3,))
    return Alignment(matrix, shift, np.ones(3))


class BlindPnP(CorrespondenceSet):
    """Samples of one split, such as ``nyu_train`` or ``megaDepth_valid``, named "0", "1", ...

    A split is a folder of pickles, each a list with one entry per sample; files in brackets are
    optional::

        matches.pkl  R.pkl  t.pkl  [inlier_matches.pkl  focal.pkl]

    Each row of ``matches`` (n, 5) has an image point and a scene point. The rows of
    ``inlier_matches`` (m, 2) are the matching pairs: (row of the scene point, row of the image
    point). Without this file, the points of each row match.

    Image points are stored in normalised coordinates. They are converted to pixels of a virtual
    camera with the sample's focal length (by default 800 px) and the smallest image that holds
    them.

    Pickles cannot run code; see `cadalign.datasets.unpickling`.

    Parameters
    ----------
    path : str or path-like
        The split's folder.

    Raises
    ------
    DataError
        If files are missing, are no pickles, import code, or differ in their number of samples.
        Access to a sample raises it if its arrays are malformed, or its points don't match under
        the true pose.

    Examples
    --------
    >>> samples = BlindPnP("nyu_train")  # doctest: +SKIP
    >>> samples[0].cam_from_world.translation  # doctest: +SKIP
    """

    kind = "blind PnP"
    marks = tuple(f"{name}.pkl" for name in _REQUIRED)
    signature = "matches.pkl, R.pkl and t.pkl"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        folder = as_path(path)
        fix = "give a split's folder, which holds matches.pkl, R.pkl and t.pkl"
        required = require_files(folder, self.marks, fix=fix)
        optional = (folder / f"{name}.pkl" for name in _OPTIONAL)
        files = [*required, *filter(Path.is_file, optional)]
        self._data = {file.stem: _load_samples(file) for file in files}
        count = len(self._data["t"])
        for file in files:
            if len(self._data[file.stem]) != count:
                what = f"holds {len(self._data[file.stem])} samples, but t.pkl has {count}"
                fix = "the files must be of one split; get them again"
                raise DataError(what, where=str(file), fix=fix)
        super().__init__(folder, [str(position) for position in range(count)])

    def read(self, position: int) -> Correspondences:
        """Read the sample at a position, counted from 0."""
        pose = rigid_pose(self._array("R", position, (3, 3)), self._numbers("t", position))
        rays, points_3d = self._matches(position)
        if not len(rays):
            raise InputError("there are no correspondences", where="matches")
        focal_lengths = self._numbers("focal", position) if "focal" in self._data else _FOCAL
        camera = _virtual_camera(focal_lengths, rays)
        pixels = camera.pixels_from_normalized(rays)
        gaps = camera.project_where_ahead(pose.apply(points_3d)) - pixels
        distance = np.median(np.linalg.norm(gaps / (camera.fx, camera.fy), axis=1))
        if not distance <= _MAX_DISTANCE:
            raise InputError(
                f"the {len(rays)} point pairs are {distance:.2g} apart under the true pose "
                "(median, normalised coordinates)",
                where="true pose",
                fix="is inlier_matches.pkl missing? it says which points match",
            )
        return Correspondences(self.names[position], points_3d, pixels, camera, pose)

    def _matches(self, position: int) -> tuple[FloatArray, FloatArray]:
        """Read matched image points (n, 2) and scene points (n, 3)."""
        rows = self._array("matches", position, (None, 5))
        rays, points_3d = rows[:, :2], rows[:, 2:]
        if "inlier_matches" not in self._data:
            return rays, points_3d
        numbers = self._array("inlier_matches", position, (None, 2))
        bad = numbers[(numbers < 0) | (numbers >= len(rows))]
        if len(bad):
            what = f"names row {bad[0]:g}, but matches has {len(rows)}"
            raise InputError(what, where="inlier_matches")
        scene_rows, image_rows = numbers.astype(np.int64).T
        return rays[image_rows], points_3d[scene_rows]

    def _array(self, name: str, position: int, shape: tuple[int | None, ...]) -> FloatArray:
        return as_floats(self._data[name][position], name=name, shape=shape)

    def _numbers(self, name: str, position: int) -> FloatArray:
        """Read a sample's numbers, stored in any shape, as (k,) float."""
        try:
            values = np.ravel(self._data[name][position])
        except ValueError:
            raise InputError("not an array of numbers", where=name) from None
        return as_floats(values, name=name, shape=(None,))


def _load_samples(file: Path) -> Any:
    value = load_pickle(file)
    if not isinstance(value, list | tuple) and not np.ndim(value):
        raise DataError(f"holds {type(value).__name__}, not a list of samples", where=str(file))
    return value


def _virtual_camera(focal_lengths: FloatArray, rays: FloatArray) -> Camera:
    """Build a camera with a central principal point and the smallest image that holds all rays.

    ``focal_lengths`` [px] has one value, or one for x and one for y.
    """
    if len(focal_lengths) not in (1, 2) or (focal_lengths <= 0).any():
        raise InputError(f"{focal_lengths.tolist()} are not focal lengths", where="focal")
    fx, fy = float(focal_lengths[0]), float(focal_lengths[-1])
    with np.errstate(over="ignore"):
        reach = np.ceil(np.abs(rays).max(axis=0) * (fx, fy))
    if not (reach < _LARGEST_IMAGE).all():
        raise InputError(f"image points reach {reach.max():g} px from the centre", where="points")
    width, height = (2 * int(length) + 1 for length in reach)
    return Camera(width, height, fx, fy, (width - 1) / 2, (height - 1) / 2)
