"""The JSON form of a fit's result, as `fit.json` holds it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from cadalign.arrays import as_floats
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import pixel_information
from cadalign.estimation.result import Alternative, FitResult, FitStats
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

_BEHIND = (math.inf, math.inf)


class _Alternative(ForeignDocument):
    alignment: Any  # in the form of `Alignment.from_dict`
    relative_likelihood: NotNegative
    camera: Any  # in the form of `Camera.from_dict`


class _Options(ForeignDocument):
    """The fields of `FitOptions`."""

    method: str
    sigma: Any  # None, a number, one for each keypoint, or a 2 x 2 covariance for each
    loss: str
    loss_scale: Positive
    stretch: str | None
    scale_prior_sigma: Positive | None
    known_axis: str
    focal: str
    focal_prior: FocalPrior | None


class _Result(ForeignDocument):
    """The fields of `FitResult`; ``rms``, ``std``, ``misfit`` and ``warnings`` follow from them."""

    alignment: Any
    camera: Any
    points_3d: list[Point3]
    residuals: list[tuple[float, float] | None]
    inliers: list[bool]
    method: str
    sigma: NotNegative | None
    covariance: list[list[Finite]] | None
    known_axis: Literal["x", "y", "z"]
    stretched_axes: str
    focal: Literal["known", "estimate"]
    focal_prior: FocalPrior | None
    alternatives: list[_Alternative]
    stats: FitStats
    options: _Options | None = None  # not in files of earlier versions
    symmetry: Any = None  # in the form of `Symmetry.from_dict`

    def __post_init__(self) -> None:
        for name in ("residuals", "inliers"):
            count = len(getattr(self, name))
            if count != len(self.points_3d):
                what = f"{count} entries, but points_3d has {len(self.points_3d)}"
                raise InputError(what, where=name)
        for row, (residual, kept) in enumerate(zip(self.residuals, self.inliers, strict=True)):
            if kept and not (residual and math.isfinite(sum(residual))):
                raise InputError("an inlier's residual is not finite", where=f"residuals[{row}]")


def read_result(data: Mapping[str, Any]) -> FitResult:
    """Read the parsed form of a result; see `FitResult.to_dict`.

    Raises
    ------
    InputError
        If a field is missing or invalid.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _result(convert(data, _Result))
    except CadalignError as error:
        place = f"fit result: {error.where}" if error.where else "fit result"
        raise InputError(error.what, where=place, fix=error.fix) from None


def _result(read: _Result) -> FitResult:
    unknowns = 8 if read.focal == "known" else 9
    covariance = None
    if read.covariance is not None:
        shape = (unknowns, unknowns)
        covariance = as_floats(read.covariance, name="covariance", shape=shape)
    return FitResult(
        alignment=Alignment.from_dict(read.alignment),
        points_3d=np.array(read.points_3d).reshape(-1, 3),
        residuals=np.array([row or _BEHIND for row in read.residuals]).reshape(-1, 2),
        inliers=np.array(read.inliers, dtype=bool),
        method=read.method,
        camera=Camera.from_dict(read.camera),
        sigma=read.sigma,
        covariance=covariance,
        known_axis=read.known_axis,
        stretched_axes=read.stretched_axes,
        focal=read.focal,
        focal_prior=read.focal_prior,
        alternatives=tuple(
            _alternative(entry, f"alternatives[{row}]")
            for row, entry in enumerate(read.alternatives)
        ),
        stats=read.stats,
        options=None if read.options is None else _options(read.options, len(read.points_3d)),
        symmetry=None if read.symmetry is None else Symmetry.from_dict(read.symmetry),
    )


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


def _alternative(entry: _Alternative, where: str) -> Alternative:
    with within(where):
        return Alternative(
            Alignment.from_dict(entry.alignment),
            entry.relative_likelihood,
            Camera.from_dict(entry.camera),
        )
