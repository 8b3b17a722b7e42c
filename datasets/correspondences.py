"""Points of a scene, seen in an image with a known pose: what all correspondence loaders yield."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points, read_only
from cadalign.datasets.records import RecordSet
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of a scene and where one image shows them.

    Parameters
    ----------
    id : str
        The image's name, or the sample's number.
    points_3d : (n, 3) float
        Points [units of the scene].
    points_2d : (n, 2) float
        Where the image shows them [px]; integers are pixel centres.
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
        """Projected minus observed points [px] under the true pose, (n, 2) float.

        Raises InputError if the true pose has points behind the camera.
        """
        projected = self.camera.project(self.cam_from_world.apply(self.points_3d))
        return np.asarray(projected - self.points_2d)


class CorrespondenceSet(RecordSet[Correspondences]):
    """The images of a file, each with its correspondences, read one by one.

    ``images["00.jpg"]`` and ``images[0]`` give one image's `Correspondences`, and ``images.names``
    names them in order; see `cadalign.datasets.records.RecordSet`. Raises DataError if a name
    occurs twice.
    """

    noun = "image"

    def __init__(self, root: Path, names: Sequence[str]) -> None:
        super().__init__(root, names)
        twice = [name for name, count in Counter(self.names).items() if count > 1]
        if twice:
            what = f"the image {twice[0]!r} occurs twice"
            raise DataError(what, where=str(root), fix="remove one of them")


def require_files(folder: Path, names: Iterable[str], *, fix: str) -> tuple[Path, ...]:
    """Return the files of some names in a folder; raises DataError that names those missing."""
    if not folder.is_dir():
        raise DataError("no such folder", where=str(folder), fix=fix)
    files = tuple(folder / name for name in names)
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        what = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
        raise DataError(what, where=str(folder), fix=fix)
    return files


def rigid_pose(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Alignment:
    """Make a true pose out of a rotation (3, 3) written with few digits: the nearest one.

    ``translation`` is 3 values of any shape.
    """
    matrix = as_floats(rotation, name="rotation", shape=(3, 3))
    shift = as_floats(np.reshape(translation, -1), name="translation", shape=(3,))
    return Alignment(matrix, shift, np.ones(3))
