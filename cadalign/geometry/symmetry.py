"""Symmetries of models: the rotations that take one to itself, and the alignments that are equal.

A motion g of the group takes the model to itself, so the alignments A and A g place the same
object. With A's rotation R and stretch S, A g has the linear part R S G. That is again a rotation
and a stretch along the model's axes where G' S^2 G is diagonal: then its rotation is R' = R G and
its stretch S' = G' S G. Two cases:

- G S = S G: the stretch keeps the symmetry, S' = S. For a quarter turn about y this needs equal
  stretches along x and z, for a half turn about y nothing. Among the rotations by any angle about
  an axis only half turns are left where the stretches across it differ.
- G exchanges two of the model's axes that are stretched differently, as a quarter turn does: S' has
  their stretches exchanged. The same object, with its sides named the other way round. Where one of
  these stretches is held, as that along x is by one image, A g is no answer and is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, as_floats, is_whole, read_only
from cadalign.errors import InputError, quote
from cadalign.geometry.alignment import OPENGL_AXES, Alignment
from cadalign.geometry.rotations import angles_between, nearest_rotation, rotation_from_vector

_QUARTERS = [rotation_from_vector(np.pi / 2 * axis).round() for axis in np.eye(3)]
FACING = np.diag(OPENGL_AXES)
"""Rotation of a model that stands upright, y up, and faces the camera with its z axis."""
LIKE_FACING = tuple(FACING @ quarter for quarter in _QUARTERS)
"""Rotations to compare with where `FACING` is as far from all."""
_MOST_ROTATIONS = 240
_SAME_DEG = 1.0  # rotations at a smaller angle are one, given with few digits
_PARALLEL = 1e-3
_TIE = 1e-6
# Angles between axes that a stretched model may exchange, and those of half turns.
_ANGLES = np.pi / 6 * np.arange(12)
_FIELDS = ("center", "rotations", "axes")
_FORMS = f"give an `axis` with `fold` (null for any angle), or {', '.join(_FIELDS)}"


@dataclass(frozen=True, eq=False)
class Equal:
    """An alignment that places the model as another one does: ``other @ motion``."""

    alignment: Alignment
    motion: FloatArray
    """The symmetry (4, 4) that leads to it; it takes the model to itself."""
    free: FloatArray
    """Directions (k, 3) in the model's frame of axes about which any rotation is equal as well."""
    center: FloatArray
    """A point (3,) of the model that all symmetries keep."""

    def relabelled(self, points: FloatArray) -> FloatArray:
        """Model points (n, 3) of the other alignment where this one has them; (n, 3) float."""
        return np.asarray((points - self.motion[:3, 3]) @ self.motion[:3, :3])


# A rotation P, with the axes (k, 3) of all rotations Rot(axis, angle) P; three are any rotation.
_Branch = tuple[FloatArray, FloatArray]
_NO_AXES = np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The rotations about one point that take a model to itself.

    Given are any rotations and axes; kept is the group that they generate.

    Raises
    ------
    InputError
        If a shape is wrong, a matrix is no rotation, an axis is zero, or there are more than 240
        rotations.

    Examples
    --------
    A quarter turn makes a group of four:

    >>> quarter = Symmetry.around((0, 1, 0), fold=4).rotations[1:2]
    >>> len(Symmetry(np.zeros(3), quarter).rotations), Symmetry.none().is_trivial
    (4, True)
    """

    center: FloatArray
    """The point (3,) [model units]."""
    rotations: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    """The rotations (g, 3, 3), the identity first; with an axis, one of those that only differ by a
    rotation about it; of a ball, the identity alone."""
    axes: FloatArray = field(default_factory=lambda: _NO_AXES)
    """Unit vectors (k, 3) of axes about which any rotation belongs to the group: none, one, or the
    three of a ball, to which any rotation belongs."""

    def __post_init__(self) -> None:
        center = as_floats(self.center, name="symmetry.center", shape=(3,))
        given = as_floats(self.rotations, name="symmetry.rotations", shape=(None, 3, 3))
        axes = as_floats(self.axes, name="symmetry.axes", shape=(None, 3))
        where = "symmetry.rotations[{}]"
        rotations = [nearest_rotation(each, where=where.format(k)) for k, each in enumerate(given)]
        directions = np.reshape([_direction(axis, "symmetry.axes") for axis in axes], (-1, 3))
        group = _group_of(rotations, directions)
        for name, value in zip(_FIELDS, (center, *group), strict=True):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def none(cls) -> Symmetry:
        """The symmetry of a model that no rotation takes to itself."""
        return cls(np.zeros(3))

    @classmethod
    def around(
        cls, direction: npt.ArrayLike, *, fold: int | None, offset: npt.ArrayLike = (0, 0, 0)
    ) -> Symmetry:
        """Rotations about one axis: ``fold`` of them, by equal angles, or any where it is None.

        The axis has a ``direction`` (3,) of any length, and the point ``offset`` (3,) on it.

        Raises
        ------
        InputError
            If ``fold`` is no whole number from 1 to 240, or the axis is none.
        """
        if fold is not None and not (is_whole(fold) and 0 < fold <= _MOST_ROTATIONS):
            what = f"{quote(str(fold))} is no number of rotations"
            fix = f"give 1 to {_MOST_ROTATIONS}, or None (null in a file) for any angle"
            raise InputError(what, where="symmetry.fold", fix=fix)
        axis = _direction(as_floats(direction, name="symmetry.axis", shape=(3,)), "symmetry.axis")
        center = as_floats(offset, name="symmetry.offset", shape=(3,))
        if fold is None:
            return cls(center, axes=axis[None])
        angles = [2 * np.pi * step / fold for step in range(fold)]
        return cls(center, np.array([rotation_from_vector(angle * axis) for angle in angles]))

    @classmethod
    def from_dict(cls, data: object) -> Symmetry:
        """Read a symmetry as observation files write it.

        Parameters
        ----------
        data : mapping
            ``{"axis": (3,), "fold": int or None}`` with an optional ``offset``, see `around`; or
            the fields of the class, as `to_dict` writes them.

        Raises
        ------
        InputError
            If it is in no such form, or a value is invalid.

        Examples
        --------
        >>> Symmetry.from_dict({"axis": [0, 0, 1], "fold": None}).axes.tolist()
        [[0.0, 0.0, 1.0]]
        """
        if not isinstance(data, Mapping):
            what = f"expected an object, got {type(data).__name__}"
            raise InputError(what, where="symmetry", fix=_FORMS)
        names = set(data)
        if names <= {"axis", "fold", "offset"} and {"axis", "fold"} <= names:
            offset = data.get("offset", (0.0, 0.0, 0.0))
            return cls.around(data["axis"], fold=data["fold"], offset=offset)
        if names != set(_FIELDS):
            what = f"the fields {', '.join(sorted(map(str, names)))} are no symmetry's"
            raise InputError(what, where="symmetry", fix=_FORMS)
        center, rotations, axes = (data[name] for name in _FIELDS)
        return cls(center, rotations, _NO_AXES if isinstance(axes, list) and not axes else axes)

    def to_dict(self) -> dict[str, Any]:
        """Write the symmetry as plain lists, for JSON."""
        return {name: getattr(self, name).tolist() for name in _FIELDS}

    @property
    def is_trivial(self) -> bool:
        """True if there is no rotation but the identity."""
        return not len(self.axes) and len(self.rotations) == 1

    def __str__(self) -> str:
        if len(self.axes):
            return "sphere" if len(self.axes) == 3 else "circle"
        return "none" if self.is_trivial else f"{len(self.rotations)} rotations"

    def canonical(
        self,
        alignment: Alignment,
        *,
        held: tuple[bool, bool, bool] = (False, False, False),
        reference: FloatArray | None = None,
        tolerance: float = 1e-4,
    ) -> Equal:
        """The one of all equal alignments whose rotation is nearest to a reference.

        The same for all equal alignments, and itself the canonical one of its own. The scales of
        ``held`` axes must stay as they are. The reference (3, 3) is by default `FACING`: the model
        upright, y up, its z axis towards the camera; where several are as near, the entries of the
        rotation decide. Scales that differ by up to ``tolerance`` count as equal.
        """
        references = (FACING, *LIKE_FACING) if reference is None else (reference, *LIKE_FACING)
        found = [
            (_nearest(alignment, branch, references), scale, branch)
            for branch, scale in self._kept(alignment.scale, held, tolerance)
        ]
        best = max(found, key=lambda each: _rank(alignment.rotation @ each[0], references))
        rotation, scale, (turn, axes) = best
        free = np.reshape([turn.T @ axis for axis in axes], (-1, 3))
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rotation, self.center - rotation @ self.center
        result = alignment
        if (rotation != np.eye(3)).any():
            shift = alignment.linear @ motion[:3, 3]
            turned = alignment.rotation @ rotation
            result = Alignment(turned, alignment.translation + shift, scale)
        return Equal(result, motion, free, self.center)

    def nearest_turned(self, alignment: Alignment, rotation: FloatArray) -> Alignment:
        """The alignment nearest to a rotation of all that the group makes of the placed object.

        These motions take the stretched object to itself, not the model: x -> R (c + G (S x - c)) +
        t with the alignment's R, S, t. That is an alignment of the rotation R G and the same scale.
        """
        if self.is_trivial:
            return alignment
        turns = [_nearest(alignment, (each, self.axes), (rotation,)) for each in self.rotations]
        relative = alignment.rotation.T @ rotation
        best = turns[int(np.argmax([float(np.sum(turn * relative)) for turn in turns]))]
        shift = alignment.rotation @ (self.center - best @ self.center)
        turned = alignment.rotation @ best
        return Alignment(turned, alignment.translation + shift, alignment.scale, is_valid=True)

    def _kept(
        self, scale: FloatArray, held: tuple[bool, bool, bool], tolerance: float
    ) -> Iterator[tuple[_Branch, FloatArray]]:
        """Rotations of the group that lead to an alignment, and its scale."""
        fixed = np.array(held)
        for branch in self._branches(scale, tolerance):
            turned = (branch[0].T * scale**2) @ branch[0]
            squares = turned.diagonal()
            if np.abs(turned - np.diag(squares)).max() > 2 * tolerance * squares.max():
                continue
            after = np.sqrt(squares)
            same = np.abs(after - scale) <= tolerance * scale
            if (same | ~fixed).all():
                yield branch, np.where(same, scale, after)

    def _branches(self, scale: FloatArray, tolerance: float) -> list[_Branch]:
        if len(self.axes) == 3:
            return _free_branches(scale, tolerance)
        if not len(self.axes) or _keeps_turns(self.axes[0], scale, tolerance):
            return [(rotation, self.axes) for rotation in self.rotations]
        turns = [rotation_from_vector(angle * self.axes[0]) for angle in _ANGLES]
        return [(turn @ each, _NO_AXES) for each, turn in product(self.rotations, turns)]


def _direction(axis: FloatArray, where: str) -> FloatArray:
    """The unit vector of an axis (3,)."""
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError("the axis has no direction", where=where)
    return np.asarray(axis / length)


def _group_of(rotations: list[FloatArray], axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (g, 3, 3) and axes (k, 3) of the group that some generate; see `Symmetry`."""
    identity = np.eye(3)
    if not len(axes):
        return _closure(rotations), axes
    axis = axes[0]
    cosines = np.array([*(axes @ axis), *(axis @ turn @ axis for turn in rotations)])
    if (np.abs(cosines) < 1 - _PARALLEL).any():
        return identity[None], identity
    if (cosines[len(axes) :] > 0).all():
        return identity[None], axis[None]
    across = np.cross(axis, identity[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    return np.stack([identity, 2 * np.outer(across, across) - identity]), axis[None]


def _nearest(
    alignment: Alignment, branch: _Branch, references: tuple[FloatArray, ...]
) -> FloatArray:
    """The rotation of a branch that brings the alignment nearest to the first reference.

    With N = P T' R the trace of T' R Rot(a, angle) P is A cos(angle) + B sin(angle) + a'N a
    with A = tr N - a'N a, B = -a . vee(N - N').
    """
    rotation, axes = branch
    if len(axes) == 3:
        return np.asarray(alignment.rotation.T @ references[0])
    if not len(axes):
        return rotation
    axis = axes[0]
    for reference in references:
        n = rotation @ reference.T @ alignment.rotation
        along = float(axis @ n @ axis)
        turn = np.array([n[2, 1] - n[1, 2], n[0, 2] - n[2, 0], n[1, 0] - n[0, 1]])
        sine, cosine = -float(axis @ turn), float(np.trace(n)) - along
        if np.hypot(sine, cosine) > _TIE:
            break
    angle = float(np.arctan2(sine, cosine))
    return np.asarray(rotation_from_vector(angle * axis) @ rotation)


def _rank(rotation: FloatArray, references: tuple[FloatArray, ...]) -> tuple[float, ...]:
    """Closeness to the references and, as there may be ties, the entries; rounded."""
    entries = rotation.ravel()
    values = np.concatenate([np.array(references).reshape(-1, 9) @ entries, entries])
    return tuple((values / _TIE).round().tolist())


def _closure(generators: list[FloatArray]) -> FloatArray:
    """All products (g, 3, 3) of rotations, the identity first."""
    found = [np.eye(3)]
    for rotation in found:  # grows
        for generator in generators:
            product_of_both = nearest_rotation(generator @ rotation)
            if angles_between(np.array(found), product_of_both).min() < _SAME_DEG:
                continue
            if len(found) == _MOST_ROTATIONS:
                what = f"its motions make more than {_MOST_ROTATIONS} rotations"
                fix = "give an axis where any rotation about it takes the model to itself"
                raise InputError(what, where="symmetry", fix=fix)
            found.append(product_of_both)
    return np.array(found)


def _keeps_turns(axis: FloatArray, scale: FloatArray, tolerance: float) -> bool:
    """True if the stretch is the same in all directions across an axis, and along or across it."""
    squares = np.diag(scale**2)
    along = float(axis @ squares @ axis)
    across = (float(np.trace(squares)) - along) / 2
    round_ones = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    return bool(np.abs(squares - round_ones).max() <= 2 * tolerance * squares.max())


def _free_branches(scale: FloatArray, tolerance: float) -> list[_Branch]:
    """Rotations of a sphere that a stretch keeps."""
    same: BoolArray = np.abs(scale[:, None] - scale) <= tolerance * scale
    if same.all():
        return [(np.eye(3), np.eye(3))]
    signed = _closure(_QUARTERS)  # axes go to axes
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        if same[first, second]:
            return [(each, np.eye(3)[[axis]]) for each in signed]
    return [(each, _NO_AXES) for each in signed]
