"""The two JSON forms of results that version 0.1.0 wrote, of fits and of alignments, as today's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from cadalign.estimation.options import AXES
from cadalign.estimation.result_data import ResultData
from cadalign.estimation.result_parts import KeypointStatistics

Kind = TypeVar("Kind", bound=ResultData)


def upgraded(data: Mapping[str, Any]) -> dict[str, Any]:
    """A form of version 0.1.0, of a fit or an alignment, as today's.

    What is invalid stays, and is refused by its reader.
    """
    defaults: dict[str, Any] = {"warnings": [], "fisher_covariance": None}
    return {
        **defaults,
        **data,
        **(_alignment(data) if data.get("method") == "align" else _fit(data)),
    }


def _fit(data: Mapping[str, Any]) -> dict[str, Any]:
    points, covariance = data.get("points_3d"), data.get("covariance")
    ids = list(range(len(points))) if isinstance(points, list) else []
    if isinstance(covariance, list) and data.get("known_axis") in AXES:
        place = 6 + AXES.index(data["known_axis"])  # of the known scale, whose row and column are 0
        rows = [[*r[:place], 0.0, *r[place:]] if isinstance(r, list) else r for r in covariance]
        covariance = [*rows[:place], [0.0] * (len(rows) + 1), *rows[place:]]
    names = ("camera", "alignment", "residuals", "inliers")
    own = {name: data[name] for name in names if name in data}
    own |= {"ids": ids, "points_2d": [None] * len(ids), "covariance": covariance}
    others = _with(data.get("alternatives"), points_3d=points)
    return {"ids": ids, "views": [own], "fisher_covariance": covariance, "alternatives": others}


def _alignment(data: Mapping[str, Any]) -> dict[str, Any]:
    added: dict[str, Any] = {"known_axis": None, "stretched_axes": "", "focal": "known"}
    views = data.get("views")
    if not isinstance(views, list) or not views or not isinstance(views[0], Mapping):
        return added
    given = [
        {"ids": None, "covariance": None if row else data.get("covariance"), **view}
        | ({"points_2d": view["observed"]} if "observed" in view else {})
        if isinstance(view, Mapping)
        else view
        for row, view in enumerate(views)
    ]
    others = _with(data.get("alternatives"), camera=views[0].get("camera"))
    return added | {"views": given, "alternatives": others}


def _with(entries: Any, **fields: Any) -> Any:
    if not isinstance(entries, list):
        return entries
    return [fields | dict(each) if isinstance(each, Mapping) else each for each in entries]


def completed(result: Kind) -> Kind:
    """A result that was read from an upgraded form, with what follows from its other fields."""
    if result.method == "align":
        diagonal = np.zeros(9) if result.covariance is None else result.covariance.diagonal()
        free = "".join(axis for axis, value in zip(AXES, diagonal[6:], strict=True) if value > 0)
        return replace(result, stretched_axes=free)
    (view,), statistics = result.views, result.statistics
    observed = view.camera.project_where_ahead(view.alignment.apply(result.points_3d))
    observed = observed - np.where(np.isfinite(view.residuals), view.residuals, np.nan)
    if result.options is not None:  # its calibrated covariance follows
        statistics = KeypointStatistics(
            result.points_3d,
            view.residuals,
            view.inliers,
            view.alignment,
            view.camera,
            result.options,
            result.sigma,
            result.fisher_covariance,
            result.symmetry,
        )
    views = (replace(view, points_2d=observed, statistics=statistics),)
    return replace(result, views=views, statistics=statistics, own_equal=None)
