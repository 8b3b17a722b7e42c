"""Assemble the result of an exact model's keypoints in one view."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, cast

from cadalign.arrays import FloatArray
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import (
    Diagnosis,
    EvidenceSummary,
    FittedKeypoints,
    Posterior,
    ViewResult,
    Warnings,
    create_unchecked,
    keypoint_summary,
)
from cadalign.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    from cadalign.estimation.model import Model
    from cadalign.estimation.view import View


class KeypointPosterior(Posterior):
    """A posterior of keypoints in one view, computed on access."""

    keypoints: FittedKeypoints
    diagnosis: Diagnosis | None

    @cached_property
    def covariance(self) -> FloatArray | None:
        from cadalign.estimation.uncertainty.posterior import keypoint_covariance

        return keypoint_covariance(self.keypoints)

    @cached_property
    def warnings(self) -> Warnings:
        from cadalign.estimation.uncertainty.doubts import keypoint_warnings

        return keypoint_warnings(self.keypoints, self.covariance, self.diagnosis)

    @cached_property
    def redundancy(self) -> int:
        return self.keypoints.redundancy

    @cached_property
    def evidence(self) -> tuple[EvidenceSummary, ...]:
        own = self.keypoints
        return (keypoint_summary(0, own.residuals, own.inliers, own.chosen_sigma),)


def result_of_keypoints(
    points_2d: FloatArray,
    fitted: FittedKeypoints,
    *,
    diagnosis: Diagnosis | None = None,
    symmetry: Symmetry | None = None,
    model: Model | None = None,
    view: View | None = None,
) -> Result:
    """The result of keypoints (n, 2) [px] in one view, with all keypoints of a ``model``."""
    points: FloatArray = fitted.points_3d
    bounds: FloatArray | None = None
    if model is not None:
        points, bounds = cast(FloatArray, model.points_3d), cast(FloatArray, model.bounds)
        others = (
            replace(each, points_3d=points, own_bounds=bounds) for each in fitted.alternatives
        )
        fitted = replace(fitted, alternatives=tuple(others))
    if symmetry is not None:
        fitted, points = _canonical(fitted, points, symmetry)
    rows, options = _rows(len(fitted.points_3d)), fitted.options
    of_posterior = {
        "keypoints": fitted,
        "diagnosis": diagnosis,
        "fisher_covariance": fitted.fisher_covariance,
    }
    posterior = create_unchecked(KeypointPosterior, of_posterior)
    of_view = {
        "camera": fitted.camera,
        "alignment": fitted.alignment,
        "ids": rows if view is None else view.keypoint_ids,
        "points_2d": points_2d.copy(),  # the caller may change the array
        "residuals": fitted.residuals,
        "inliers": fitted.inliers,
        "posterior": posterior,
    }
    of_result = {
        "views": (create_unchecked(ViewResult, of_view),),
        "ids": rows if model is None else model.ids,
        "points_3d": points,
        "method": fitted.method,
        "posterior": posterior,
        "stretched_axes": options.stretched_axes,
        "focal": options.focal,
        "focal_prior": options.focal_prior,
        "sigma": fitted.sigma,
        "cost": fitted.cost,
        "alternatives": fitted.alternatives,
        "stats": fitted.stats,
        "options": options,
        "symmetry": symmetry,
        "model": model,
        "own_bounds": bounds,
    }
    return create_unchecked(Result, of_result)


def _canonical(
    fitted: FittedKeypoints, points: FloatArray, symmetry: Symmetry
) -> tuple[FittedKeypoints, FloatArray]:
    """Move keypoints and points (m, 3) to the canonical alignment."""
    from cadalign.estimation.symmetry import (  # most models have none
        distinct_alignments,
        held_axes,
        transform_covariance,
    )

    held, covariance = held_axes(fitted.options.stretched_axes), fitted.fisher_covariance
    poses = [fitted.alignment, *(each.alignment for each in fitted.alternatives)]
    (_, best), *others = distinct_alignments(poses, covariance, symmetry, held)
    if covariance is not None:
        covariance = transform_covariance(covariance, fitted.alignment, best, held)
    alternatives = tuple(
        replace(each, alignment=equal.alignment, points_3d=equal.map_points(each.points_3d))
        for k, equal in others
        for each in [fitted.alternatives[k - 1]]
    )
    same = replace(
        fitted,
        alignment=best.alignment,
        points_3d=best.map_points(fitted.points_3d),
        fisher_covariance=covariance,
        symmetry=symmetry,
        alternatives=alternatives,
    )
    return same, best.map_points(points)


@lru_cache(maxsize=64)
def _rows(count: int) -> tuple[int, ...]:
    return tuple(range(count))
