"""The group of a model's symmetries, and the alignments that are equal under it.

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

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, read_only
from cadalign.errors import InputError
from cadalign.geometry.alignment import OPENGL_AXES, Alignment
from cadalign.geometry.rotations import angle_between, nearest_rotation, rotation_from_vector
from cadalign.geometry.symmetry import Symmetry

_QUARTERS = [rotation_from_vector(np.pi / 2 * axis).round() for axis in np.eye(3)]
FACING = np.diag(OPENGL_AXES)
"""Rotation of a model that stands upright, y up, and faces the camera with its z axis."""
LIKE_FACING = tuple(FACING @ quarter for quarter in _QUARTERS)
"""Rotations to compare with where `FACING` is as far from all."""
_MOST_ROTATIONS = 240
_SAME_DEG = 1.0  # rotations at a smaller angle are one, given with few digits
_SAME_POINT = 1e-2  # of the motions' shifts
_PARALLEL = 1e-3
_TIE = 1e-6
# Angles between axes that a stretched model may exchange, and those of half turns.
_ANGLES = np.pi / 6 * np.arange(12)


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
class SymmetryGroup:
    """All motions that follow from a symmetry: rotations about one point.

    Examples
    --------
    A quarter turn makes a group of four:

    >>> quarter = Symmetry(Symmetry.around((0, 1, 0), fold=4).motions[:1])
    >>> len(SymmetryGroup.of(quarter).rotations)
    4
    """

    center: FloatArray
    """The point (3,)."""
    rotations: FloatArray
    """The rotations (g, 3, 3), the identity first; with an axis, one of those that only differ by a
    rotation about it; with a free center, the identity alone."""
    axis: FloatArray | None = None
    """Axis (3,) about which any rotation belongs to the group."""
    is_free: bool = False
    """Any rotation about the center belongs to it."""

    @classmethod
    def of(cls, symmetry: Symmetry) -> SymmetryGroup:
        """The group that a symmetry's motions and axes generate.

        Raises InputError if these share no fixed point, or make more than 240 rotations.
        """
        center = _fixed_point(symmetry)
        generators = [motion[:3, :3] for motion in symmetry.motions]
        identity = np.eye(3)[None]
        if not symmetry.axes:
            return cls(center, read_only(_closure(generators)))
        axis = symmetry.axes[0].direction
        cosines = [float(each.direction @ axis) for each in symmetry.axes]
        cosines += [float(axis @ turn @ axis) for turn in generators]
        if any(abs(cosine) < 1 - _PARALLEL for cosine in cosines):
            return cls(center, identity, is_free=True)
        if all(cosine > 0 for cosine in cosines[len(symmetry.axes) :]):
            return cls(center, identity, axis)
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        across /= np.linalg.norm(across)
        return cls(center, np.stack([np.eye(3), 2 * np.outer(across, across) - np.eye(3)]), axis)

    @property
    def is_trivial(self) -> bool:
        """True if there is no motion but the identity."""
        return self.axis is None and not self.is_free and len(self.rotations) == 1

    def __str__(self) -> str:
        if self.is_free:
            return "sphere"
        if self.axis is not None:
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

    def nearest(self, alignment: Alignment, rotation: FloatArray, *, tolerance: float) -> Equal:
        """The one of all equal alignments whose rotation is nearest to a given one."""
        return self.canonical(alignment, reference=rotation, tolerance=tolerance)

    def nearest_turned(self, alignment: Alignment, rotation: FloatArray) -> Alignment:
        """The alignment nearest to a rotation of all that the group makes of the placed object.

        These motions take the stretched object to itself, not the model: x -> R (c + G (S x - c)) +
        t with the alignment's R, S, t. That is an alignment of the rotation R G and the same scale.
        """
        if self.is_trivial:
            return alignment
        axes = _NO_AXES if self.axis is None else self.axis[None]
        axes = np.eye(3) if self.is_free else axes
        turns = [_nearest(alignment, (each, axes), (rotation,)) for each in self.rotations]
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
        if self.is_free:
            return _free_branches(scale, tolerance)
        if self.axis is None:
            return [(rotation, _NO_AXES) for rotation in self.rotations]
        about = self.axis
        if _keeps_turns(about, scale, tolerance):
            return [(rotation, about[None]) for rotation in self.rotations]
        turns = [rotation_from_vector(angle * about) for angle in _ANGLES]
        return [(turn @ each, _NO_AXES) for each, turn in product(self.rotations, turns)]


@lru_cache(maxsize=64)
def group_of(symmetry: Symmetry) -> SymmetryGroup:
    """`SymmetryGroup.of`, made once for each symmetry."""
    return SymmetryGroup.of(symmetry)


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


def _fixed_point(symmetry: Symmetry) -> FloatArray:
    """The point that all motions and axes keep, the nearest to the origin of several."""
    rows = [np.zeros((1, 3))]
    shifts = [np.zeros(1)]
    for motion in symmetry.motions:
        rows.append(np.eye(3) - motion[:3, :3])
        shifts.append(motion[:3, 3])
    for axis in symmetry.axes:
        across = np.eye(3) - np.outer(axis.direction, axis.direction)
        rows.append(across)
        shifts.append(across @ axis.offset)
    matrix, shift = np.concatenate(rows), np.concatenate(shifts)
    center = np.linalg.lstsq(matrix, shift, rcond=_PARALLEL)[0]
    if np.abs(matrix @ center - shift).max() > _SAME_POINT * max(float(np.abs(shift).max()), 1e-9):
        what = "its motions keep no common point, so they cannot all take the model to itself"
        raise InputError(what, where="symmetry", fix="give rotations about one point")
    return read_only(center)


def _closure(generators: list[FloatArray]) -> FloatArray:
    """All products (g, 3, 3) of rotations, the identity first."""
    found = [np.eye(3)]
    for rotation in found:  # grows
        for generator in generators:
            product_of_both = nearest_rotation(generator @ rotation)
            if min(angle_between(each, product_of_both) for each in found) < _SAME_DEG:
                continue
            if len(found) == _MOST_ROTATIONS:
                what = f"its motions make more than {_MOST_ROTATIONS} rotations"
                fix = "give an axis where any rotation about it takes the model to itself"
                raise InputError(what, where="symmetry", fix=fix)
            found.append(product_of_both)
    return np.array(found)


def _keeps_turns(axis: FloatArray, scale: FloatArray, tolerance: float) -> bool:
    """True if the stretch is the same in all directions across an axis, and along or across it."""
    squares = scale**2
    across = np.eye(3) - np.outer(axis, axis)
    within = across @ np.diag(squares) @ across
    mean = np.trace(within) / 2
    gaps = np.abs(np.diag(squares) @ axis - (axis @ (squares * axis)) * axis).max()
    return bool(max(np.abs(within - mean * across).max(), gaps) <= 2 * tolerance * squares.max())


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
