"""Runs of a report: reading, title, summary, settings, methods and metrics."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from cadalign.errors import InputError
from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.registry import BATCHES, spec_of, spec_of_config
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.tables import Run
from cadalign.io.files import as_path, refuse_nul

BATCHES.update(fit="cadalign.batch.spec", retrieve="cadalign.batch.retrievals")

_LABELS = {
    "root": "dataset",
    "path": "dataset",
    "min_visible": "minimum visible keypoints",
    "max_models": "models per category, at most",
    "render": "pictures",
}


def read_runs(folders: Sequence[str | os.PathLike[str]]) -> list[Run]:
    """Read the runs of a report; raises InputError if they cannot be compared."""
    paths = [as_path(folder, "folder") for folder in folders]
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
    _require_comparable(runs)
    return runs


def _require_comparable(runs: Sequence[Run]) -> None:
    """Raise InputError for runs of several kinds."""
    first = spec_of(runs[0]).kind(runs[0])
    for run in runs[1:]:
        kind = spec_of(run).kind(run)
        if kind != first:
            what = f"{run.name} is a run of {kind}, {runs[0].name} one of {first}"
            raise InputError(what, where="runs", fix="write a report for each kind")


def shown_metrics(runs: Sequence[Run]) -> list[Metric]:
    """Metrics with values in some run; none for runs without instances.

    If no fit succeeded, all metrics that are columns of the results.
    """
    metrics = {metric.key: metric for metric in spec_of(runs[0]).metrics}
    further = {metric.key: metric for run in runs for metric in run.metrics} if metrics else {}
    columns = [(run.results, name) for run in runs for name in run.results.column_names]
    names = {name for _, name in columns}
    known = [metric for metric in (metrics | further).values() if metric.key in names]
    measured = {name for table, name in columns if table[name].null_count < len(table)}
    return [metric for metric in known if metric.key in measured] or known


def all_methods(runs: Sequence[Run]) -> list[str]:
    """Methods of all runs, in the order of their first occurrence."""
    return list(dict.fromkeys(name for run in runs for name in run.methods))


def _read(path: Path, name: str) -> Run:
    config = RunFolder(path).read_config() if path.is_dir() else None
    if config is None:
        return Run.open(path, name)  # says what is wrong with the folder
    return spec_of_config(config, path).open(path, name)


def _names(paths: Sequence[Path]) -> list[str]:
    """Shortest distinct trailing parts of the paths."""
    parts = [path.absolute().parts for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(some[-count:]) for some in parts]
        if len(set(names)) == len(names):
            break
    return names


def title_of(runs: Sequence[Run]) -> str:
    """Title of the report."""
    title = spec_of(runs[0]).title_of(runs)
    if len(runs) > 1:
        return f"{len(runs)} runs compared: {title}"
    return title[0].upper() + title[1:]


def summary_of(runs: Sequence[Run]) -> str:
    """Paragraph on the methods, data, date and progress of runs."""
    sentences = []
    for run in runs:
        before = f"{run.name}: " if len(runs) > 1 else ""
        version = run.config.get("versions", {}).get("cadalign", "of an unknown version")
        names = [name for name in run.methods if name != LIMIT]
        methods = "One method" if len(names) == 1 else f"{len(names)} methods"
        methods += " and the Cramer-Rao bound" if LIMIT in run.methods else ""
        what = spec_of(run).description_of(run)
        sentences.append(f"{before}{methods} {what}, with cadalign {version} on {run.day}.")
        if not run.is_finished:
            sentences.append(
                f"The run is unfinished: {run.done:,} of {run.total:,} tasks are done, and the "
                "numbers are of these tasks alone."
            )
    return " ".join(filter(None, [*sentences, spec_of(runs[0]).about]))


def settings_of(run: Run) -> list[tuple[str, str]]:
    """Settings of a run, as pairs of label and text."""
    config = run.config
    # Data first, methods and seed last.
    names = [field.name for field in fields(spec_of(run).options)]
    names.sort(key=lambda name: {"root": -1, "path": -1, "methods": 1, "seed": 2}.get(name, 0))
    found = []
    for name in names:
        if config.get(name) is not None and not isinstance(config[name], dict):
            label = _LABELS.get(name, name.removesuffix("_px").replace("_", " "))
            found.append((label, _text(config[name]) + (" px" if name == "noise_px" else "")))
    version = run.config.get("versions", {}).get("cadalign")
    return [*found, ("cadalign", str(version))] if version else found


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
