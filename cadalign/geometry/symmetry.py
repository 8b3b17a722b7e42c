"""Symmetries of models: rotations that map a model to itself, and equivalent alignments.

A motion g of the group maps the model to itself, so the alignments A and A g place the same object.
With A's rotation R and stretch S, and g's rotation G, A g has the linear part R S G. That is again
a rotation and a stretch along the model's axes if G' S^2 G is diagonal: its rotation is then
R' = R G and its stretch S' = G' S G. Two cases:

- G S = S G: the stretch keeps the symmetry, S' = S. A quarter turn about y needs equal stretches
  along x and z; a half turn about y needs nothing. Of the rotations by any angle about an axis,
  only half turns remain if the stretches across the axis differ.
- G exchanges two of the model's axes with different stretches, as a quarter turn does: S' has these
  stretches exchanged. If one of the two is held (one image holds the stretch along x), A g is not
  allowed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, is_whole, read_only
from cadalign.errors import InputError, quote, require_kind
from cadalign.geometry.alignment import OPENGL_AXES, Alignment
from cadalign.geometry.rotations import angles_between, nearest_rotation, rotation_from_vector

FACING = np.diag(OPENGL_AXES)
"""Rotation of an upright model, y up, whose z axis points to the camera."""
LIKE_FACING = tuple(FACING @ rotation_from_vector(np.pi / 2 * axis).round() for axis in np.eye(3))
"""References that break ties between rotations equally far from `FACING`."""
_MOST_ROTATIONS = 240
_SAME_DEG = 1.0  # rotations closer than this are the same, given with few digits
_PARALLEL = 1e-3
_TIE = 1e-6
# Angles between axes that a stretched model may exchange, and angles of half turns.
_ANGLES = np.pi / 6 * np.arange(12)
_FIELDS = ("center", "rotations", "axes")
_FORMS = f"give an `axis` with `fold` (null for any angle), or {', '.join(_FIELDS)}"


@dataclass(frozen=True, eq=False)
class Equal:
    """An alignment equivalent to another one: ``other @ motion``."""

    alignment: Alignment
    motion: FloatArray
    """The symmetry (4, 4), a motion that maps the model to itself."""
    free: FloatArray
    """Axes (k, 3) in the model's frame about which any rotation gives an equivalent alignment."""
    center: FloatArray
    """Fixed point (3,) of all symmetries, in the model's frame."""

    def map_points(self, points: FloatArray) -> FloatArray:
        """Model points (n, 3) of the other alignment in this alignment's model frame; (n, 3)."""
        return np.asarray((points - self.motion[:3, 3]) @ self.motion[:3, :3])


# A rotation P and its axes (k, 3), none or one: all rotations Rot(axis, angle) P.
_Branch = tuple[FloatArray, FloatArray]
_NO_AXES = np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Rotations about one point that map a model to itself.

    The given rotations and axes are completed to the group that they generate.

    Raises
    ------
    InputError
        If a shape is wrong, a matrix is not a rotation, an axis is zero, there are more than 240
        rotations, or an axis is not parallel to the others, as with a ball.

    Examples
    --------
    A quarter turn generates a group of four rotations:

    >>> quarter = Symmetry.around((0, 1, 0), fold=4).rotations[1:2]
    >>> len(Symmetry(np.zeros(3), quarter).rotations), Symmetry.none().is_trivial
    (4, True)
    """

    center: FloatArray
    """Fixed point (3,) of the rotations [model units]."""
    rotations: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    """Rotations (g, 3, 3), the identity first. With an axis: representatives, up to rotations
    about it."""
    axes: FloatArray = field(default_factory=lambda: _NO_AXES)
    """Unit vectors (k, 3) of axes about which any rotation belongs to the group: none or one."""

    def __post_init__(self) -> None:
        center = as_floats(self.center, name="symmetry.center", shape=(3,))
        given = as_floats(self.rotations, name="symmetry.rotations", shape=(None, 3, 3))
        axes = as_floats(self.axes, name="symmetry.axes", shape=(None, 3))
        where = "symmetry.rotations[{}]"
        rotations = [nearest_rotation(each, where=where.format(k)) for k, each in enumerate(given)]
        directions = np.reshape([_direction(axis, "symmetry.axes") for axis in axes], (-1, 3))
        group = _generate_group(rotations, directions)
        for name, value in zip(_FIELDS, (center, *group), strict=True):
            object.__setattr__(self, name, read_only(value))

    @classmethod
    def none(cls) -> Symmetry:
        """Make the symmetry of a model without symmetries."""
        return cls(np.zeros(3))

    @classmethod
    def around(
        cls, direction: npt.ArrayLike, *, fold: int | None, offset: npt.ArrayLike = (0, 0, 0)
    ) -> Symmetry:
        """Make a rotational symmetry about one axis.

        ``fold`` is the number of rotations, by equal angles, or None for any angle. The axis has
        the ``direction`` (3,), of any length, and passes through ``offset`` (3,).

        Raises
        ------
        InputError
            If ``fold`` is not a whole number from 1 to 240, or the direction is zero.
        """
        if fold is not None and not (is_whole(fold) and 0 < fold <= _MOST_ROTATIONS):
            what = f"{quote(str(fold))} is not a number of rotations"
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
        """Read a symmetry in the form of observation files or of `to_dict`.

        Parameters
        ----------
        data : mapping
            ``{"axis": (3,), "fold": int or None}`` with an optional ``offset``, see `around`; or
            the fields of the class, see `to_dict`.

        Raises
        ------
        InputError
            If the form or a value is invalid.

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
            what = f"the fields {', '.join(sorted(map(str, names)))} are not a symmetry"
            raise InputError(what, where="symmetry", fix=_FORMS)
        center, rotations, axes = (data[name] for name in _FIELDS)
        return cls(center, rotations, _NO_AXES if isinstance(axes, list) and not axes else axes)

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict of lists, for JSON."""
        return {name: getattr(self, name).tolist() for name in _FIELDS}

    @property
    def is_trivial(self) -> bool:
        """True if the identity is the only rotation."""
        return not len(self.axes) and len(self.rotations) == 1

    def __str__(self) -> str:
        if len(self.axes):
            return "circle"
        return "none" if self.is_trivial else f"{len(self.rotations)} rotations"

    def canonical(
        self,
        alignment: Alignment,
        *,
        held: tuple[bool, bool, bool] = (False, False, False),
        reference: FloatArray | None = None,
        tolerance: float = 1e-4,
    ) -> Equal:
        """Find the equivalent alignment whose rotation is nearest to a reference.

        All equivalent alignments have the same canonical one. The scales of ``held`` axes do not
        change. The reference (3, 3) is by default `FACING`: the model upright, y up, its z axis
        towards the camera. Ties are broken by `LIKE_FACING`, then by the rotation's entries. Scales
        that differ by up to ``tolerance`` count as equal.
        """
        references = (FACING, *LIKE_FACING) if reference is None else (reference, *LIKE_FACING)
        found = [
            (_nearest(alignment, branch, references), scale, branch)
            for branch, scale in self._allowed_branches(alignment.scale, held, tolerance)
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

    def nearest_pose(self, alignment: Alignment, rotation: FloatArray) -> Alignment:
        """Apply the group to the stretched object; return the alignment nearest to ``rotation``.

        Unlike `canonical`, this assumes that the stretched object has the symmetry, not the model:
        x -> R (c + G (S x - c)) + t with the alignment's R, S, t. The result has the rotation R G
        and the same scale.
        """
        if self.is_trivial:
            return alignment
        turns = [_nearest(alignment, (each, self.axes), (rotation,)) for each in self.rotations]
        relative = alignment.rotation.T @ rotation
        best = turns[int(np.argmax([float(np.sum(turn * relative)) for turn in turns]))]
        shift = alignment.rotation @ (self.center - best @ self.center)
        turned = alignment.rotation @ best
        return Alignment(turned, alignment.translation + shift, alignment.scale, is_valid=True)

    def _allowed_branches(
        self, scale: FloatArray, held: tuple[bool, bool, bool], tolerance: float
    ) -> Iterator[tuple[_Branch, FloatArray]]:
        """Rotations of the group that give an allowed alignment, with its scale."""
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
        if not len(self.axes) or _is_round(self.axes[0], scale, tolerance):
            return [(rotation, self.axes) for rotation in self.rotations]
        turns = [rotation_from_vector(angle * self.axes[0]) for angle in _ANGLES]
        return [(turn @ each, _NO_AXES) for each, turn in product(self.rotations, turns)]


def check_symmetry(symmetry: object) -> None:
    """Raise InputError unless it is a `Symmetry`."""
    require_kind(symmetry, Symmetry, "symmetry", fix="see cadalign.Symmetry.from_dict")


def _direction(axis: FloatArray, where: str) -> FloatArray:
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError("the axis has no direction", where=where)
    return np.asarray(axis / length)


def _generate_group(rotations: list[FloatArray], axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (g, 3, 3) and axes (k, 3) of the generated group; see `Symmetry`."""
    identity = np.eye(3)
    if not len(axes):
        return _closure(rotations), axes
    axis = axes[0]
    cosines = np.array([*(axes @ axis), *(axis @ turn @ axis for turn in rotations)])
    if (np.abs(cosines) < 1 - _PARALLEL).any():
        what, fix = "any rotation is a symmetry, as of a ball", "leave out all but one axis"
        raise InputError(what, where="symmetry.axes", fix=fix)
    if (cosines[len(axes) :] > 0).all():
        return identity[None], axis[None]
    across = np.cross(axis, identity[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    return np.stack([identity, 2 * np.outer(across, across) - identity]), axis[None]


def _nearest(
    alignment: Alignment, branch: _Branch, references: tuple[FloatArray, ...]
) -> FloatArray:
    """The rotation of a branch that brings the alignment's rotation nearest to the reference.

    With N = P T' R the trace of T' R Rot(a, angle) P is A cos(angle) + B sin(angle) + a'N a
    with A = tr N - a'N a, B = -a . vee(N - N').
    """
    rotation, axes = branch
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
    """Sort key of a rotation: closeness to each reference, then its entries; rounded."""
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
                what = f"generates more than {_MOST_ROTATIONS} rotations"
                fix = "give an axis if any rotation about it takes the model to itself"
                raise InputError(what, where="symmetry", fix=fix)
            found.append(product_of_both)
    return np.array(found)


def _is_round(axis: FloatArray, scale: FloatArray, tolerance: float) -> bool:
    """True if a stretch is rotationally symmetric about an axis."""
    squares = np.diag(scale**2)
    along = float(axis @ squares @ axis)
    across = (float(np.trace(squares)) - along) / 2
    round_ones = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    return bool(np.abs(squares - round_ones).max() <= 2 * tolerance * squares.max())
