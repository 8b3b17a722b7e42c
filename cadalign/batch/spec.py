"""Specification of runs over many observations, for their pages."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
import pyarrow as pa

from cadalign.batch.outputs import COLUMNS as TABLE_COLUMNS
from cadalign.batch.outputs import NAME_COLUMNS, RECORD_COLUMNS, page_names, warnings_text
from cadalign.batch.runs import FitRunOptions, plan_run
from cadalign.errors import DataError
from cadalign.estimation.result import Result
from cadalign.evaluation import metrics
from cadalign.evaluation.instances.record import record_of
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.plots import Plot, cumulative_curves
from cadalign.evaluation.registry import Spec
from cadalign.evaluation.runs.tables import Run
from cadalign.evaluation.runs.work import FAILED, Columns, Outcome, Row
from cadalign.evaluation.summary import mean, medians, milliseconds, summarize
from cadalign.geometry.alignment import extent
from cadalign.io.observation import Observation

METHOD = "alignment"
"""Name of the method on the page; equal in all runs, so that they can be compared."""
ROTATION_STD = Metric("rotation_std_deg", "rotation uncertainty", "deg", head="R std. dev.")
WARNINGS = Metric("warning_count", "warnings", digits=1, log=False)
INLIERS = Metric("inliers", "keypoints kept", digits=1, better="high", log=False)
SCORE = Metric("match_score", "score", "%", 0, better="high", factor=100.0, log=False)
NONE = Metric("none_probability", "none of these", "%", 0, factor=100.0, log=False)
_GALLERY = (SCORE, NONE, metrics.RMS, ROTATION_STD, WARNINGS, INLIERS)  # a fit has no score
_HEADLINE = (
    *(metrics.INSTANCES, metrics.FAILED, metrics.KEYPOINTS),
    *_GALLERY,
    metrics.QUERY_MILLISECONDS,
)
_PLACES = np.array([0.1, 0.2, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 50])


@dataclass(frozen=True, eq=False)
class FitRun(Run):
    """A run over many observations, with its rows as instances of a page."""

    @classmethod
    def open(cls, path: Path, name: str | None = None, *, columns: Columns = TABLE_COLUMNS) -> Self:
        """See `Run.open`."""
        run = super().open(path, name, columns=columns)
        return replace(run, results=_add_names(run.results))

    def records(self, columns: Columns) -> Iterator[Row]:
        """Build the instance records of all observations that could be read."""
        names = self.results.select(["row", "category", "model_id", "view", "reason"]).to_pylist()
        of_row = {each.pop("row"): each for each in names}
        for stored in super().records(RECORD_COLUMNS):
            if stored["observation"] or stored["result"]:
                yield _record(stored, of_row[stored["row"]] | {"method": METHOD})


def _add_names(table: pa.Table) -> pa.Table:
    """Add the names of instances to the table of results, and set the method's name."""
    naming = [name for name in NAME_COLUMNS if name in table.column_names]
    names = [page_names(row) for row in table.select(naming).to_pylist()]
    for name in ("category", "model_id", "view"):
        table = table.append_column(name, pa.array([each[name] for each in names]))
    place = table.schema.get_field_index("method")
    return table.set_column(place, "method", pa.array([METHOD] * len(table), pa.string()))


def _record(stored: Row, names: Row) -> Row:
    """Build the instance record of a stored result, or of a failed observation."""
    reason, result = names.pop("reason"), None
    if stored["result"]:
        result = Result.from_dict(json.loads(stored["result"]))
        view, bounds = result.views[0], result.bounds
        camera, pixels, places = view.camera, view.points_2d, result.points_3d
        row_of = {label: row for row, label in enumerate(result.ids)}
        points = places[[row_of[label] for label in view.ids]]
        outcome = Outcome(names, {"rms_px": result.rms})
    else:
        seen = Observation.from_dict(msgspec.json.decode(stored["observation"]))
        camera, pixels, points = seen.camera, seen.points_2d, seen.points_3d
        bounds = extent(points if len(points) else np.zeros((1, 3)))
        outcome = Outcome(names, status=FAILED, reason=reason)
    shown = np.isfinite(pixels).all(axis=1)
    estimate = DataError(reason) if result is None else result
    record = record_of(
        [outcome],
        [estimate],
        camera=camera,
        gt=None,
        bounds=bounds,
        points_3d=points[shown],
        points_2d=pixels[shown],
        ids=np.flatnonzero(shown),
    )
    return {**{name: names[name] for name in ("category", "model_id", "view")}, "exhibit": record}


_STATISTICS = {
    metrics.KEYPOINTS.key: mean(metrics.KEYPOINTS.key),
    **medians(*_GALLERY),
    WARNINGS.key: mean(WARNINGS.key),
    "milliseconds": milliseconds,
}


def _plots(runs: Sequence[Run]) -> list[Plot]:
    curves = [(metric, _PLACES) for metric in (metrics.RMS, ROTATION_STD)]
    return cumulative_curves(runs, curves=curves, of="of the observations")


def _describe(run: Run) -> str:
    inputs = [Path(each).name for each in run.config.get("inputs", ())]
    more = f" and {len(inputs) - 3} more" if len(inputs) > 3 else ""
    listed = f" of {', '.join(inputs[:3])}{more}" if inputs else ""
    text = warnings_text(run.results)
    return f"on {run.total:,} observations{listed}" + (f"; {text}" if text else "")


SPEC = Spec(
    options=FitRunOptions,
    plan=plan_run,
    results=TABLE_COLUMNS,
    run=FitRun,
    columns=_HEADLINE,
    summarize=partial(summarize, statistics=_STATISTICS, by=()),
    plots=_plots,
    topic="alignments",
    joins=True,
    describe=_describe,
    metrics=_GALLERY,
    about="Red is the estimate: its box, and the model warped to the estimated shape.",
    note=(
        "Medians over the observations that did not fail; means for keypoints and warnings. "
        "Uncertainties are estimated standard deviations. There is no ground truth here: a small "
        "residual alone does not prove that an alignment is correct."
    ),
)
