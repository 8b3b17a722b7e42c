"""Annotations of a model: its keypoints and its symmetries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The annotated points of a model, in the order of the annotation file.

    Parameters
    ----------
    xyz : (k, 3) float
        Positions [model units].
    semantic_ids : (k,) int
        Which keypoint of its category each one is; no id occurs twice.
    face_index : (k,) int
        The face that each one lies on, numbered as in the mesh file.
    barycentric : (k, 3) float
        Where on that face: weights of its corners in file order, of sum 1.
    point_index : (k,) int
        Its nearest point in KeypointNet's point cloud, -1 where the annotation names none.
    colors : (k, 3) float
        Red, green and blue of the surface there, 0 to 1; grey where the annotation names none.
    """

    xyz: FloatArray
    semantic_ids: IntArray
    face_index: IntArray
    barycentric: FloatArray
    point_index: IntArray
    colors: FloatArray

    def __len__(self) -> int:
        return len(self.xyz)

    def __repr__(self) -> str:
        return f"Keypoints(semantic_ids={self.semantic_ids.tolist()})"

    def on_mesh(self, mesh: Mesh) -> FloatArray:
        """The same points rebuilt from faces and barycentric coordinates, (k, 3) float.

        Raises
        ------
        InputError
            If the mesh has fewer faces than the annotation names.
        """
        return mesh.surface_points(self.face_index, self.barycentric)


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle that keypoints of equal rank lie on, such as a bottle's rim.

    Parameters
    ----------
    center : (3,) float
        [model units]
    radius : float
        [model units]
    normal : (3,) float
        The axis, of length 1.
    """

    center: FloatArray
    radius: float
    normal: FloatArray


@dataclass(frozen=True)
class RotationalSymmetry:
    """Keypoints that a rotation of the object takes to one another.

    Parameters
    ----------
    keypoints : tuple of int
        Their rows in `Keypoints` (not their semantic ids).
    circle : Circle, optional
        Where the object looks the same under any rotation about the circle's axis; None where
        only some rotations take it to itself, as the five feet of an office chair.
    """

    keypoints: tuple[int, ...]
    circle: Circle | None = None

    @property
    def is_circle(self) -> bool:
        """True if any angle of rotation leaves the object as it is."""
        return self.circle is not None

    @property
    def fold(self) -> int | None:
        """Number of keypoints that trade places; None on a circle, which has no such number."""
        return None if self.is_circle else len(self.keypoints)


@dataclass(frozen=True)
class Symmetries:
    """The symmetries of a model as far as its keypoints show them.

    Parameters
    ----------
    reflections : tuple of pairs of int
        Keypoints that mirror each other, as rows in `Keypoints` (not semantic ids).
    rotations : tuple of RotationalSymmetry
        Keypoints that a rotation takes to one another.
    """

    reflections: tuple[tuple[int, int], ...] = ()
    rotations: tuple[RotationalSymmetry, ...] = ()

    @property
    def axes(self) -> npt.NDArray[np.float64]:
        """The axes of the circles, (c, 3) float, of length 1 and pointing up (y > 0)."""
        normals = [rotation.circle.normal for rotation in self.rotations if rotation.circle]
        axes = np.array(normals).reshape(-1, 3)
        return np.where(axes[:, 1:2] < 0, -axes, axes)
