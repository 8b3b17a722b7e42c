"""Points of a scene, seen in an image with a known pose: what all correspondence loaders yield."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, read_only
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

logger = logging.getLogger("cadalign")


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
    point_ids : (n,) int, optional
        The points' numbers in the file that they come from.

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
    >>> len(seen.subset([False, True]))
    1
    """

    id: str
    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    cam_from_world: Alignment
    point_ids: IntArray | None = None

    def __post_init__(self) -> None:
        points_3d = as_points(self.points_3d, name="points_3d", dimension=3)
        points_2d = as_points(self.points_2d, name="points_2d", dimension=2)
        lengths = {"points_2d": len(points_2d)}
        if self.point_ids is not None:
            point_ids = np.asarray(self.point_ids, dtype=np.int64)
            lengths["point_ids"] = len(point_ids)
            object.__setattr__(self, "point_ids", read_only(point_ids))
        for name, length in lengths.items():
            if length != len(points_3d):
                raise InputError(f"{length} rows, but points_3d has {len(points_3d)}", where=name)
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

    def subset(self, rows: npt.ArrayLike) -> Correspondences:
        """Keep some of the points: ``rows`` is a mask (n,), or the rows to keep (k,)."""
        chosen = np.asarray(rows)
        is_mask = chosen.dtype.kind == "b" and chosen.shape == (len(self),)
        if not is_mask and chosen.dtype.kind not in "iu":
            if chosen.size:
                what = f"neither a mask of {len(self)} values nor row numbers"
                raise InputError(what, where="rows")
            chosen = chosen.astype(np.int64)
        return replace(
            self,
            points_3d=self.points_3d[chosen],
            points_2d=self.points_2d[chosen],
            point_ids=None if self.point_ids is None else self.point_ids[chosen],
        )


class CorrespondenceSet(ABC):
    """The images of a file, each with its correspondences, read one by one.

    ``images["00.jpg"]`` and ``images[0]`` give one image's `Correspondences`, ``images[:3]`` a
    tuple, ``len(images)`` counts all images, and ``images.ids`` names them in order.

    An image that the file describes wrongly does not stop the others: asking for it raises a
    `DataError`, iterating leaves it out with a warning (logger "cadalign"), and `problems` holds
    the reasons.

    Parameters
    ----------
    source : Path
        The file that describes the images, for messages.
    ids : sequence of str
        The images' names, each once.
    """

    layouts: tuple[tuple[str, ...], ...] = ()
    """The files below a folder that belong together, in each of the places where they may lie."""
    signature: str = ""
    """These files, for messages."""

    def __init__(self, source: Path, ids: Sequence[str]) -> None:
        self.source = source
        self.ids = tuple(ids)
        self._positions = {name: position for position, name in enumerate(self.ids)}
        self._warned: set[str] = set()
        if len(self._positions) < len(self.ids):
            twice = next(name for i, name in enumerate(self.ids) if self._positions[name] != i)
            what = f"the image {twice!r} occurs twice"
            raise DataError(what, where=str(source), fix="remove one of them")

    @classmethod
    def is_here(cls, folder: Path) -> bool:
        """True for a folder that holds files of this format."""
        return any((folder / name).is_file() for layout in cls.layouts for name in layout)

    @abstractmethod
    def _read(self, position: int) -> Correspondences:
        """Read one image; an `InputError` or `DataError` from here concerns that image alone."""

    def _prepare(self) -> None:  # noqa: B027 (most sets have nothing to prepare)
        """Read what all images share; an error from here concerns the whole file."""

    @property
    def problems(self) -> dict[str, DataError]:
        """Errors of the images that could not be read, by id; reads them all."""
        self._prepare()
        problems = {}
        for position, name in enumerate(self.ids):
            try:
                self._read_checked(position)
            except DataError as error:
                problems[name] = error.with_traceback(None)
        return problems

    @overload
    def __getitem__(self, key: int | str) -> Correspondences: ...
    @overload
    def __getitem__(self, key: slice) -> tuple[Correspondences, ...]: ...
    def __getitem__(self, key: int | str | slice) -> Correspondences | tuple[Correspondences, ...]:
        """One image by position or id, or a slice of them.

        Raises InputError if there is no such image, DataError if the file describes it wrongly.
        """
        if isinstance(key, slice):
            return tuple(self[position] for position in range(*key.indices(len(self))))
        position = key if not isinstance(key, str) else self._positions.get(key, key)
        if isinstance(position, str):
            known = ", ".join(self.ids[:5]) + (", ..." if len(self) > 5 else "")
            where, fix = str(self.source), f"known are {known}"
            raise InputError(f"no image {key!r}", where=where, fix=fix)
        if not isinstance(key, str | int | np.integer) or not -len(self) <= position < len(self):
            what, fix = f"no image {key!r} among {len(self)}", "give a position from 0, or an id"
            raise InputError(what, where=str(self.source), fix=fix)
        self._prepare()
        return self._read_checked(int(position) % len(self))

    def __iter__(self) -> Iterator[Correspondences]:
        self._prepare()
        for position, name in enumerate(self.ids):
            try:
                image = self._read_checked(position)
            except DataError as error:
                if name not in self._warned:
                    self._warned.add(name)
                    logger.warning("left out: %s", error)
                continue
            yield image

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.source)!r}, {len(self)} images)"

    def _read_checked(self, position: int) -> Correspondences:
        try:
            # Numbers that overflow are refused by what they are given to.
            with np.errstate(over="ignore", invalid="ignore"):
                return self._read(position)
        except InputError as error:
            where = f"{self.source}, image {self.ids[position][:200]}"
            where += "" if error.where is None else f", {error.where}"
            raise DataError(error.what, where=where, fix=error.fix) from None


def find_layout(
    root: Path, layouts: Iterable[tuple[str, ...]], *, nothing: str, fix: str
) -> tuple[Path, ...]:
    """Find the files of the first of some layouts, names below a folder, that is whole.

    Raises DataError if none is, which names what is missing of the one that has most of its files.
    """
    if not root.is_dir():
        raise DataError("no such folder", where=str(root), fix=fix)
    sets = [[root / name for name in layout] for layout in layouts]
    found = [(files, [file for file in files if not file.is_file()]) for files in sets]
    files, missing = min(found, key=lambda each: len(each[1]) / len(each[0]))
    if not missing:
        return tuple(files)
    what = f"{', '.join(map(str, missing))} {'is' if len(missing) == 1 else 'are'} missing"
    raise DataError(nothing if missing == files else what, where=str(root), fix=fix)


def rigid_pose(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Alignment:
    """Make a true pose out of a rotation (3, 3) written with few digits: the nearest one.

    ``translation`` is 3 values of any shape.
    """
    matrix = as_floats(rotation, name="rotation", shape=(3, 3))
    shift = as_floats(np.reshape(translation, -1), name="translation", shape=(3,))
    return Alignment(matrix, shift, np.ones(3))
