"""Kinds of evidence that are known directions and distances: gravity, camera height, size, others.

A kind is a name, its fields, and a function that turns them into `KnownDirection` and
`KnownDistance`: whoever writes it sees neither kernels nor derivatives. `register_evidence` adds
one, and estimates, `result.evidence`, contributions, warnings, observation files and the command
line follow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.estimation.prior import ShapePrior
from cadalign.io.evidence import LENGTHS, EvidenceField, Size, register_fields, remove_fields
from cadalign.solvers.joint.evidence import Directions, Offsets

SIZE = "size"


@dataclass(frozen=True, eq=False)
class KnownDirection:
    """A direction of the model that is known in the camera's frame.

    Parameters
    ----------
    model, camera : (3,) float
        Unit vectors.
    sigma_deg : float or (3, 3) float
        Standard deviation about each axis across it [degrees], or covariance [degrees squared].
    """

    model: FloatArray
    camera: FloatArray
    sigma_deg: Any

    @property
    def whitening(self) -> FloatArray:
        """Whitening (3, 3) of the difference [1/rad]; along the direction as weak as across."""
        sigma = np.asarray(self.sigma_deg, dtype=np.float64)
        if not sigma.ndim:
            return np.asarray(np.eye(3) / np.radians(sigma))
        along = np.outer(self.camera, self.camera)
        across = np.eye(3) - along
        covariance = across @ np.radians(np.radians(sigma)) @ across
        largest = np.linalg.eigvalsh(covariance)[-1]
        return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance + largest * along)).T)


@dataclass(frozen=True, eq=False)
class KnownDistance:
    """A distance along a direction of the model, from one of its points or the camera to another.

    Parameters
    ----------
    ends : (int, int)
        Rows of the shape's points, as `ShapePrior` has them, or `KnownDistance.CAMERA`.
    direction : (3,) float
        Unit vector of the model's frame.
    value, sigma : float
        The distance, signed, and its standard deviation [model units, or those of the size].
    """

    ends: tuple[int, int]
    direction: FloatArray
    value: float
    sigma: float

    CAMERA: ClassVar[int] = -1


Known = KnownDirection | KnownDistance


@dataclass(frozen=True)
class EvidenceKind:
    """A kind of evidence of an image.

    Parameters
    ----------
    name : str
        As `EvidenceSummary.kind` says it.
    field : str
        The field of `View` without which a view has no such evidence.
    known : function of (mapping of str to values, ShapePrior)
        Evidence in the fields of a view; raises InputError that names the field where the model
        does not allow it.
    fields : tuple of EvidenceField
        Fields to declare, of a kind that is registered. `View` takes them as ``more``.
    """

    name: str
    field: str
    known: Callable[[Mapping[str, Any], ShapePrior], Sequence[Known]]
    fields: tuple[EvidenceField, ...] = ()


def upward(field: str, prior: ShapePrior) -> FloatArray:
    """The model's up axis (3,); without one an InputError names the ``field`` that asks for it."""
    if prior.up is None:
        fix = f"learn it with an up axis, or leave `{field}` away"
        raise InputError("the model has no up axis", where=field, fix=fix)
    return prior.up


def lowest_corner(up: FloatArray) -> int:
    """Row of the box's two corners that lies in its lowest face."""
    return 0 if up.sum() > 0 else 1


def _gravity(given: Mapping[str, Any], prior: ShapePrior) -> list[Known]:
    return [KnownDirection(upward("up", prior), given["up"], given["up_sigma_deg"])]


def _camera_height(given: Mapping[str, Any], prior: ShapePrior) -> list[Known]:
    """From the box's corner in its lowest face to the camera."""
    up = upward("camera_height", prior)
    lowest = len(prior.components[0].mean) - 2 + lowest_corner(up)
    height = given["camera_height"]
    sigma = np.hypot(height * given["camera_height_sigma"], prior.components[0].spread[lowest])
    return [KnownDistance((lowest, KnownDistance.CAMERA), up, height, float(sigma))]


_KINDS = [
    EvidenceKind("gravity", "up", _gravity),
    EvidenceKind("camera height", "camera_height", _camera_height),
]


def register_evidence(kind: EvidenceKind) -> None:
    """Add a kind of evidence to all estimates, files and commands of this process.

    Parameters
    ----------
    kind : EvidenceKind
        Takes the place of one of the same name.

    Raises
    ------
    InputError
        If the name is taken by keypoints, masks, photos, depth, size or rig, or the kind does not
        declare the field that gives it.

    Examples
    --------
    The object's front, seen along the optical axis:

    >>> import numpy as np
    >>> from cadalign.io.evidence import EvidenceField
    >>> def known(given, prior):
    ...     front, axis = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
    ...     return [KnownDirection(front, axis, given["frontal_sigma_deg"])]
    >>> field = EvidenceField("frontal_sigma_deg", float, "Deviation from a frontal view.", float)
    >>> register_evidence(EvidenceKind("frontal", field.name, known, (field,)))
    >>> remove_evidence("frontal")
    """
    if kind.name in _STRUCTURAL:
        what = f"{kind.name!r} is a kind of its own"
        raise InputError(what, where="name", fix="choose another name")
    if kind.field not in {each.name for each in kind.fields}:
        what = f"{kind.field!r} is not among the kind's fields"
        raise InputError(what, where="field", fix="declare it in `fields`")
    remove_evidence(kind.name)
    register_fields(*kind.fields)
    _KINDS.append(kind)


def remove_evidence(name: str) -> None:
    """Remove a registered kind."""
    for kind in [each for each in _KINDS if each.name == name]:
        _KINDS.remove(kind)
        remove_fields(*(each.name for each in kind.fields))


_STRUCTURAL = {
    "keypoints": "points_2d",
    "mask": "mask",
    "photo": "image",
    "depth": "depth",
    "rig": "cam_from_rig",
}


def kind_names() -> tuple[str, ...]:
    """Names of the kinds by their numbers in `Directions` and `Offsets`."""
    return (SIZE, *(kind.name for kind in _KINDS))


def field_of(kind: str) -> str:
    """The field of `View` that gives a kind of evidence."""
    return _STRUCTURAL.get(kind) or next(each.field for each in _KINDS if each.name == kind)


def is_told(given: Mapping[str, Any]) -> bool:
    """True where the fields of a view hold a direction or a distance."""
    return any(kind.field in given for kind in _KINDS)


def known_of(
    prior: ShapePrior, views: Sequence[Mapping[str, Any]], size: Size | None
) -> tuple[Directions, Offsets]:
    """All known directions and distances of the fields of views, and of the size.

    Raises InputError if the model does not allow one.
    """
    found: list[tuple[int, int, Known]] = [(0, -1, known) for known in _lengths(size, prior)]
    for view, given in enumerate(views):
        for number, kind in enumerate(_KINDS, start=1):
            if kind.field not in given:
                continue
            try:
                told = kind.known(given, prior)
            except InputError as error:
                where = f"views[{view}].{error.where}"
                raise InputError(error.what, where=where, fix=error.fix) from None
            found.extend((number, view, each) for each in told)
    seen = [(each, kind, view) for kind, view, each in found if isinstance(each, KnownDirection)]
    far = [(each, kind, view) for kind, view, each in found if isinstance(each, KnownDistance)]
    directions, offsets = [each for each, _, _ in seen], [each for each, _, _ in far]
    return (
        Directions(
            np.array([each.model for each in directions], dtype=float).reshape(-1, 3),
            np.array([each.camera for each in directions], dtype=float).reshape(-1, 3),
            np.array([view for _, _, view in seen], dtype=np.int64),
            np.array([each.whitening for each in directions]).reshape(-1, 3, 3),
            np.array([kind for _, kind, _ in seen], dtype=np.int64),
        ),
        Offsets(
            np.array([each.ends for each in offsets], dtype=np.int64).reshape(-1, 2),
            np.array([view for _, _, view in far], dtype=np.int64),
            np.array([each.direction for each in offsets], dtype=float).reshape(-1, 3),
            np.array([each.value for each in offsets], dtype=float),
            np.array([1.0 / each.sigma for each in offsets], dtype=float),
            np.array([kind for _, kind, _ in far], dtype=np.int64),
        ),
    )


def _lengths(size: Size | None, prior: ShapePrior) -> list[Known]:
    """Lengths between the corners of the box, which move by themselves."""
    if size is None:
        return []
    corners = len(prior.components[0].mean) - 2
    own = (prior.components[0].spread[-2:] ** 2).sum()
    found: list[Known] = []
    for axis in np.flatnonzero(np.isfinite(size.lengths)).tolist():
        if not prior.lengths[axis] > 0:
            what = f"the model has no extent along its {'xyz'[axis]}"
            raise InputError(what, where=f"size.{LENGTHS[axis]}", fix="leave it away")
        sigma = float(np.sqrt(size.deviations[axis] ** 2 + own))
        ends = (corners, corners + 1)
        found.append(KnownDistance(ends, np.eye(3)[axis], float(size.lengths[axis]), sigma))
    return found
