"""Title, summary and settings of runs, as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any

from cadalign.evaluation.options import LIMIT
from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.opened import Run

_LABELS = {
    "root": "dataset",
    "path": "dataset",
    "noise_px": "noise",
    "noises_px": "noise",
    "min_visible": "least visible keypoints",
    "max_models": "most models per category",
    "render": "pictures",
    "simulated_noise_px": "noise of simulated keypoints",
    "max_reproj_error": "inliers within",
    "max_iterations": "most samples",
}
_UNITS = {
    "noise_px": " px",
    "simulated_noise_px": " px",
    "noises_px": " px",
    "max_reproj_error": " px",
}


def title_of(runs: Sequence[Run]) -> str:
    """A report's title."""
    title = spec_of(runs[0]).title_of(runs)
    if len(runs) > 1:
        return f"{len(runs)} runs compared: {title}"
    return title[0].upper() + title[1:]


def summary_of(runs: Sequence[Run]) -> str:
    """One paragraph on methods, data, day and progress of runs."""
    return " ".join(_sentences(runs))


def settings_of(run: Run) -> list[tuple[str, str]]:
    """A run's settings by name."""
    sweep = run.config.get("sweep")
    config = {**run.config, **(sweep if isinstance(sweep, dict) else {})}
    # Data first, methods and seed last.
    names = [field.name for field in fields(spec_of(run).options)]
    names.sort(key=lambda name: {"root": -1, "path": -1, "methods": 1, "seed": 2}.get(name, 0))
    found = [
        (_LABELS.get(name, name.replace("_", " ")), f"{_text(config[name])}{_UNITS.get(name, '')}")
        for name in names
        if config.get(name) is not None and not isinstance(config[name], dict)
    ]
    version = run.config.get("versions", {}).get("cadalign")
    return [*found, ("cadalign", str(version))] if version else found


def _sentences(runs: Sequence[Run]) -> Iterator[str]:
    spec = spec_of(runs[0])
    for run in runs:
        before = f"{run.name}: " if len(runs) > 1 else ""
        version = run.config.get("versions", {}).get("cadalign", "of an unknown version")
        text = f"{_methods(run)} {spec.describe(run)}, with cadalign {version} on {run.day}."
        yield f"{before}{text}"
        if not run.is_finished:
            yield (
                f"The run is unfinished, {run.done:,} of {run.total:,} tasks are done: the numbers "
                "are those of the finished ones."
            )
    if spec.about:
        yield spec.about


def _methods(run: Run) -> str:
    names = [name for name in run.methods if name != LIMIT]
    count = "One method" if len(names) == 1 else f"{len(names)} methods"
    return f"{count} and the Cramer-Rao bound" if LIMIT in run.methods else count


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
