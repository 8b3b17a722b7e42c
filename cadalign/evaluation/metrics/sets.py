"""Sets of metrics: what a data set's protocol measures of each object, and shows of many.

A new metric of photos is a column and a line of one set, in the module with its formula; a new set
is a module, and its place in `cadalign.evaluation.photos.protocols`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.arrays import BoolArray
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.runs.work import FAILED, Columns, Row
from cadalign.evaluation.summary import known, median_of
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box

if TYPE_CHECKING:
    from cadalign.evaluation.photos.target import PhotoTarget
    from cadalign.evaluation.runs.tables import Cells

PERCENTILE = 90


@dataclass(frozen=True)
class Rate:
    """A share of objects within thresholds, of those that have a value of a column."""

    metric: Metric
    column: Metric
    is_within: Callable[[Cells], BoolArray]


@dataclass(frozen=True)
class MetricSet:
    """Metrics of a protocol."""

    measure: Callable[[PhotoTarget, Alignment, Alignment, Box], Row]
    """Errors by column, some of which may be None: of an object, an estimate of the data set's
    model, the true one, and the estimated box."""
    columns: tuple[str, ...]  # columns of the result table, numbers
    medians: tuple[Metric, ...]  # columns whose medians are shown
    tails: tuple[tuple[Metric, Metric], ...] = ()  # 90th percentiles, each of a column
    rates: tuple[Rate, ...] = ()
    shares: tuple[Metric, ...] = ()
    """Columns between 0 and 1 whose means over all objects are shown."""
    means: tuple[tuple[Metric, tuple[Metric, ...]], ...] = ()  # means of such shares
    headline: tuple[Metric, ...] = ()  # first columns of the headline table
    details: tuple[Metric, ...] = ()  # its last columns
    console: tuple[Metric, ...] = ()  # columns of the console's table


def score_columns(sets: Iterable[MetricSet]) -> Columns:
    """The columns of some sets in the result table."""
    return tuple((name, float) for each in sets for name in each.columns)


def score_alignment(
    target: PhotoTarget, sets: Sequence[MetricSet], est: Alignment, box: Box
) -> Row:
    """Errors of an estimate by column; none where the truth is not known.

    ``est`` aligns the data set's model, ``box`` is the estimated box, both in the frame of the
    photo's camera.
    """
    gt = target.gt
    if gt is None:
        return {}
    return {
        name: value
        for each in sets
        for name, value in each.measure(target, est, gt, box).items()
        if value is not None
    }


def medians_of(sets: Sequence[MetricSet], solved: Cells, *further: Metric) -> dict[str, float]:
    """Medians, and 90th percentiles, over the objects that did not fail."""
    medians = (*(metric for each in sets for metric in each.medians), *further)
    found = {metric.key: median_of(solved[metric.key]) for metric in medians}
    for metric, column in (pair for each in sets for pair in each.tails):
        values = known(solved[column.key])
        found[metric.key] = float(np.percentile(values, PERCENTILE)) if len(values) else np.nan
    return found


def measured_columns(sets: Sequence[MetricSet], cells: Cells) -> frozenset[str]:
    """The columns that have a value in some row of a whole table: what its truth allows."""
    names = (name for each in sets for name in each.columns)
    return frozenset(name for name in names if len(known(cells[name])))


def shares_of(
    sets: Sequence[MetricSet], rated: Cells, solved: Cells, *, measured: Collection[str] = ()
) -> dict[str, float]:
    """Shares of all objects whose truth is known, of which failures count as misses.

    Columns that were ``measured`` elsewhere have a share where nothing was solved, too.
    """
    failures = int((rated["status"] == FAILED).sum())
    may_be_all = failures > 0 and not len(solved["status"])

    def share(total: float, count: int, column: Metric) -> float:
        is_known = count > 0 or (may_be_all and column.key in measured)
        return total / (count + failures) if is_known else np.nan

    found = {}
    for rate in (rate for each in sets for rate in each.rates):
        count = int(np.isfinite(solved[rate.column.key].astype(float)).sum())
        found[rate.metric.key] = share(float(rate.is_within(solved).sum()), count, rate.column)
    for metric in (metric for each in sets for metric in each.shares):
        values = known(solved[metric.key])
        found[metric.key] = share(float(values.sum()), len(values), metric)
    for metric, parts in (pair for each in sets for pair in each.means):
        shares = [found[part.key] for part in parts]
        found[metric.key] = float(np.nanmean(shares)) if np.isfinite(shares).any() else np.nan
    return found


def numbers(cells: Cells, metric: Metric) -> Any:
    """A column of numbers, NaN where one is missing."""
    return cells[metric.key].astype(float)
