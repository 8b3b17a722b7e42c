"""Results of the keypoints of an exact or stretched model in one view."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.options import FitOptions
from cadalign.estimation.problems import Problems, Solutions
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import (
    Alternative,
    FitStats,
    KeypointStatistics,
    ViewResult,
    quickly,
)
from cadalign.estimation.solve import LEAST_LIKELIHOOD, camera_of, fitted_fields
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.symmetry import Symmetry


def result_of_solution(
    problems: Problems, solutions: Solutions, options: FitOptions, seconds: float
) -> Result:
    """The result of the only problem, which has a solution."""
    minima, iterations, hypotheses, _ = solutions.info[0].tolist()
    fitted = fitted_fields(problems, solutions, options)
    effort = {"iterations": iterations, "hypotheses": hypotheses, "seconds": seconds}
    return result_of_keypoints(
        problems.points_2d,
        fitted,
        method=options.method,
        stats=quickly(FitStats, effort),
        cost=None if fitted["fisher_covariance"] is None else solutions.costs.item(0),
        alternatives=_alternatives(problems, solutions, minima, options) if minima > 1 else (),
    )


def result_of_keypoints(
    points_2d: FloatArray,
    fitted: dict[str, Any],
    *,
    method: str,
    stats: FitStats,
    cost: float | None = None,
    alternatives: tuple[Alternative, ...] = (),
) -> Result:
    """The result of keypoints in one view, from the fields of their `FittedKeypoints`."""
    points, options = fitted["points_3d"], fitted["options"]
    ids = _rows(len(points))
    statistics = quickly(KeypointStatistics, {**fitted, "alternatives": alternatives})
    of_view = {
        "camera": fitted["camera"],
        "alignment": fitted["alignment"],
        "ids": ids,
        "points_2d": points_2d.copy(),  # the caller may go on to change theirs
        "residuals": fitted["residuals"],
        "inliers": fitted["inliers"],
        "statistics": statistics,
    }
    of_result = {
        "views": (quickly(ViewResult, of_view),),
        "ids": ids,
        "points_3d": points,
        "method": method,
        "statistics": statistics,
        "known_axis": options.known_axis,
        "stretched_axes": options.stretched_axes,
        "focal": options.focal,
        "focal_prior": options.focal_prior,
        "sigma": fitted.get("sigma"),
        "cost": cost,
        "alternatives": alternatives,
        "stats": stats,
        "options": options,
    }
    return quickly(Result, of_result)


def _alternatives(
    problems: Problems, solutions: Solutions, minima: int, options: FitOptions
) -> tuple[Alternative, ...]:
    """The other minima that are likely enough."""
    costs = solutions.costs[0, :minima]
    if options.sigma is None:  # the likelihood at the sigma that is best for each minimum
        # Costs are in units of sigma^2; below 1 they are those of exact fits.
        least = max(costs[0], 1.0)
        ratios = (least / np.maximum(costs, least)) ** len(problems.points_3d)
    else:
        ratios = np.exp(np.minimum(0.0, costs[0] - costs) / 2)
    points = problems.points_3d.copy()
    return tuple(
        Alternative(
            Alignment.from_packed(solutions.poses[0, k]),
            float(ratios[k]),
            camera_of(problems, solutions, k),
            points,
        )
        for k in range(1, minima)
        if ratios[k] >= LEAST_LIKELIHOOD and np.isfinite(solutions.poses[0, k]).all()
    )


def canonical_result(result: Result, symmetry: Symmetry) -> Result:
    """A result of keypoints in one view as its canonical one, with alternatives that are others."""
    from cadalign.estimation.symmetry import carried, held_axes, is_same
    from cadalign.geometry.symmetry_group import group_of  # most models have none

    group = group_of(symmetry)
    held = held_axes(result.stretched_axes)
    best = group.canonical(result.alignment, held=held)
    statistics = cast("KeypointStatistics", result.statistics)
    covariance = statistics.fisher_covariance
    if covariance is not None:
        covariance = carried(covariance, result.alignment, best, held)
    canonical = [(group.canonical(each.alignment, held=held), each) for each in result.alternatives]
    alternatives = tuple(
        replace(each, alignment=equal.alignment, points_3d=equal.relabelled(each.points_3d))
        for equal, each in canonical
        if group.is_trivial or not is_same(group, best.alignment, equal.alignment, covariance)
    )
    statistics = replace(
        statistics,
        alignment=best.alignment,
        points_3d=best.relabelled(statistics.points_3d),
        fisher_covariance=covariance,
        symmetry=symmetry,
        alternatives=alternatives,
    )
    return replace(
        result,
        views=(replace(result.views[0], alignment=best.alignment, statistics=statistics),),
        points_3d=best.relabelled(result.points_3d),
        statistics=statistics,
        alternatives=alternatives,
        symmetry=symmetry,
    )


@lru_cache(maxsize=64)
def _rows(count: int) -> tuple[int, ...]:
    """Rows of so many keypoints, which are their ids."""
    return tuple(range(count))
