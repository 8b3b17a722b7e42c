"""Runs that go into one report."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cadalign.errors import InputError
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.registry import spec_of, spec_of_config
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.io.files import refuse_nul


def read_runs(folders: Sequence[str | os.PathLike[str]]) -> list[Run]:
    """Read runs that go into one report."""
    paths = [Path(folder) for folder in folders]
    if not paths:
        raise InputError(
            "none is given",
            where="runs",
            fix="give a folder that cadalign demo, evaluate or simulate has written",
        )
    seen: set[Path] = set()
    for path in paths:
        refuse_nul(path)
        if path.resolve() in seen:
            raise InputError("the run is given twice", where=str(path))
        seen.add(path.resolve())
    runs = [_read(path, name) for path, name in zip(paths, _names(paths), strict=True)]
    kinds = [spec_of(run).kind(run) for run in runs]
    for run, kind in zip(runs, kinds, strict=True):
        if kind != kinds[0]:
            raise InputError(
                f"{run.name} is a run of {kind}, {runs[0].name} one of {kinds[0]}",
                where="runs",
                fix="write a report for each kind",
            )
    return runs


def shown_metrics(runs: Sequence[Run]) -> list[Metric]:
    """Metrics of the instances that some run has; none for runs without instances."""
    known = {name for run in runs for name in run.results.column_names}
    metrics = spec_of(runs[0]).metrics
    further = {metric.key: metric for run in runs for metric in run.metrics} if metrics else {}
    return [metric for metric in (*metrics, *further.values()) if metric.key in known]


def all_methods(runs: Sequence[Run]) -> list[str]:
    """The methods of all runs, in the order of the first that has them."""
    return list(dict.fromkeys(name for run in runs for name in run.methods))


def _read(path: Path, name: str) -> Run:
    config = RunFolder(path).read_config() if path.is_dir() else None
    if config is None:
        return Run.open(path, name)  # says what is wrong with the folder
    return spec_of_config(config, path).open(path, name)


def _names(paths: Sequence[Path]) -> list[str]:
    """As few of the paths' last parts as tell them apart."""
    parts = [path.absolute().parts for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(some[-count:]) for some in parts]
        if len(set(names)) == len(names):
            break
    return names
