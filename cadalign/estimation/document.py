"""The JSON form of a result, as `fit.json` holds it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.fitted import Alternative, FitStats
from cadalign.estimation.focal import FocalPrior, PriorOption
from cadalign.estimation.options import FitOptions, pixel_information
from cadalign.estimation.result_data import ResultData
from cadalign.estimation.result_parts import Posterior, ViewResult
from cadalign.estimation.uncertainty.summary import EvidenceSummary, MaskResiduals
from cadalign.estimation.warning import EstimateWarning
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    NotNegative,
    Point3,
    Positive,
    convert,
    within,
)

VERSION = 1
Matrix = list[list[Finite]]
Kind = TypeVar("Kind", bound=ResultData)
Read = TypeVar("Read")
Made = TypeVar("Made")
_BEHIND = (math.inf, math.inf)
_UNKNOWN = (math.nan, math.nan)
_PLAIN = [
    "method",
    "component",
    "sigma",
    "cost",
    "known_axis",
    "stretched_axes",
    "focal",
]
"""Fields of a result that are numbers and words, in its JSON form as they are."""


class _Alternative(ForeignDocument):
    alignment: Any  # in the form of `Alignment.from_dict`
    relative_likelihood: NotNegative
    camera: Any  # in the form of `Camera.from_dict`
    points_3d: list[Point3]
    bounds: Matrix | None = None


class _Options(ForeignDocument):
    """The fields of `FitOptions`."""

    method: str
    sigma: Any  # None, a number, one for each keypoint, or a 2 x 2 covariance for each
    loss: str
    loss_scale: Positive
    stretch: str | None
    known_axis: str
    focal: str
    focal_prior: FocalPrior | Literal["usual"] | None
    stretch_sigma: Positive | None = None


def _check_lengths(
    document: ForeignDocument, names: Sequence[str], count: int, than: str, link: str = " "
) -> None:
    """Refuse lists that are not of a length; None is no list."""
    for name in names:
        entries = getattr(document, name)
        if entries is not None and len(entries) != count:
            what = f"{len(entries)} entries{link}{than.format(count)}"
            raise InputError(what, where=name)


class _View(ForeignDocument):
    camera: Any
    alignment: Any
    ids: list[int | str] | None
    points_2d: list[tuple[Finite, Finite] | None]
    residuals: list[tuple[float, float] | None]
    inliers: list[bool]
    covariance: Matrix | None

    def __post_init__(self) -> None:
        count = len(self.residuals)
        _check_lengths(self, ("ids", "points_2d", "inliers"), count, "for {} residuals")
        for row, (residual, kept) in enumerate(zip(self.residuals, self.inliers, strict=True)):
            if kept and not (residual and math.isfinite(sum(residual))):
                raise InputError("an inlier's residual is not finite", where=f"residuals[{row}]")


class _Summary(ForeignDocument):
    """The fields of `EvidenceSummary`."""

    kind: str
    view: int | None
    count: int
    rms_sigmas: NotNegative | None  # of a mask that was left out
    rms: NotNegative | None
    unit: str
    share: NotNegative | None = None  # of a photo


class _Mask(ForeignDocument):
    """The fields of `MaskResiduals`; null for a number that is not known."""

    points: list[tuple[Finite, Finite]]
    normals: list[tuple[Finite, Finite]]
    residuals: list[Finite | None]
    inliers: list[bool]
    sigma: NotNegative | None
    correlation: Positive
    offset: Finite
    is_used: bool

    def __post_init__(self) -> None:
        names = ("normals", "residuals", "inliers")
        _check_lengths(self, names, len(self.points), "for {} points")


class _Result(ForeignDocument):
    """The fields of `cadalign.Result`; ``rms``, ``std`` and ``box`` follow from them."""

    version: Literal[1]
    method: str
    ids: list[int | str]
    points_3d: list[Point3]
    views: list[_View]
    fisher_covariance: Matrix | None
    known_axis: Literal["x", "y", "z"] | None
    stretched_axes: str
    focal: Literal["known", "estimate"]
    stats: FitStats
    warnings: tuple[EstimateWarning, ...]
    bounds: Matrix | None = None
    stretch: Point3 | None = None
    points_covariance: list[Matrix] | None = None
    points_cam_covariance: list[Matrix] | None = None
    degrees_of_freedom: Positive | None = None
    component: int = 0
    sigma: NotNegative | None = None
    cost: float | None = None
    alternatives: tuple[_Alternative, ...] = ()
    evidence: tuple[_Summary, ...] = ()
    options: _Options | None = None
    focal_prior: FocalPrior | None = None
    symmetry: Any = None  # in the form of `Symmetry.from_dict`
    equal_under_symmetry: str = ""
    rig_from_model: Any = None
    mask_residuals: tuple[_Mask | None, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("there are none", where="views")
        if self.mask_residuals:
            _check_lengths(self, ("mask_residuals",), len(self.views), "for {} views")
        names = ("ids", "points_covariance", "points_cam_covariance")
        _check_lengths(self, names, len(self.points_3d), "but points_3d has {}", ", ")


def write_result(result: ResultData) -> dict[str, Any]:
    """A result as plain lists and numbers; its model is not part of it."""
    std, posterior = result.std, result.posterior
    return {
        "version": VERSION,
        **{name: getattr(result, name) for name in _PLAIN},
        "alignment": result.alignment.to_dict(),
        "camera": result.camera.to_dict(),
        "rms": result.rms,
        "stretch": result.stretch.tolist(),
        "std": None if std is None else {**vars(std)},
        "warnings": [{**vars(each), "keypoints": [*each.keypoints]} for each in result.warnings],
        "ids": list(result.ids),
        "points_3d": result.points_3d.tolist(),
        "bounds": _plain(result.own_bounds),
        "views": [
            {
                "camera": view.camera.to_dict(),
                "alignment": view.alignment.to_dict(),
                "ids": list(view.ids) if len(view.ids) == len(view.residuals) else None,
                "points_2d": _finite_rows(view.points_2d),
                "residuals": _finite_rows(view.residuals),
                "inliers": view.inliers.tolist(),
                "covariance": _plain(view.covariance),
            }
            for view in result.views
        ],
        "covariance": _plain(result.covariance),
        "fisher_covariance": _plain(result.fisher_covariance),
        "points_covariance": _plain(posterior.points_covariance),
        "points_cam_covariance": _plain(posterior.points_cam_covariance),
        "degrees_of_freedom": result.degrees_of_freedom,
        "focal_prior": _plain_prior(result.focal_prior),
        "alternatives": [
            {
                "alignment": other.alignment.to_dict(),
                "relative_likelihood": other.relative_likelihood,
                "camera": other.camera.to_dict(),
                "points_3d": other.points_3d.tolist(),
                "bounds": _plain(other.own_bounds),
            }
            for other in result.alternatives
        ],
        "evidence": [_written_evidence(each) for each in result.evidence],
        "options": result.options and _plain_options(result.options),
        "symmetry": result.symmetry and result.symmetry.to_dict(),
        "equal_under_symmetry": result.equal_under_symmetry,
        "rig_from_model": result.rig_from_model and result.rig_from_model.to_dict(),
        "mask_residuals": [each and _written_mask(each) for each in result.mask_residuals],
        "stats": {**vars(result.stats)},
    }


def _written_evidence(evidence: EvidenceSummary) -> dict[str, Any]:
    """The fields, of which only a photo's outline has a share."""
    given = {name: value for name, value in vars(evidence).items() if value is not None}
    has_rms = math.isfinite(evidence.rms)
    return {"view": None, **given, **({} if has_rms else {"rms_sigmas": None, "rms": None})}


def _read_evidence(read: _Summary) -> EvidenceSummary:
    fields = msgspec.structs.asdict(read)
    lacking = {name: math.nan for name in ("rms_sigmas", "rms") if fields[name] is None}
    return EvidenceSummary(**fields | lacking)


def _written_mask(mask: MaskResiduals) -> dict[str, Any]:
    plain = {name: _plain(value) for name, value in vars(mask).items()}
    residuals = [each if math.isfinite(each) else None for each in plain["residuals"]]
    return {**plain, "residuals": residuals, "sigma": mask.sigma if mask.is_used else None}


def _finite_rows(rows: FloatArray) -> list[list[float] | None]:
    return [row if math.isfinite(row[0] + row[1]) else None for row in rows.tolist()]


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _plain_options(options: FitOptions) -> dict[str, Any]:
    sigma = None if options.sigma is None else np.asarray(options.sigma, dtype=float).tolist()
    prior = _plain_prior(options.focal_prior)
    return {**vars(options), "sigma": sigma, "focal_prior": prior}


def _plain_prior(prior: PriorOption) -> Any:
    return asdict(prior) if isinstance(prior, FocalPrior) else prior


def read_result(data: Mapping[str, Any], kind: type[Kind]) -> Kind:
    """Read the parsed form of a result; see `cadalign.Result.from_dict`.

    Raises InputError if a field is missing or invalid.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _result(convert(data, _Result), kind)
    except CadalignError as error:
        place = f"result: {error.where}" if error.where else "result"
        raise InputError(error.what, where=place, fix=error.fix) from None


def _result(read: _Result, kind: type[Kind]) -> Kind:
    unknowns = 10 if read.focal == "estimate" else 9
    views = _each("views", read.views, lambda view: _view(view, unknowns))
    in_camera = read.points_cam_covariance
    posterior = Posterior.stated(
        views[0].covariance,
        fisher_covariance=_array(read.fisher_covariance, "fisher_covariance", unknowns, unknowns),
        points_covariance=_array(read.points_covariance, "points_covariance", None, 3, 3),
        points_cam_covariance=_array(in_camera, "points_cam_covariance", None, 3, 3),
        warnings=read.warnings,
        evidence=tuple(map(_read_evidence, read.evidence)),
        degrees_of_freedom=read.degrees_of_freedom,
    )
    views[0] = replace(views[0], posterior=posterior)
    count = len(views[0].residuals)
    return kind(
        views=tuple(views),
        ids=tuple(read.ids),
        points_3d=np.array(read.points_3d).reshape(-1, 3),
        posterior=posterior,
        focal_prior=read.focal_prior,
        **{name: getattr(read, name) for name in _PLAIN},
        alternatives=tuple(_each("alternatives", read.alternatives, _alternative)),
        stats=read.stats,
        options=None if read.options is None else _options(read.options, count),
        symmetry=None if read.symmetry is None else Symmetry.from_dict(read.symmetry),
        rig_from_model=read.rig_from_model and Alignment.from_dict(read.rig_from_model),
        mask_residuals=tuple(map(_mask, read.mask_residuals)),
        own_bounds=_array(read.bounds, "bounds", 2, 3),
        own_stretch=None if read.stretch is None else np.array(read.stretch),
        own_equal=read.equal_under_symmetry,
    )


def _view(read: _View, unknowns: int) -> ViewResult:
    return ViewResult(
        Camera.from_dict(read.camera),
        Alignment.from_dict(read.alignment),
        tuple(read.ids or ()),
        np.array([row or _UNKNOWN for row in read.points_2d]).reshape(-1, 2),
        np.array([row or _BEHIND for row in read.residuals]).reshape(-1, 2),
        np.array(read.inliers, dtype=bool),
        Posterior.stated(_array(read.covariance, "covariance", unknowns, unknowns)),
    )


def _mask(read: _Mask | None) -> MaskResiduals | None:
    if read is None:
        return None
    residuals = [math.nan if each is None else each for each in read.residuals]
    return MaskResiduals(
        np.array(read.points).reshape(-1, 2),
        np.array(read.normals).reshape(-1, 2),
        np.array(residuals, dtype=np.float64),
        np.array(read.inliers, dtype=bool),
        math.nan if read.sigma is None else read.sigma,
        read.correlation,
        read.offset,
        read.is_used,
    )


def _array(value: list[Any] | None, name: str, *shape: int | None) -> FloatArray | None:
    if value is None:
        return None
    if not value and shape[0] is None:
        return np.empty((0, 3, 3))  # of no keypoints
    return as_floats(value, name=name, shape=shape)


def _options(read: _Options, count: int) -> FitOptions:
    with within("options"):
        sigma: Any = read.sigma
        if isinstance(sigma, list):
            covariances = sigma and isinstance(sigma[0], list)
            shape = (count, 2, 2) if covariances else (count,)
            sigma = as_floats(sigma, name="sigma", shape=shape)
        elif sigma is not None:
            sigma = float(as_floats(sigma, name="sigma", shape=()))
        if sigma is not None:
            pixel_information(sigma, count)  # checks it
        return FitOptions(**{**msgspec.structs.asdict(read), "sigma": sigma})


def _alternative(entry: _Alternative) -> Alternative:
    return Alternative(
        Alignment.from_dict(entry.alignment),
        entry.relative_likelihood,
        Camera.from_dict(entry.camera),
        np.array(entry.points_3d).reshape(-1, 3),
        _array(entry.bounds, "bounds", 2, 3),
    )


def _each(name: str, entries: Sequence[Read], read: Callable[[Read], Made]) -> list[Made]:
    """Entries of a list, read one by one; errors name the entry."""
    made = []
    for row, entry in enumerate(entries):
        with within(f"{name}[{row}]"):
            made.append(read(entry))
    return made
