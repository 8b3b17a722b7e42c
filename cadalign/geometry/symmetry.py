"""Rigid motions that take a model to itself: discrete ones, and rotations about axes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, read_only
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.metrics import rotation_error
from cadalign.geometry.rotations import nearest_rotation, rotation_from_vector

_ORTHONORMAL_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class SymmetryAxis:
    """An axis about which any rotation takes a model to itself.

    Parameters
    ----------
    direction : (3,) float
        Of any length but 0; kept with length 1.
    offset : (3,) float
        A point on the axis [model units].

    Raises
    ------
    InputError
        If a shape is wrong, or the direction is zero.
    """

    direction: FloatArray
    offset: FloatArray

    def __post_init__(self) -> None:
        direction = as_floats(self.direction, name="direction", shape=(3,))
        length = float(np.linalg.norm(direction))
        if not length > 0:
            raise InputError("the axis has no direction", where="direction")
        offset = as_floats(self.offset, name="offset", shape=(3,))
        object.__setattr__(self, "direction", read_only(direction / length))
        object.__setattr__(self, "offset", read_only(offset))

    def turned(self, angle: float) -> FloatArray:
        """The rotation about the axis by an angle [rad], (4, 4) float."""
        motion = np.eye(4)
        motion[:3, :3] = rotation_from_vector(angle * self.direction)
        motion[:3, 3] = self.offset - motion[:3, :3] @ self.offset
        return motion


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The rigid motions that take a model to itself.

    Parameters
    ----------
    motions : (k, 4, 4) float
        Discrete motions in model coordinates, the identity left out.
    axes : tuple of SymmetryAxis
        Axes about which any rotation takes the model to itself.

    Raises
    ------
    InputError
        If a motion is not rigid.

    Examples
    --------
    >>> Symmetry.none().is_trivial, len(Symmetry.around((0, 1, 0), fold=4).poses())
    (True, 4)
    """

    motions: FloatArray
    axes: tuple[SymmetryAxis, ...] = ()

    def __post_init__(self) -> None:
        motions = as_floats(self.motions, name="motions", shape=(None, 4, 4))
        rotations = motions[:, :3, :3]
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3))
        proper = (np.linalg.det(rotations) > 0).all() and (motions[:, 3] == (0, 0, 0, 1)).all()
        if len(motions) and not (proper and error.max() <= _ORTHONORMAL_TOLERANCE):
            raise InputError("not rigid motions", where="motions", fix="give rotations with shifts")
        object.__setattr__(self, "motions", read_only(motions))

    @classmethod
    def none(cls) -> Symmetry:
        """The symmetry of a model that no motion takes to itself."""
        return cls(np.empty((0, 4, 4)))

    @classmethod
    def around(
        cls, direction: npt.ArrayLike, *, fold: int | None, offset: npt.ArrayLike = (0, 0, 0)
    ) -> Symmetry:
        """Rotations about one axis.

        Parameters
        ----------
        direction, offset : (3,) float
            The axis; see `SymmetryAxis`.
        fold : int or None
            Number of rotations, by equal angles, that take the model to itself; None for any.
        """
        axis = SymmetryAxis(np.asarray(direction), np.asarray(offset))
        if fold is None:
            return cls(np.empty((0, 4, 4)), (axis,))
        steps = [axis.turned(2 * np.pi * step / fold) for step in range(1, fold)]
        return cls(np.reshape(steps, (-1, 4, 4)))

    @property
    def is_trivial(self) -> bool:
        """True if there is no motion but the identity."""
        return not len(self.motions) and not self.axes

    def poses(self, *, max_step: float = 0.01) -> FloatArray:
        """All motions, those about axes in steps; (n, 4, 4) float, the identity first.

        BOP's definition: the product of every step about every axis with every discrete motion.

        Parameters
        ----------
        max_step : float
            How far a point as far from the axis as the model's diameter moves at most from one
            step to the next, as a share of that diameter; ``ceil(pi / max_step)`` steps.
        """
        count = int(np.ceil(np.pi / max_step))
        about = [
            axis.turned(2 * np.pi * step / count) for axis in self.axes for step in range(count)
        ]
        discrete = [np.eye(4), *self.motions]
        return np.array([turn @ motion for motion, turn in product(discrete, about or [np.eye(4)])])


def symmetric_rotation_error(*, est: Alignment, gt: Alignment, symmetry: Symmetry) -> float:
    """Smallest rotation error over the truths that look the same [degrees].

    The least over angles about an axis is taken in closed form: the trace of B A(angle), with A
    the rotation about the axis, is a + b sin(angle) + c cos(angle).

    Examples
    --------
    >>> turned = Alignment(rotation_from_vector(np.array([0, 2.0, 0])), [0, 0, 1], [1, 1, 1])
    >>> gt = Alignment(np.eye(3), [0, 0, 1], [1, 1, 1])
    >>> round(symmetric_rotation_error(
    ...     est=turned, gt=gt, symmetry=Symmetry.around((0, 1, 0), fold=None)), 6)
    0.0
    """
    discrete = [np.eye(3), *symmetry.motions[:, :3, :3]]
    candidates = [gt.rotation @ motion for motion in discrete]
    for axis, motion in product(symmetry.axes, discrete):
        x, y, z = axis.direction
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        between = motion @ est.rotation.T @ gt.rotation
        angle = np.arctan2(np.trace(between @ cross), -np.trace(between @ cross @ cross))
        candidates.append(gt.rotation @ axis.turned(float(angle))[:3, :3] @ motion)
    return min(
        rotation_error(est=est, gt=Alignment(nearest_rotation(each), gt.translation, gt.scale))
        for each in candidates
    )
