"""The JSON form of an alignment's result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import FloatArray, as_floats
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.result import FitStats
from cadalign.estimation.uncertainty.summary import EvidenceSummary
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    NotNegative,
    Point3,
    Positive,
    convert,
    within,
)

if TYPE_CHECKING:
    from cadalign.estimation.align_result import AlignAlternative, AlignResult

Matrix = list[list[Finite]]


class _Alternative(ForeignDocument):
    alignment: Any  # in the form of `Alignment.from_dict`
    points_3d: list[Point3]
    bounds: Matrix
    relative_likelihood: NotNegative


class _View(ForeignDocument):
    alignment: Any
    residuals: list[tuple[float, float]]
    inliers: list[bool]
    camera: Any = None  # with `observed`, not in files of earlier versions
    observed: list[tuple[Finite, Finite]] | None = None

    def __post_init__(self) -> None:
        if len(self.inliers) != len(self.residuals):
            what = f"{len(self.inliers)} entries for {len(self.residuals)} residuals"
            raise InputError(what, where="inliers")


class _Summary(ForeignDocument):
    kind: str
    view: int | None
    count: int
    rms_sigmas: NotNegative
    rms: NotNegative
    unit: str


class _Result(ForeignDocument):
    """The fields of `AlignResult`; ``rms``, ``std`` and ``box`` follow from them."""

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
    evidence: tuple[_Summary, ...] = ()
    rig_from_model: Any = None
    equal_under_symmetry: str = ""
    degrees_of_freedom: Positive | None = None

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("there are none", where="views")
        for name in ("ids", "points_covariance", "points_cam_covariance"):
            count = len(getattr(self, name))
            if count != len(self.points_3d):
                what = f"{count} entries, but points_3d has {len(self.points_3d)}"
                raise InputError(what, where=name)


def write_result(result: AlignResult) -> dict[str, Any]:
    """A result as plain lists and numbers; its model is not part of it."""
    return {
        "method": "align",
        "alignment": result.alignment.to_dict(),
        "ids": list(result.ids),
        "points_3d": result.points_3d.tolist(),
        "bounds": result.bounds.tolist(),
        "rms": result.rms,
        "views": [_written_view(result, number) for number in range(len(result.poses))],
        "covariance": result.covariance.tolist(),
        "points_covariance": result.points_covariance.tolist(),
        "points_cam_covariance": result.points_cam_covariance.tolist(),
        "stretch": result.stretch.tolist(),
        "std": asdict(result.std),
        "component": result.component,
        "alternatives": [
            {
                "alignment": other.alignment.to_dict(),
                "points_3d": other.points_3d.tolist(),
                "bounds": other.bounds.tolist(),
                "relative_likelihood": other.relative_likelihood,
            }
            for other in result.alternatives
        ],
        "warnings": list(result.warnings),
        "stats": asdict(result.stats),
        "evidence": [asdict(summary) for summary in result.evidence],
        "rig_from_model": result.rig_from_model and result.rig_from_model.to_dict(),
        "equal_under_symmetry": result.equal_under_symmetry,
        "degrees_of_freedom": result.degrees_of_freedom,
    }


def _written_view(result: AlignResult, number: int) -> dict[str, Any]:
    view: dict[str, Any] = {
        "alignment": result.poses[number].to_dict(),
        "residuals": result.residuals[number].tolist(),
        "inliers": result.inliers[number].tolist(),
    }
    if result.cameras:
        view["camera"] = result.cameras[number].to_dict()
        view["observed"] = result.observed[number].tolist()
    return view


def read_result(data: Mapping[str, Any]) -> AlignResult:
    """Read the parsed form of a result; see `AlignResult.to_dict`.

    Raises
    ------
    InputError
        If a field is missing or invalid.
    """
    from cadalign.estimation.align_result import AlignResult  # which imports this module

    try:
        read = convert(data, _Result)
        poses, cameras = [], []
        for row, view in enumerate(read.views):
            with within(f"views[{row}]"):
                poses.append(Alignment.from_dict(view.alignment))
                if view.camera is not None and view.observed is not None:
                    cameras.append(Camera.from_dict(view.camera))
        is_complete = len(cameras) == len(poses)
        return AlignResult(
            alignment=poses[0],
            ids=tuple(read.ids),
            points_3d=np.array(read.points_3d).reshape(-1, 3),
            bounds=_array(read.bounds, "bounds", (2, 3)),
            poses=tuple(poses),
            residuals=tuple(np.array(view.residuals).reshape(-1, 2) for view in read.views),
            inliers=tuple(np.array(view.inliers, dtype=bool) for view in read.views),
            covariance=_array(read.covariance, "covariance", (9, 9)),
            points_covariance=_array(read.points_covariance, "points_covariance", (None, 3, 3)),
            points_cam_covariance=_array(
                read.points_cam_covariance, "points_cam_covariance", (None, 3, 3)
            ),
            stretch=np.array(read.stretch),
            component=read.component,
            model=None,
            alternatives=tuple(
                _alternative(entry, f"alternatives[{row}]")
                for row, entry in enumerate(read.alternatives)
            ),
            warnings=tuple(read.warnings),
            stats=read.stats,
            evidence=tuple(
                EvidenceSummary(**{name: getattr(each, name) for name in each.__struct_fields__})
                for each in read.evidence
            ),
            cameras=tuple(cameras) if is_complete else (),
            observed=tuple(np.array(view.observed).reshape(-1, 2) for view in read.views)
            if is_complete
            else (),
            rig_from_model=read.rig_from_model and Alignment.from_dict(read.rig_from_model),
            equal_under_symmetry=read.equal_under_symmetry,
            degrees_of_freedom=read.degrees_of_freedom,
        )
    except CadalignError as error:
        place = f"alignment result: {error.where}" if error.where else "alignment result"
        raise InputError(error.what, where=place, fix=error.fix) from None


def _array(value: Any, name: str, shape: tuple[int | None, ...]) -> FloatArray:
    if not value and shape[0] is None:  # of a model without keypoints
        return np.empty((0, *(length or 0 for length in shape[1:])))
    return as_floats(value, name=name, shape=shape)


def _alternative(entry: _Alternative, where: str) -> AlignAlternative:
    from cadalign.estimation.align_result import AlignAlternative  # which imports this module

    with within(where):
        return AlignAlternative(
            Alignment.from_dict(entry.alignment),
            np.array(entry.points_3d).reshape(-1, 3),
            _array(entry.bounds, "bounds", (2, 3)),
            entry.relative_likelihood,
        )
