"""Oriented boxes: the stretched model's bounding box in the camera frame."""

from __future__ import annotations

from dataclasses import KW_ONLY, InitVar, dataclass
from math import isfinite

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, read_only
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import nearest_rotation

# Corner i lies at the high side of axis k where bit k of i is set.
_CORNER_SIGNS = np.array([[1 if i >> k & 1 else -1 for k in range(3)] for i in range(8)]) / 2
BOX_EDGES = tuple((i, i | 1 << k) for k in range(3) for i in range(8) if not i >> k & 1)
"""The 12 edges as pairs of corner numbers: four along x, four along y, four along z."""


def extent(points: FloatArray) -> FloatArray:
    """Least and greatest coordinates (2, 3) of points (n, 3)."""
    return np.array([points.min(axis=0), points.max(axis=0)])


def are_on_a_line(points: FloatArray, flat: float) -> bool:
    """True for points (n, 3) whose second extent is at most ``flat`` times the first."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= flat * extents[0])


def bounds_corners(low: FloatArray, high: FloatArray) -> FloatArray:
    """The 8 corners (8, 3) between lowest and highest coordinates, in the order of a `Box`."""
    return np.where(_CORNER_SIGNS > 0, high, low)


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box.

    Raises
    ------
    InputError
        If a shape or value is wrong, or an extent is negative.
    """

    center: FloatArray
    """The box's centre (3,)."""
    rotation: FloatArray
    """Its axes are the columns (3, 3)."""
    extents: FloatArray
    """Its full side lengths along these axes (3,), not negative."""
    _: KW_ONLY
    is_valid: InitVar[bool] = False
    """The arrays are known to be valid: take them over unchecked, and make them read-only."""

    def __post_init__(self, is_valid: bool) -> None:
        if is_valid:
            for array in (self.center, self.rotation, self.extents):
                array.flags.writeable = False
            return
        center = as_floats(self.center, name="center", shape=(3,))
        rotation = nearest_rotation(as_floats(self.rotation, name="rotation", shape=(3, 3)))
        extents = as_floats(self.extents, name="extents", shape=(3,))
        if (extents < 0).any():
            raise InputError(f"{extents.tolist()} is negative", where="extents")
        for name, value in (("center", center), ("rotation", rotation), ("extents", extents)):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def from_model(cls, bounds: npt.ArrayLike, alignment: Alignment) -> Box:
        """Make the box, in the camera frame, of a model that is stretched and placed.

        ``bounds`` (2, 3) are the lowest and highest coordinates of the model in its own frame.

        Examples
        --------
        >>> alignment = Alignment(np.eye(3), [0, 0, 4], [1, 2, 0.5])
        >>> box = Box.from_model([[-1, -1, -1], [1, 1, 1]], alignment)
        >>> box.center.tolist(), box.extents.tolist()
        ([0.0, 0.0, 4.0], [2.0, 4.0, 1.0])
        """
        bounds = as_floats(bounds, name="bounds", shape=(2, 3))
        pose = alignment.rotation, alignment.translation, alignment.scale
        center, rotation, extents = oriented_box(bounds, *pose)
        # Python's numbers: NumPy's reductions of three take longer than the rest of this.
        valid = min(extents.tolist()) >= 0 and isfinite(sum(extents.tolist() + center.tolist()))
        return cls(center, rotation, extents, is_valid=valid)

    @property
    def corners(self) -> FloatArray:
        """The 8 corners, (8, 3) float; `BOX_EDGES` says which of them an edge joins."""
        return self.center + (_CORNER_SIGNS * self.extents) @ self.rotation.T

    @property
    def volume(self) -> float:
        """The volume [model units cubed]."""
        width, height, length = self.extents.tolist()
        return float(width * height * length)


def oriented_box(
    bounds: FloatArray, rotation: FloatArray, translation: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centre, axes and side lengths of a placed model's box: the arrays of a `Box`.

    Also of stacked models: ``bounds`` (..., 2, 3), ``rotation`` (..., 3, 3), ``translation`` and
    ``scale`` (..., 3).
    """
    low, high = bounds[..., 0, :], bounds[..., 1, :]
    linear = rotation * scale[..., None, :]
    middle = ((low + high) / 2)[..., None, :] @ linear.swapaxes(-1, -2)
    return middle[..., 0, :] + translation, rotation, (high - low) * scale
