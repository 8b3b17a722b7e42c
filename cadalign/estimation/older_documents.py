"""Reader of the two JSON forms of results that version 0.1.0 wrote: of fits, and of alignments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from cadalign.errors import InputError
from cadalign.estimation.document import (
    Matrix,
    ReadOptions,
    ReadSummary,
    check_count,
    check_view,
    read_array,
    read_bounds,
    read_options,
    read_points,
    read_residuals,
    summary_of,
)
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.problems import full_covariance
from cadalign.estimation.result import Alternative, FitStats, Result, ViewResult
from cadalign.estimation.uncertainty.stated import KeypointStatistics, Stated, Statistics
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


class _Alternative(ForeignDocument):
    alignment: Any
    relative_likelihood: NotNegative
    camera: Any = None
    points_3d: list[Point3] | None = None
    bounds: Matrix | None = None


class _Fit(ForeignDocument):
    alignment: Any
    camera: Any
    points_3d: list[Point3]
    residuals: list[tuple[float, float] | None]
    inliers: list[bool]
    method: str
    sigma: NotNegative | None
    covariance: Matrix | None
    known_axis: Literal["x", "y", "z"]
    stretched_axes: str
    focal: Literal["known", "estimate"]
    focal_prior: FocalPrior | None
    alternatives: list[_Alternative]
    stats: FitStats
    warnings: tuple[str, ...] = ()
    options: ReadOptions | None = None
    symmetry: Any = None

    def __post_init__(self) -> None:
        for name in ("residuals", "inliers"):
            check_count(getattr(self, name), name, self.points_3d)
        check_view(self.residuals, self.inliers, {})


class _View(ForeignDocument):
    camera: Any
    alignment: Any
    observed: list[tuple[Finite, Finite]]
    residuals: list[tuple[float, float]]
    inliers: list[bool]

    def __post_init__(self) -> None:
        check_view(self.residuals, self.inliers, {"observed": self.observed})


class _Alignment(ForeignDocument):
    ids: list[int | str]
    points_3d: list[Point3]
    bounds: Matrix
    views: list[_View]
    covariance: Matrix
    points_covariance: list[Matrix]
    points_cam_covariance: list[Matrix]
    stretch: Point3
    component: int
    alternatives: list[_Alternative]
    warnings: list[str]
    stats: FitStats
    evidence: tuple[ReadSummary, ...] = ()
    rig_from_model: Any = None
    equal_under_symmetry: str = ""
    degrees_of_freedom: Positive | None = None

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("there are none", where="views")
        for name in ("ids", "points_covariance", "points_cam_covariance"):
            check_count(getattr(self, name), name, self.points_3d)


def read_older(data: Mapping[str, Any]) -> Result:
    """Read either form; raises InputError if a field is missing or invalid."""
    if data.get("method") == "align":
        return _of_alignment(convert(data, _Alignment))
    return _of_fit(convert(data, _Fit))


def _of_fit(read: _Fit) -> Result:
    alignment, camera = Alignment.from_dict(read.alignment), Camera.from_dict(read.camera)
    points, residuals = np.array(read.points_3d).reshape(-1, 3), read_residuals(read.residuals)
    inliers, count = np.array(read.inliers, dtype=bool), len(points)
    options = None if read.options is None else read_options(read.options, count)
    symmetry = None if read.symmetry is None else Symmetry.from_dict(read.symmetry)
    covariance = read_array(read.covariance, "covariance", 8 if read.focal == "known" else 9)
    if covariance is not None:
        covariance = full_covariance(covariance, read.known_axis)
    statistics: Statistics = Stated(covariance, covariance, warnings=tuple(read.warnings))
    if options is not None:  # which its calibrated covariance follows from
        statistics = KeypointStatistics(
            points, residuals, inliers, alignment, camera, options, read.sigma, covariance, symmetry
        )
    observed = camera.project_where_ahead(alignment.apply(points)) - residuals
    observed[~np.isfinite(observed).all(axis=1)] = np.nan
    ids = tuple(range(count))
    return Result(
        views=(ViewResult(camera, alignment, ids, observed, residuals, inliers, statistics),),
        ids=ids,
        points_3d=points,
        method=read.method,
        statistics=statistics,
        known_axis=read.known_axis,
        stretched_axes=read.stretched_axes,
        focal=read.focal,
        focal_prior=read.focal_prior,
        sigma=read.sigma,
        alternatives=_alternatives(read.alternatives, camera, points),
        stats=read.stats,
        options=options,
        symmetry=symmetry,
    )


def _of_alignment(read: _Alignment) -> Result:
    covariance = read_array(read.covariance, "covariance", 9)
    statistics = Stated(
        covariance,
        points_covariance=read_points(read.points_covariance, "points_covariance"),
        points_cam_covariance=read_points(read.points_cam_covariance, "points_cam_covariance"),
        warnings=tuple(read.warnings),
        evidence=tuple(summary_of(each) for each in read.evidence),
        degrees_of_freedom=read.degrees_of_freedom,
    )
    views = []
    for row, view in enumerate(read.views):
        with within(f"views[{row}]"):
            views.append(_view(view, statistics if row == 0 else Stated(None)))
    points = np.array(read.points_3d).reshape(-1, 3)
    return Result(
        views=tuple(views),
        ids=tuple(read.ids),
        points_3d=points,
        method="align",
        statistics=statistics,
        known_axis=None,
        stretched_axes=_stretched(read.covariance),
        alternatives=_alternatives(read.alternatives, views[0].camera, points),
        stats=read.stats,
        component=read.component,
        rig_from_model=read.rig_from_model and Alignment.from_dict(read.rig_from_model),
        own_bounds=read_bounds(read.bounds),
        own_stretch=np.array(read.stretch),
        own_equal=read.equal_under_symmetry,
    )


def _view(read: _View, statistics: Statistics) -> ViewResult:
    """A view, whose keypoints' ids were not written."""
    residuals = read_residuals(read.residuals)
    return ViewResult(
        Camera.from_dict(read.camera),
        Alignment.from_dict(read.alignment),
        (),
        np.array(read.observed).reshape(-1, 2),
        residuals,
        np.array(read.inliers, dtype=bool),
        statistics,
    )


def _stretched(covariance: Matrix) -> str:
    """The axes whose lengths are uncertain."""
    return "".join(axis for row, axis in enumerate("xyz", 6) if covariance[row][row] > 0)


def _alternatives(
    entries: list[_Alternative], camera: Camera, points: np.ndarray
) -> tuple[Alternative, ...]:
    found = []
    for row, entry in enumerate(entries):
        with within(f"alternatives[{row}]"):
            own = None if entry.points_3d is None else np.array(entry.points_3d).reshape(-1, 3)
            found.append(
                Alternative(
                    Alignment.from_dict(entry.alignment),
                    entry.relative_likelihood,
                    camera if entry.camera is None else Camera.from_dict(entry.camera),
                    points if own is None else own,
                    read_bounds(entry.bounds),
                )
            )
    return tuple(found)
