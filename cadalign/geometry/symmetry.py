"""Rigid motions that take a model to itself: discrete ones, and rotations about axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, is_whole, read_only
from cadalign.errors import InputError, quote
from cadalign.geometry.rotations import nearest_rigid, rotation_from_vector

_DISCRETE, _CONTINUOUS = "symmetries_discrete", "symmetries_continuous"
_FORMS = (
    f"give an `axis` with `fold` (null for any angle), or BOP's `{_DISCRETE}` and `{_CONTINUOUS}`"
)


@dataclass(frozen=True, eq=False)
class SymmetryAxis:
    """An axis about which any rotation takes a model to itself.

    Raises InputError if a shape is wrong, or the direction is zero.
    """

    direction: FloatArray
    """Direction (3,), of any length but 0; kept with length 1."""
    offset: FloatArray
    """A point (3,) on the axis [model units]."""

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

    Raises
    ------
    InputError
        If a motion is not rigid.

    Examples
    --------
    >>> Symmetry.none().is_trivial, len(Symmetry.around((0, 1, 0), fold=4).motions)
    (True, 3)
    """

    motions: FloatArray
    """Discrete motions in model coordinates (k, 4, 4), the identity left out."""
    axes: tuple[SymmetryAxis, ...] = ()
    """Axes about which any rotation takes the model to itself."""

    def __post_init__(self) -> None:
        motions = as_floats(self.motions, name="motions", shape=(None, 4, 4))
        exact = [nearest_rigid(each, where=f"motions[{k}]") for k, each in enumerate(motions)]
        object.__setattr__(self, "motions", read_only(np.reshape(exact, (-1, 4, 4))))

    @classmethod
    def none(cls) -> Symmetry:
        """The symmetry of a model that no motion takes to itself."""
        return cls(np.empty((0, 4, 4)))

    @classmethod
    def around(
        cls, direction: npt.ArrayLike, *, fold: int | None, offset: npt.ArrayLike = (0, 0, 0)
    ) -> Symmetry:
        """Rotations about one axis: ``fold`` of them, by equal angles, or any where it is None.

        ``direction`` and ``offset`` are those of `SymmetryAxis`.

        Raises
        ------
        InputError
            If ``fold`` is no positive whole number, or the axis is none.
        """
        _check_fold(fold, "fold")
        axis = SymmetryAxis(np.asarray(direction), np.asarray(offset))
        if fold is None:
            return cls(np.empty((0, 4, 4)), (axis,))
        steps = [axis.turned(2 * np.pi * step / fold) for step in range(1, fold)]
        return cls(np.reshape(steps, (-1, 4, 4)))

    @classmethod
    def from_dict(cls, data: object) -> Symmetry:
        """Read a symmetry as observation files write it.

        Parameters
        ----------
        data : mapping
            ``{"axis": (3,), "fold": int or None}`` with an optional ``offset``, a point on the
            axis; or BOP's ``symmetries_discrete``, matrices row by row, and
            ``symmetries_continuous``, each an ``axis`` with an ``offset``, as `to_dict` writes.

        Raises
        ------
        InputError
            If it is in no such form, or a value is invalid.

        Examples
        --------
        >>> Symmetry.from_dict({"axis": [0, 0, 1], "fold": None}).axes[0].direction.tolist()
        [0.0, 0.0, 1.0]
        """
        if not isinstance(data, Mapping):
            what = f"expected an object, got {type(data).__name__}"
            raise InputError(what, where="symmetry", fix=_FORMS)
        names = set(data)
        if names <= {"axis", "fold", "offset"} and {"axis", "fold"} <= names:
            _check_fold(data["fold"], "symmetry.fold")
            axis, offset = _vector(data, "axis"), _vector(data, "offset")
            return cls.around(axis, fold=data["fold"], offset=offset)
        if not names or not names <= {_DISCRETE, _CONTINUOUS}:
            what = f"the fields {', '.join(sorted(map(str, names)))} are no symmetry's"
            raise InputError(what, where="symmetry", fix=_FORMS)
        motions = [
            as_floats(each, name=f"symmetry.{_DISCRETE}[{row}]", shape=(16,))
            for row, each in enumerate(_listed(data, _DISCRETE))
        ]
        listed = _listed(data, _CONTINUOUS)
        axes = [SymmetryAxis(_vector(each, "axis"), _vector(each, "offset")) for each in listed]
        return cls(np.reshape(motions, (-1, 4, 4)), tuple(axes))

    def to_dict(self) -> dict[str, Any]:
        """Write the symmetry as plain lists, for JSON, in BOP's form."""
        axes = [
            {"axis": axis.direction.tolist(), "offset": axis.offset.tolist()} for axis in self.axes
        ]
        return {_DISCRETE: self.motions.reshape(-1, 16).tolist(), _CONTINUOUS: axes}

    @property
    def is_trivial(self) -> bool:
        """True if there is no motion but the identity."""
        return not len(self.motions) and not self.axes


def _check_fold(fold: Any, where: str) -> None:
    """Refuse what is no number of rotations, without which there would be no symmetry."""
    if fold is not None and not (is_whole(fold) and fold > 0):
        what = f"{quote(str(fold))} is no number of rotations"
        fix = "give 1, 2, 3 ..., or None (null in a file) for any angle"
        raise InputError(what, where=where, fix=fix)


def _vector(data: Any, name: str) -> FloatArray:
    """A field of three numbers, zeros where it is missing."""
    given = data.get(name, (0.0, 0.0, 0.0)) if isinstance(data, Mapping) else data
    return as_floats(given, name=f"symmetry.{name}", shape=(3,))


def _listed(data: Mapping[Any, Any], name: str) -> list[Any]:
    given = data.get(name, [])
    if not isinstance(given, list | tuple):
        raise InputError(f"expected a list, got {type(given).__name__}", where=f"symmetry.{name}")
    return list(given)
