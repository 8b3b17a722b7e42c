"""The two JSON forms of results that version 0.1.0 wrote, of fits and of alignments, as today's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from cadalign.estimation.result_data import ResultData
from cadalign.estimation.uncertainty.stated import KeypointStatistics

Kind = TypeVar("Kind", bound=ResultData)
_AXES = ("x", "y", "z")


def upgraded(data: Mapping[str, Any], version: int) -> dict[str, Any]:
    """The form of today; what is invalid stays, and is refused by its reader."""
    defaults = {"version": version, "warnings": [], "fisher_covariance": None}
    return {**defaults, **(_alignment(data) if data.get("method") == "align" else _fit(data))}


def _fit(data: Mapping[str, Any]) -> dict[str, Any]:
    points, covariance = data.get("points_3d"), data.get("covariance")
    ids = list(range(len(points))) if isinstance(points, list) else []
    if isinstance(covariance, list) and data.get("known_axis") in _AXES:
        covariance = _with_held(covariance, 6 + _AXES.index(data["known_axis"]))
    own = {name: data[name] for name in ("camera", "alignment", "residuals", "inliers")
           if name in data}  # fmt: skip
    own |= {"ids": ids, "points_2d": [None] * len(ids), "covariance": covariance}
    return {
        **data,
        "ids": ids,
        "views": [own],
        "fisher_covariance": covariance,
        "alternatives": _with(data.get("alternatives"), points_3d=points),
    }


def _with_held(covariance: list[Any], place: int) -> list[Any]:
    """A covariance with a zero row and column for the scale that is known."""
    rows = [
        [*row[:place], 0.0, *row[place:]] if isinstance(row, list) else row for row in covariance
    ]
    return [*rows[:place], [0.0] * (len(rows) + 1), *rows[place:]]


def _alignment(data: Mapping[str, Any]) -> dict[str, Any]:
    views = data.get("views")
    if not isinstance(views, list) or not views or not isinstance(views[0], Mapping):
        return {**data, "known_axis": None, "stretched_axes": "", "focal": "known"}
    given = [
        {"ids": None, "covariance": None if row else data.get("covariance"), **view}
        | ({"points_2d": view["observed"]} if "observed" in view else {})
        if isinstance(view, Mapping)
        else view
        for row, view in enumerate(views)
    ]
    return {
        **data,
        "views": given,
        "known_axis": None,
        "stretched_axes": "",
        "focal": "known",
        "alternatives": _with(data.get("alternatives"), camera=views[0].get("camera")),
    }


def _with(entries: Any, **fields: Any) -> Any:
    if not isinstance(entries, list):
        return entries
    return [fields | dict(each) if isinstance(each, Mapping) else each for each in entries]


def completed(result: Kind) -> Kind:
    """A result that was read from an upgraded form, with what follows from its other fields."""
    if result.method == "align":
        diagonal = np.zeros(9) if result.covariance is None else result.covariance.diagonal()
        free = "".join(axis for axis, value in zip(_AXES, diagonal[6:], strict=True) if value > 0)
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
