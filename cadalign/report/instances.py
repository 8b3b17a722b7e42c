"""The instances of runs and their errors as compact columns, joined by what names an instance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.outcome import LEFT_OUT, OK, SKIPPED
from cadalign.evaluation.plots import compact
from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.opened import Run

InstanceName = tuple[str, str, int]
"""Category, model id, view."""
_TEXTS = ("category", "model", "visibility", "symmetry")


@dataclass(frozen=True, eq=False)
class InstanceTable:
    """Columns of instances, one for each run that has it, and of their rows.

    ``strings`` are all texts, each once; other columns hold their places. The column ``id`` is the
    same for the same instance of several runs. ``places`` are those of instances by (run, name).
    """

    strings: list[str]
    instances: dict[str, list[Any]]
    rows: dict[str, list[Any]]
    places: dict[tuple[int, InstanceName], int]

    def to_dict(self) -> dict[str, Any]:
        """The tables for the page."""
        return {"strings": self.strings, "instances": self.instances, "rows": self.rows}


def instance_table(
    runs: Sequence[Run], methods: Sequence[str], metrics: Sequence[Metric]
) -> InstanceTable:
    """The table of runs over views of models, their methods and metrics of the rows."""
    texts = _Texts()
    columns = (
        *("id", "run", "category", "model", "view", "keypoints", "true_y", "true_z", "noise"),
        *("visibility", "symmetry", "exhibit", "thumb"),
    )
    instances: dict[str, list[Any]] = {name: [] for name in columns}
    rows: dict[str, list[Any]] = {name: [] for name in ("instance", "method", "status", "reason")}
    rows |= {metric.key: [] for metric in metrics}
    places: dict[tuple[int, InstanceName], int] = {}
    ids: dict[InstanceName | tuple[str, int], int] = {}
    number = {name: place for place, name in enumerate(methods)}
    for run_index, run in enumerate(runs):
        cells = _cells(run, metrics)
        names = list(zip(cells["category"], cells["model_id"], cells["view"], strict=True))
        joins = spec_of(run).joins
        for row, name in enumerate(names):
            key = (run_index, name)
            if key not in places:
                places[key] = len(places)
                _append(
                    instances,
                    id=ids.setdefault(name[1:] if joins else name, len(ids)),
                    run=run_index,
                    category=texts.place(name[0]),
                    model=texts.place(name[1]),
                    view=name[2],
                    keypoints=cells["keypoints"][row],
                    true_y=cells["stretch_y"][row],
                    true_z=cells["stretch_z"][row],
                    noise=run.noise_px,
                    visibility=texts.place(cells["visibility"][row]),
                    symmetry=texts.place(cells["symmetry"][row]),
                    exhibit=-1,
                    thumb=-1,
                )
            reason = cells["reason"][row]
            rows["instance"].append(places[key])
            rows["reason"].append(texts.place(reason) if reason else -1)
        rows["method"] += [number[name] for name in cells["method"]]
        rows["status"] += [int(status != OK) for status in cells["status"]]
        for metric in metrics:
            rows[metric.key] += cells[metric.key]
    return InstanceTable(texts.found, instances, rows, places)


@dataclass
class _Texts:
    """Texts, each once."""

    found: list[str] = field(default_factory=list)
    _places: dict[str, int] = field(default_factory=dict)

    def place(self, text: str) -> int:
        if text not in self._places:
            self._places[text] = len(self.found)
            self.found.append(text)
        return self._places[text]


def _append(columns: dict[str, list[Any]], **cells: Any) -> None:
    for name, cell in cells.items():
        columns[name].append(cell)


def _cells(run: Run, metrics: Sequence[Metric]) -> dict[str, list[Any]]:
    """The columns of a run's results as lists, without what was left out or skipped."""
    without = pc.is_in(run.results["status"], value_set=pa.array([LEFT_OUT, SKIPPED]))
    table = run.results.filter(pc.invert(without))
    wanted = ("category", "model_id", "view", "method", "status", "reason", "keypoints")
    optional = ("visibility", "symmetry")
    numbers = ("stretch_y", "stretch_z", *(metric.key for metric in metrics))
    cells = {name: table[name].to_pylist() for name in wanted}
    for name in optional:
        known = name in table.column_names
        cells[name] = table[name].to_pylist() if known else [""] * len(table)
    for name in numbers:
        known = name in table.column_names
        cells[name] = (
            compact(np.asarray(table[name].to_numpy(zero_copy_only=False)))
            if known
            else [None] * len(table)
        )
    return cells
