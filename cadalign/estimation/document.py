"""The JSON form of a result, as in `fit.json`.

A class of this module declares the fields of an estimator's class, for reading and for writing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from msgspec.structs import asdict

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.result_parts import (
    Alternative,
    EstimateWarning,
    EvidenceSummary,
    FitStats,
    Posterior,
    ViewResult,
)
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    NotNegative,
    Point2,
    Point3,
    Positive,
    convert,
    name_part,
)
from cadalign.io.focal import FocalPrior

Matrix = list[list[Finite]]
Matrix3 = tuple[Point3, Point3, Point3]
_REPEATED = ("rms", "std", "covariance")
"""Properties of the first view that a file repeats at the top level for other readers."""
_OF_POINTS = ("points_covariance", "points_cam_covariance")
_OF_POSTERIOR = (*("fisher_covariance", *_OF_POINTS, "degrees_of_freedom", "warnings", "evidence"),)


class _Alternative(ForeignDocument, rename={"own_bounds": "bounds"}):
    alignment: Any  # in the form of `Alignment.from_dict`
    relative_likelihood: NotNegative
    camera: Any  # in the form of `Camera.from_dict`
    points_3d: list[Point3]
    own_bounds: tuple[Point3, Point3] | None = None


class _View(ForeignDocument):
    camera: Any
    alignment: Any
    ids: list[int | str]
    points_2d: list[Point2 | None]
    residuals: list[Point2 | None]
    inliers: list[bool]
    covariance: Matrix | None

    def __post_init__(self) -> None:
        _check_lengths(self, ("ids", "points_2d", "inliers"), "residuals")
        for row, (residual, kept) in enumerate(zip(self.residuals, self.inliers, strict=True)):
            if kept and residual is None:
                raise InputError("an inlier's residual is not finite", where=f"residuals[{row}]")


class _Summary(ForeignDocument):
    """The fields of `EvidenceSummary`; the residual of an omitted mask is null."""

    kind: str
    view: int | None
    count: int
    rms_sigmas: NotNegative | None
    rms: NotNegative | None
    unit: str
    share: NotNegative | None = None  # of a photo


class _Result(ForeignDocument, rename={"own_bounds": "bounds", "own_stretch": "stretch"}):
    version: Literal[1]
    method: str
    ids: list[int | str]
    points_3d: list[Point3]
    views: list[_View]
    fisher_covariance: Matrix | None
    stretched_axes: str
    focal: Literal["known", "estimate"]
    stats: FitStats
    warnings: tuple[EstimateWarning, ...]
    own_bounds: tuple[Point3, Point3] | None = None
    own_stretch: Point3 | None = None
    points_covariance: list[Matrix3] | None = None
    points_cam_covariance: list[Matrix3] | None = None
    degrees_of_freedom: Positive | None = None
    component: int = 0
    sigma: NotNegative | None = None
    cost: float | None = None
    alternatives: tuple[_Alternative, ...] = ()
    evidence: tuple[_Summary, ...] = ()
    focal_prior: FocalPrior | None = None
    symmetry: Any = None  # in the form of `Symmetry.from_dict`
    rig_from_model: Any = None

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("there are none", where="views")
        names = ("ids", "points_covariance", "points_cam_covariance")
        _check_lengths(self, names, "points_3d")


def _check_lengths(document: ForeignDocument, names: Sequence[str], other: str) -> None:
    count = len(getattr(document, other))
    for name in names:
        entries = getattr(document, name)
        if entries is not None and len(entries) != count:
            raise InputError(f"{len(entries)} entries, but {other} has {count}", where=name)


_FORMS: Mapping[type, type[ForeignDocument]] = {
    ViewResult: _View,
    Alternative: _Alternative,
    EvidenceSummary: _Summary,
}


def write_result(result: Any) -> dict[str, Any]:
    """Convert a result, without its model, to plain lists and numbers."""
    posterior = {name: getattr(result.posterior, name) for name in _OF_POSTERIOR}
    others = {"version": 1, **posterior, "own_stretch": result.stretch}
    written = _fields(result, _Result, others)
    first = {name: dict(written["views"][0][name]) for name in ("alignment", "camera")}
    return written | first | {name: _plain(getattr(result, name)) for name in _REPEATED}


def _fields(value: Any, form: type[ForeignDocument], others: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that a form declares, from a value or ``others``, by their names in files."""
    names = zip(form.__struct_fields__, form.__struct_encode_fields__, strict=True)
    return {
        written: _plain(others[name] if name in others else getattr(value, name))
        for name, written in names
    }


_SCALARS = {int, str, bool, type(None)}


def _plain(value: Any) -> Any:
    """Convert to lists, mappings and numbers; numbers and rows that are not finite are null."""
    kind = type(value)
    if kind in _SCALARS:
        return value
    if kind is np.ndarray:
        rows = value.tolist()
        if math.isfinite(value.sum()):
            return rows
        return [row if np.isfinite(row).all() else None for row in rows]
    if kind is float:
        return value if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [each if type(each) in _SCALARS else _plain(each) for each in value]
    if isinstance(value, Alignment | Camera | Symmetry):
        return value.to_dict()
    if kind in _FORMS:
        return _fields(value, _FORMS[kind], {})
    if is_dataclass(value):
        return {name: _plain(each) for name, each in vars(value).items()}
    return _plain(value.item())  # of NumPy


def _pixels(rows: Sequence[Point2 | None]) -> FloatArray:
    return np.array([row or (np.nan, np.nan) for row in rows]).reshape(-1, 2)


_VALUES: Mapping[str, Callable[[Any], Any]] = {
    "camera": Camera.from_dict,
    "symmetry": Symmetry.from_dict,
    "ids": tuple,
    "points_2d": _pixels,
    "inliers": partial(np.array, dtype=bool),
    "points_3d": lambda rows: np.array(rows).reshape(-1, 3),
    **{name: name_part(name)(Alignment.from_dict) for name in ("alignment", "rig_from_model")},
    **dict.fromkeys(("own_bounds", "own_stretch"), np.array),
    **dict.fromkeys(_OF_POINTS, lambda rows: np.array(rows).reshape(-1, 3, 3)),
}
"""Functions that convert a field's value from its form in a file."""


def read_result(data: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a `cadalign.Result` from its parsed form; raises InputError if invalid."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _result(convert(data, _Result))
    except CadalignError as error:
        place = f"result: {error.where}" if error.where else "result"
        raise InputError(error.what, where=place, fix=error.fix) from None


def _values(read: ForeignDocument) -> dict[str, Any]:
    return {
        name: _VALUES[name](each) if name in _VALUES and each is not None else each
        for name, each in asdict(read).items()
    }


def _result(read: _Result) -> dict[str, Any]:
    unknowns = 10 if read.focal == "estimate" else 9
    views, alternatives = [], []
    for number, view in enumerate(read.views):
        with name_part(f"views[{number}]"):
            views.append(_view(view, unknowns))
    for number, other in enumerate(read.alternatives):
        with name_part(f"alternatives[{number}]"):
            alternatives.append(Alternative(**_values(other)))
    fields = _values(read)
    del fields["version"]
    of_posterior = {name: fields.pop(name) for name in _OF_POSTERIOR} | {
        "fisher_covariance": _square(read.fisher_covariance, "fisher_covariance", unknowns),
        "evidence": tuple(map(_summary, read.evidence)),
    }
    posterior = Posterior(views[0].covariance, **of_posterior)
    views[0] = replace(views[0], posterior=posterior)
    several = {"views": tuple(views), "alternatives": tuple(alternatives)}
    return fields | several | {"posterior": posterior}


def _view(read: _View, unknowns: int) -> ViewResult:
    fields = _values(read)
    covariance = _square(fields.pop("covariance"), "covariance", unknowns)
    residuals = np.nan_to_num(_pixels(read.residuals), nan=np.inf)  # behind the camera
    return ViewResult(**fields | {"residuals": residuals}, posterior=Posterior(covariance))


def _square(rows: Matrix | None, name: str, size: int) -> FloatArray | None:
    return None if rows is None else as_floats(rows, name=name, shape=(size, size))


def _summary(read: _Summary) -> EvidenceSummary:
    fields = asdict(read)
    lacking = {name: math.nan for name in ("rms_sigmas", "rms") if fields[name] is None}
    return EvidenceSummary(**fields | lacking)
